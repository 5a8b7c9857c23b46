"""Imports run one way, the runtime stays light, and kernels keep to their file."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parent.parent
RUNTIME = REPOSITORY / "edgeperc"

NOUNS = {"card", "geometry", "perception", "sensors"}
STAGES = {"adapt", "cluster", "decode", "drivable", "ground", "points", "projection", "refine", "session", "simulation"}

# What each module may import of edgeperc. A new module gets its line here, or the tests below fail.
MAY_IMPORT = {
    "errors": set(),
    "models": {"errors"},
    **{noun: {"errors"} | NOUNS - {noun} for noun in NOUNS},
    "settings": {"errors"},
    **{stage: {"errors"} | NOUNS for stage in STAGES},
    "session": {"errors", "settings"} | NOUNS,
    "splits": set(),
    "metrics": {"errors"} | NOUNS,
    "captures": {"errors", "points"},
    "datasets": {"errors", "points", "simulation", "splits"} | NOUNS,
    "live": {"captures", "errors", "perception"},
    "figures": {"metrics"},
    "evaluate": {"datasets", "errors", "figures", "metrics", "models", "perceiver", "view"} | NOUNS | STAGES,
    "tracking.egomotion": set(),
    "tracking.imm": set(),
    "tracking.jpda": set(),
    "tracking.ukf": set(),
    "tracking.tracker": {"errors", "tracking.egomotion", "tracking.imm", "tracking.jpda", "tracking.ukf"} | NOUNS,
    "tracking.metrics": {"errors"} | NOUNS,
    "tracking.kitti": {"datasets", "errors", "tracking.metrics", "tracking.tracker"} | NOUNS,
    "tracking.__init__": {"tracking.tracker"},
    "transfer": {"datasets", "errors", "metrics", "perceiver"} | NOUNS | STAGES,
    "view": {"drivable", "errors", "tracking.tracker"} | NOUNS,
    "perceiver": {"errors", "models"} | NOUNS | STAGES,
    "cli": {
        "captures",
        "errors",
        "evaluate",
        "live",
        "models",
        "perceiver",
        "tracking.kitti",
        "tracking.tracker",
        "transfer",
        "view",
    }
    | NOUNS
    | STAGES,
    "__init__": {"captures", "errors", "live", "perceiver", "tracking.__init__"} | NOUNS | STAGES,
    "__main__": {"cli"},
}

NEVER = {"edgeperc_bench", "edgeperc_export", "onnx", "pydantic", "scipy", "torch", "yaml"}
ONLY_IN_FUNCTIONS = {"PIL", "matplotlib", "onnxruntime"}


def modules() -> dict[str, Path]:
    """Every module of the runtime; one of a subpackage is called by its path, ``tracking.imm``."""
    found = {".".join(path.relative_to(RUNTIME).with_suffix("").parts): path for path in RUNTIME.rglob("*.py")}
    return found | {"models": REPOSITORY / "models" / "__init__.py"}


def imported(tree: ast.AST, package: str = "edgeperc") -> Iterator[str]:
    """Absolute dotted names of everything that a module of ``package`` imports, inside functions too."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: 1 - node.level or None] if node.level else []
            assert above or not node.level, f"line {node.lineno}: a relative import that leaves edgeperc"
            origin = ".".join(filter(None, [*above, node.module]))
            yield from ([f"{origin}.{alias.name}" for alias in node.names] if origin == "edgeperc" else [origin])
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith(("import_module", "__import__")):
            yield from (str(name.value) for name in node.args if isinstance(name, ast.Constant))


def package_of(path: Path) -> str:
    """``edgeperc`` or ``edgeperc.tracking``: what a file's relative imports start from."""
    inside = path.parent.relative_to(RUNTIME).parts if path.is_relative_to(RUNTIME) else ()
    return ".".join(("edgeperc", *inside))


def imported_of_edgeperc(path: Path) -> set[str]:
    """Modules of edgeperc that a file imports, without the package's name."""
    names = set()
    for dotted in imported(ast.parse(path.read_text("utf-8")), package_of(path)):
        if dotted.startswith("edgeperc."):
            name = dotted.removeprefix("edgeperc.")
            names.add(f"{name}.__init__" if f"{name}.__init__" in modules() else name)
    return names - {"__version__"}


