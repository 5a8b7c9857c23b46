"""What a release and its checks are made with is named by its content: actions, images and tools, by their hashes."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from checkout import REPOSITORY

yaml = pytest.importorskip("yaml")
packaging = pytest.importorskip("packaging.requirements")

WORKFLOWS = sorted((REPOSITORY / ".github/workflows").glob("*.yml"))
TOOLS = REPOSITORY / ".ci/tools"
IMAGE = re.compile(r"[\w./-]+:[\w.-]+@sha256:[0-9a-f]{64}")


def jobs() -> Iterator[tuple[str, dict[str, Any]]]:
    for path in WORKFLOWS:
        for name, job in yaml.safe_load(path.read_text("utf-8"))["jobs"].items():
            yield f"{path.name}: {name}", job


def locked() -> dict[str, list[str]]:
    """The requirements of a release, each with its hashes."""
    text = (TOOLS / "requirements.txt").read_text("utf-8").replace("\\\n", " ")
    lines = [line.split(" --hash=") for line in text.splitlines() if line and not line.startswith("#")]
    return {line[0].strip(): [each.strip() for each in line[1:]] for line in lines}


def images(path: Path) -> list[str]:
    return [line.split()[1] for line in path.read_text("utf-8").splitlines() if line.startswith("FROM ")]


def test_actions_are_pinned_to_one_commit_with_its_version() -> None:
    pins: dict[str, set[str]] = {}
    for path in WORKFLOWS:
        for line in path.read_text("utf-8").splitlines():
            if "uses:" in line:
                pin = re.search(r"uses: ([\w.-]+/[\w./-]+)@([0-9a-f]{40} # v\d+\.\d+\.\d+)$", line)
                assert pin, f"{path.name}: {line.strip()} is not a commit with its version"
                pins.setdefault(pin[1], set()).add(pin[2])
    assert len(pins) >= 7
    assert {name: len(commits) for name, commits in pins.items()} == dict.fromkeys(pins, 1)


def test_images_are_pinned_by_digest() -> None:
    found = {path: images(REPOSITORY / path) for path in ("Containerfile", ".ci/images/Dockerfile")}
    assert all(IMAGE.fullmatch(image) for each in found.values() for image in each), found
    containers = {name: job["container"] for name, job in jobs() if "container" in job}
    assert containers  # and what a job runs in comes from the file that is kept
    assert all(re.fullmatch(r"\$\{\{ .*needs\.images\.outputs\.\w+.* \}\}", each) for each in containers.values())
    assert [image.split("_2_28_")[1].split(":")[0] for image in found[".ci/images/Dockerfile"]] == ["x86_64", "aarch64"]


def test_tools_of_a_release_are_pinned_with_hashes() -> None:
    found = locked()
    assert len(found) > 20
    for text, hashes in found.items():
        assert re.fullmatch(r"[\w.-]+==[\w.]+( ; .+)?", text), text
        assert hashes, text
        assert all(re.fullmatch(r"sha256:[0-9a-f]{64}", each) for each in hashes), text


def test_every_wanted_tool_is_pinned_for_every_python() -> None:
    wanted = [
        packaging.Requirement(line)
        for line in (TOOLS / "requirements.in").read_text("utf-8").splitlines()
        if line[0] != "#"
    ]
    pinned = [packaging.Requirement(text) for text in locked()]
    for tool in wanted:
        for python in ("3.10.14", "3.11.9", "3.12.7", "3.13.1"):
            environment = {"python_version": python.rpartition(".")[0], "python_full_version": python}
            applies = [each for each in pinned if each.name == tool.name]
            applies = [each for each in applies if each.marker is None or each.marker.evaluate(environment)]
            (pin,) = applies
            assert {each.version for each in pin.specifier} <= {
                *tool.specifier.filter([each.version for each in pin.specifier])
            }


def installs() -> Iterator[tuple[str, str]]:
    """What the release installs: each command with pip, and where it stands."""
    for line in (REPOSITORY / ".ci/release").read_text("utf-8").splitlines():
        if "pip" in line and " install " in line:
            yield ".ci/release", line
    for name, job in jobs():
        if name.startswith("release"):
            for step in job["steps"]:
                yield from ((name, line) for line in step.get("run", "").strip().split(" && ") if " install " in line)


def test_a_release_installs_nothing_without_hashes_but_itself() -> None:
    found = [*installs()]
    assert len(found) >= 4
    for where, line in found:
        hashed = "--require-hashes --only-binary :all: --requirement .ci/tools/requirements.txt" in line
        itself = bool(
            re.search(
                r"(\$\{wheel\}\[[\w,]+\]\"|\"\$\(echo wheels/\*\.whl\)\[\w+\]\"|--no-deps --no-build-isolation \.)$",
                line,
            )
        )
        assert hashed != itself, f"{where}: {line}"


@pytest.mark.parametrize("file", [".ci/release", ".github/workflows/release.yml"])
def test_a_build_takes_no_tools_of_its_own(file: str) -> None:
    builds = [line for line in (REPOSITORY / file).read_text("utf-8").splitlines() if "-m build" in line]
    assert builds
    assert all("--no-isolation" in line for line in builds)


def test_dependabot_keeps_all_of_it() -> None:
    kept = yaml.safe_load((REPOSITORY / ".github/dependabot.yml").read_text("utf-8"))["updates"]
    places = {
        (each["package-ecosystem"], place)
        for each in kept
        for place in each.get("directories", [each.get("directory")])
    }
    assert places == {("github-actions", "/"), ("docker", "/"), ("docker", "/.ci/images"), ("uv", "/.ci/tools")}
    assert all((REPOSITORY / place.strip("/")).is_dir() for _, place in places)
    assert "uv pip compile" in (TOOLS / "requirements.txt").read_text("utf-8").splitlines()[1]
