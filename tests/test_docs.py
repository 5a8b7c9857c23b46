"""README and documentation are true: every block of Python runs, every command runs or is parsed by its program."""

from __future__ import annotations

import argparse
import contextlib
import gc
import io
import re
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from string import Template

import numpy as np
import pytest

from checkout import REPOSITORY, files
from cli_helpers import thinned
from edgeperc import cli
from edgeperc.cli.main import build_parser
from edgeperc.simulation.camera import forward_camera, render
from scenes import urban

if sys.version_info >= (3, 11):
    import tomllib

PAGES = [REPOSITORY / "README.md", REPOSITORY / "CONTRIBUTING.md", *files(".md", "docs")]
MODULES_WITH_PARSERS = {"edgeperc-bench": "edgeperc_bench.cli", "edgeperc-export": "edgeperc_export.cli"}


@dataclass(frozen=True)
class Block:
    """A fenced block of a page, and the comment above it that says why it is not run."""

    page: Path
    line: int
    language: str
    text: str
    excuse: str

    def __str__(self) -> str:
        return f"{self.page.relative_to(REPOSITORY).as_posix()}:{self.line}"


def blocks_of(page: Path, *languages: str) -> list[Block]:
    """The fenced blocks of a page in some languages, indented ones too."""
    pattern = r"^(?:<!-- ([^\n]*?) -->\n)?( *)```(\w+)\n(.*?)^\2```$"
    text, found = page.read_text("utf-8"), []
    for match in re.finditer(pattern, text, flags=re.DOTALL | re.MULTILINE):
        excuse, indent, language, body = match.groups()
        if language in languages:
            line = text.count("\n", 0, match.start(3)) + 1
            found.append(Block(page, line, language, re.sub(rf"^{indent}", "", body, flags=re.M), excuse or ""))
    return found


COMMANDS = [
    (block, line[2:])
    for page in PAGES
    for block in blocks_of(page, "console")
    for line in block.text.splitlines()
    if line.startswith("$ ")
]
ONCE = [*{(line, block.excuse): (block, line) for block, line in COMMANDS}.values()]
PYTHON_PAGES = [page for page in PAGES if blocks_of(page, "python")]

pytestmark = pytest.mark.usefixtures("networks_opened_once")  # each of a hundred commands asks for the same ones


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what the pages speak of: a scan, a drive, a stream, the research models."""
    folder = tmp_path_factory.mktemp("docs")
    for name in ("scan.bin", "demo/scan.bin", "drive/0.bin", "drive/1.bin", "velodyne/0.bin", "velodyne/1.bin"):
        seed = 4 + len(name)
        (folder / name).parent.mkdir(exist_ok=True)
        urban(seed, thinned()).points.tofile(folder / name)
    # What a page's Python writes is there for its commands, which may run in another process.
    np.save(folder / "utm.npy", urban(12, thinned()).points + np.array([512345.25, 5412345.5, 113.0, 0.0]))
    (folder / "calib.txt").write_text(
        "P2: 831 0 480 0 0 831 360 0 0 0 1 0\nR0_rect: 1 0 0 0 1 0 0 0 1\n"
        "Tr_velo_to_cam: 0 -1 0 0 0 0 -1 -0.08 1 0 0 -0.27\n"
    )
    with contextlib.suppress(ImportError):  # its pages need Pillow
        from PIL import Image

        camera = forward_camera()
        scan = urban(12, thinned())
        Image.fromarray(render(scan.scene, camera, scan.T_world_sensor, 12).rgb).save(folder / "image.png")
        (folder / "demo/image.png").write_bytes((folder / "image.png").read_bytes())
    (folder / "T_vehicle_sensor.json").write_text("[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1.7], [0, 0, 0, 1]]")
    if sys.platform != "win32":
        (folder / "models").symlink_to(REPOSITORY / "models")
    return folder


@pytest.mark.parametrize("page", PYTHON_PAGES, ids=lambda page: page.relative_to(REPOSITORY).as_posix())
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_python_runs(page: Path, place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The blocks of a page run in their order, in one namespace."""
    monkeypatch.chdir(place)
    if "draw(" in page.read_text("utf-8"):
        pytest.importorskip("matplotlib")
    if "read_image(" in page.read_text("utf-8"):
        pytest.importorskip("PIL")
    if "McapSink(" in page.read_text("utf-8"):
        pytest.importorskip("foxglove")
    names: dict[str, object] = {"__name__": "page"}
    for block in blocks_of(page, "python"):
        if block.excuse.startswith("not run:"):
            compile(block.text, str(block), "exec")
            continue
        with contextlib.redirect_stdout(io.StringIO()):
            exec(compile(block.text, str(block), "exec"), names)