def at_import(tree: ast.Module) -> Iterator[ast.stmt]:
    """Statements that run when a module is imported: everything outside functions."""
    pending: list[ast.stmt] = list(tree.body)
    while pending:
        statement = pending.pop()
        if isinstance(statement, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        yield statement
        pending.extend(child for child in ast.walk(statement) if isinstance(child, ast.stmt) and child is not statement)


def test_the_runtime_has_modules_to_check() -> None:
    assert {"errors", "card", "perception", "models"} <= modules().keys()


@pytest.mark.parametrize("name", sorted(modules()))
def test_imports_run_one_way(name: str) -> None:
    assert name in MAY_IMPORT, f"edgeperc.{name} has no line in MAY_IMPORT: say which layer it belongs to"
    too_far = imported_of_edgeperc(modules()[name]) - MAY_IMPORT[name]
    assert not too_far, f"edgeperc.{name} imports {sorted(too_far)}, which its layer may not"


def test_no_module_needs_itself() -> None:
    graph = {name: imported_of_edgeperc(path) for name, path in modules().items() if name != "__init__"}
    assert list(TopologicalSorter(graph).static_order())  # raises CycleError, which names the cycle


@pytest.mark.parametrize("name", sorted(modules()))
def test_the_runtime_is_light(name: str) -> None:
    tree, package = ast.parse(modules()[name].read_text("utf-8")), package_of(modules()[name])
    packages = {dotted.partition(".")[0] for dotted in imported(tree, package)}
    assert not packages & NEVER
    assert name == "session" or "onnxruntime" not in packages, "edgeperc.session alone talks to onnxruntime"
    for statement in at_import(tree):
        if isinstance(statement, ast.Import | ast.ImportFrom):
            packages = {dotted.partition(".")[0] for dotted in imported(statement, package)}
            assert not packages & ONLY_IN_FUNCTIONS, f"line {statement.lineno}: import {packages} where it is used"


@pytest.mark.parametrize("name", sorted(modules()))
def test_library_code_leaves_the_process_alone(name: str) -> None:
    """No exit, no print and no logging set-up outside the command line."""
    if name in {"cli", "__main__"}:
        return
    calls = [
        ast.unparse(node.func)
        for node in ast.walk(ast.parse(modules()[name].read_text("utf-8")))
        if isinstance(node, ast.Call)
    ]
    assert not {"print", "exit", "quit", "sys.exit", "os._exit", "logging.basicConfig", "signal.signal"} & {*calls}


@pytest.mark.parametrize("path", sorted((REPOSITORY / "bench").glob("*.py")), ids=lambda path: path.stem)
def test_the_bench_stands_on_the_runtime_alone(path: Path) -> None:
    """It measures what a vehicle installs: nothing of training, and what draws or drives it only where asked for.

    Rivals stand on what they stand on, but only when they are asked for too.
    """
    rivals = {"edgeperc_export", "onnx", "onnxruntime", "openvino", "scipy", "torch"}
    tree = ast.parse(path.read_text("utf-8"))
    packages = {dotted.partition(".")[0] for dotted in imported(tree)}
    assert path.stem in {"arithmetic", "peers", "rivals"} or not packages & rivals
    for statement in at_import(tree):
        if isinstance(statement, ast.Import | ast.ImportFrom):
            packages = {dotted.partition(".")[0] for dotted in imported(statement)}
            assert not packages & ({"matplotlib", "mlperf_loadgen"} | rivals)


def kernels(tree: ast.Module) -> Iterator[tuple[ast.FunctionDef, ast.expr]]:
    """Functions under numba's decorator, each with it."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            for decorator in node.decorator_list:
                bare = decorator.func if isinstance(decorator, ast.Call) else decorator
                if ast.unparse(bare).rpartition(".")[2] in {"guvectorize", "jit", "njit", "vectorize"}:
                    yield node, decorator


@pytest.mark.parametrize("name", sorted(modules()))
def test_kernels_keep_to_the_house(name: str) -> None:
    """Cached, without the GIL; never parallel (aborts the process when two threads call) or fastmath (drops guards).

    A kernel calls no kernel of another file: with ``cache=True`` an edit of the callee leaves a stale result behind.
    """
    tree = ast.parse(modules()[name].read_text("utf-8"))
    borrowed = {
        alias.asname or alias.name
        for node in tree.body
        if isinstance(node, ast.ImportFrom) and (node.level or str(node.module).startswith("edgeperc"))
        for alias in node.names
    }
    for kernel, decorator in kernels(tree):
        assert isinstance(decorator, ast.Call), f"{kernel.name}: write @njit(cache=True, nogil=True)"
        options = {keyword.arg: ast.unparse(keyword.value) for keyword in decorator.keywords}
        assert options.get("cache") == options.get("nogil") == "True", f"{kernel.name}: {options}"
        assert not options.keys() & {"fastmath", "parallel"}, f"{kernel.name}: {options}"
        called = {ast.unparse(node.func).partition(".")[0] for node in ast.walk(kernel) if isinstance(node, ast.Call)}
        assert not called & borrowed, f"{kernel.name} calls {sorted(called & borrowed)} of another file"


IMPORT_AND_WATCH = """
import os, sys, threading

threads, written = [], []

def watch(event, arguments):
    if event == "_thread.start_new_thread":
        threads.append(arguments)
    elif event in {"os.mkdir", "os.remove", "os.rename"}:
        written.append((event, *arguments))
    elif event == "open" and isinstance(arguments[2], int) and arguments[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT):
        written.append((event, *arguments))

sys.addaudithook(watch)
import edgeperc

assert not threads and threading.active_count() == 1, threads
assert not os.path.isdir("/proc/self/task") or len(os.listdir("/proc/self/task")) == 1
assert not written, written
heavy = {"matplotlib", "numba", "numpy", "onnx", "onnxruntime", "scipy", "torch"} & sys.modules.keys()
assert not heavy, heavy
assert {"Perceiver", "Box"} <= {*dir(edgeperc)}
print("idle")
"""


def test_importing_does_no_work(tmp_path: Path) -> None:
    """Watched from inside a fresh interpreter: no thread, no file written, nothing heavy loaded."""
    command = [sys.executable, "-B", "-c", IMPORT_AND_WATCH]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.stdout == "idle\n", done.stderr
    assert not [*tmp_path.iterdir()]