@pytest.mark.parametrize(("block", "line"), ONCE, ids=[f"{block} {line}" for block, line in ONCE])
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_commands_run(block: Block, line: str, place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """``edgeperc`` runs; pip and make are held against what they install; a block that cannot run here says why."""
    program, *arguments = shlex.split(line.partition(" > ")[0], comments=True)
    monkeypatch.chdir(place)
    if program == "pip":
        assert wanted_extras(line) <= declared_extras(), line
    elif program == "make":
        targets = re.findall(r"^([\w-]+):", (REPOSITORY / "Makefile").read_text("utf-8"), flags=re.M)
        assert {word for word in arguments if "=" not in word} <= {*targets}
    elif program == "nuctl":
        if arguments[0] == "deploy":
            assert (REPOSITORY / arguments[arguments.index("--path") + 1] / "function.yaml").is_file()
    elif program in ("docker", "podman"):
        if "--file" in arguments:
            assert (REPOSITORY / arguments[arguments.index("--file") + 1]).is_file()
            assert (REPOSITORY / arguments[-1]).is_dir()
        elif arguments[0] == "run":  # what follows the image's name is for edgeperc
            parse("edgeperc", arguments[len(arguments) - arguments[::-1].index("edgeperc") :])
        else:
            assert (REPOSITORY / "Containerfile").is_file()
    elif program == "git":
        assert arguments[0] == "clone"
    elif program == "python":
        assert arguments[0] == "-m"
        module = arguments[1].replace(".", "/").replace("edgeperc_bench", "bench").replace("edgeperc_export", "export")
        assert (REPOSITORY / module).with_suffix(".py").exists()
    elif block.excuse.startswith("parsed only:") or program != "edgeperc":
        said = block.excuse.startswith("parsed only:")
        assert said or arguments in (["--help"], ["--version"]), "say why it is not run"
        parse(program, arguments)
    else:
        if {"--png", "--gif", "demo"} & {*arguments}:
            pytest.importorskip("matplotlib")
        for option in {"--bag", "--mcap", "--rrd"} & {*arguments}:
            pytest.importorskip({"--bag": "rosbags", "--mcap": "foxglove", "--rrd": "rerun"}[option])
        if sys.platform == "win32" and "models/research" in line:
            pytest.skip("no symbolic links")
        arguments = ["simulation:2" if word.startswith("simulation:") else word for word in arguments]  # of any number
        with contextlib.redirect_stdout(io.StringIO()) as printed:
            assert cli.main(arguments) == 0, printed.getvalue()


def parse(program: str, arguments: list[str]) -> None:
    """Let a program's own parser read a command; nothing runs."""
    if program == "edgeperc":
        parser: argparse.ArgumentParser = build_parser()
    else:
        pytest.importorskip("torch" if program == "edgeperc-export" else "psutil")
        module = __import__(MODULES_WITH_PARSERS[program], fromlist=["build_parser"])
        parser = module.build_parser()
        if program == "edgeperc-bench":
            arguments = module.with_command(arguments)
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()) as said:
        try:
            parser.parse_args(arguments)
        except SystemExit as exc:
            code = exc.code
        else:
            code = 0
    assert not code, said.getvalue()


def commands_of_results() -> list[str]:
    """The commands of ``bench/RESULTS.md``, in blocks and in sentences, with its shell variables put in."""
    text = (REPOSITORY / "bench" / "RESULTS.md").read_text("utf-8")
    lines = [line for block in re.findall(r"^```\n(.*?)^```", text, flags=re.S | re.M) for line in block.splitlines()]
    lines += [line.replace("\n", " ") for line in re.findall(r"`(edgeperc(?:-\w+)? [^`]*--[^`]*)`", text)]
    variables = dict(re.findall(r'^([A-Z0-9]+)="(.*)"$', text, flags=re.M))
    commands = [
        Template(line).substitute(variables) for line in lines if line and line.partition("=")[0] not in variables
    ]
    assert len(commands) > 20
    return commands


@pytest.mark.parametrize("line", commands_of_results())
def test_commands_of_the_results_are_known(line: str) -> None:
    program, *arguments = (word for word in shlex.split(line, comments=True) if word != "..." and "=" not in word)
    if program != "python":
        parse(program, arguments)
        return
    source = (REPOSITORY / arguments[1].replace("edgeperc_bench.", "bench/").replace(".", "/")).with_suffix(".py")
    assert {word for word in arguments if word.startswith("--")} <= {
        *re.findall(r'"(--[\w-]+)[ "]', source.read_text("utf-8"))
    }


def declared_extras() -> set[str]:
    if sys.version_info < (3, 11):
        pytest.skip("no tomllib")
    return {*tomllib.loads((REPOSITORY / "pyproject.toml").read_text("utf-8"))["project"]["optional-dependencies"]}


def wanted_extras(line: str) -> set[str]:
    return {extra for group in re.findall(r"\[([\w,]+)\]", line) for extra in group.split(",")}


def test_links_pictures_and_extras_are_there() -> None:
    for page in PAGES:
        text = page.read_text("utf-8")
        for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", text) + re.findall(r"```\{(?:image|include)\} (\S+)", text):
            if not target.startswith(("http", "mailto:")):
                assert (page.parent / target).exists(), (page, target)
        for target in re.findall(r"\{doc\}`([^`<]+)`", text):
            assert (page.parent / f"{target}.md").exists(), (page, target)
        named = re.findall(r"edgeperc\[([\w,]+)\]", text)
        if sys.version_info >= (3, 11):
            assert {extra for group in named for extra in group.split(",")} <= declared_extras(), page


def test_the_readme_is_read_in_a_minute() -> None:
    readme = (REPOSITORY / "README.md").read_text("utf-8")
    assert readme.count("\n") <= 130
    (example,) = re.findall(r"```python\n(.*?)```", readme, flags=re.DOTALL)
    assert len([line for line in example.splitlines() if line.strip()]) <= 10


def test_what_the_readme_installs_runs_what_it_shows() -> None:
    """Each extra that an option or an image in its commands needs is in its own line of installation."""
    commands = [line for block, line in COMMANDS if block.page.name == "README.md"]
    (install,) = [line for line in commands if line.startswith("pip")]
    needs = {"--png": "view", "--gif": "view", "--mcap": "foxglove", "--rrd": "rerun", "--bag": "ros", ".png": "view"}
    wanted = {extra for line in commands for word, extra in needs.items() if word in line}
    assert wanted == {"view", "foxglove"}
    assert wanted <= wanted_extras(install)
    for line in commands:
        if line.startswith(("edgeperc run", "edgeperc info")):
            assert " demo/" in line, f"{line}: what edgeperc demo leaves is there to try it on"


def test_files_named_in_contributing_are_there() -> None:
    """The table "to change X, open Y"."""
    text = (REPOSITORY / "CONTRIBUTING.md").read_text("utf-8")
    for path in re.findall(r"`((?:edgeperc|export|bench|models|tests|docs)/[\w/.*]+)`", text):
        assert [*REPOSITORY.glob(path)], path


def test_pages_of_the_documentation_are_reachable() -> None:
    """Every page stands in a table of contents."""
    listed: set[Path] = set()
    for page in PAGES:
        for tree in re.findall(r"```\{toctree\}\n(.*?)```", page.read_text("utf-8"), flags=re.DOTALL):
            listed |= {
                (page.parent / f"{line.strip()}.md").resolve() for line in tree.splitlines() if line[:1].isalnum()
            }
    pages = {page for page in PAGES if page.is_relative_to(REPOSITORY / "docs")} - {REPOSITORY / "docs" / "index.md"}
    assert pages == listed


def test_programs_pass_strict_typing(tmp_path: Path) -> None:
    """The blocks of a page, one below the other, as a program of a stranger who checks types strictly."""
    mypy = pytest.importorskip("mypy.api")
    for page in PYTHON_PAGES:
        name = "_".join(page.relative_to(REPOSITORY).with_suffix("").parts).replace("-", "_")
        (tmp_path / f"{name}.py").write_text("\n".join(block.text for block in blocks_of(page, "python")), "utf-8")
    (tmp_path / "wrong.py").write_text("import edgeperc\n\nedgeperc.Perceiver()(image=None).points.counts()\n", "utf-8")
    (tmp_path / "mypy.ini").write_text(
        f"[mypy]\nstrict = True\nmypy_path = {REPOSITORY.as_posix()}\nfollow_imports = silent\n"
        "ignore_missing_imports = True\n"  # edgeperc.zoo and edgeperc_export lie elsewhere in a checkout
    )
    collected = gc.get_threshold()
    said, faults, code = mypy.run(["--config-file", str(tmp_path / "mypy.ini"), *map(str, tmp_path.glob("*.py"))])
    gc.set_threshold(*collected)  # mypy collects more rarely from then on
    assert not faults
    errors = [line for line in said.splitlines() if ": error:" in line]
    assert code == 1
    assert len(errors) == 1, said
    assert "wrong.py" in errors[0]
    assert "union-attr" in errors[0]
