"""Where the tests find real scans; everything else they make themselves."""

from __future__ import annotations

import ast
import functools
import gc
import hashlib
import importlib.util
import inspect
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("EDGEPERC_KERNELS", "jit")  # the kernels of the sources, whatever was built of them

import numba
import pytest
from hypothesis import HealthCheck, settings

from checkout import REPOSITORY, files

ARCHIVES = REPOSITORY.parent / "shared" / "data"


CALLED = pytest.StashKey[set[str]]()


# No test asserts a time, a busy computer's neither. The same examples each time, lest a change fail by chance for what
# was there before it; `make search` draws others, and many more.
settings.register_profile("edgeperc", derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("search", settings.get_profile("edgeperc"), derandomize=False, max_examples=1000)
settings.load_profile("edgeperc")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--every-kernel", action="store_true", help="fail if a kernel was never called (with NUMBA_DISABLE_JIT=1)"
    )


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "kernel: holds a kernel against its slow twin")
    config.addinivalue_line("markers", "compiled: takes a twin for the truth of more than a kernel")
    if "PYTEST_XDIST_WORKER" in os.environ:  # the processes share the cores; torch's threads would wait for one another
        os.environ.setdefault("OMP_NUM_THREADS", "1")
    if numba.config.DISABLE_JIT:
        # An interpreted kernel computes with numpy's scalars, which warn where compiled code yields NaN or infinity.
        config.addinivalue_line("filterwarnings", "ignore:(invalid value|overflow|divide by zero):RuntimeWarning")
    if config.getoption("every_kernel"):
        if not numba.config.DISABLE_JIT:
            raise pytest.UsageError("--every-kernel sees interpreted kernels alone; set NUMBA_DISABLE_JIT=1")
        called = config.stash.setdefault(CALLED, set())

        def noted(kernel: Callable[..., Any]) -> Callable[..., Any]:
            name = f"{kernel.__code__.co_filename}:{kernel.__name__}"

            @functools.wraps(kernel)
            def call(*arguments: Any, **named: Any) -> Any:
                called.add(name)
                return kernel(*arguments, **named)

            return call

        numba.njit = lambda **options: noted  # no module with kernels is imported yet


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Nothing that is collected, or imported for it, is garbage; to look for some took 5 of 21 s."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """A test that calls a twin, itself or through a function of its file, holds a kernel against it.

    Such a test runs interpreted and bounds-checked, too; ``@pytest.mark.kernel`` marks one that knows another truth,
    ``@pytest.mark.compiled`` one that runs compiled alone, for its kernels are held against their twins elsewhere.
    """
    items.sort(key=lambda item: item.path.name != "test_warm_up.py")  # else one process ends 80 s after the others
    for item in items:
        function, module = getattr(item, "function", None), getattr(item, "module", None)
        if function is not None and module is not None and item.get_closest_marker("compiled") is None:
            if hasattr(function, "hypothesis"):
                function = function.hypothesis.inner_test
            names = {*function.__code__.co_names}
            helpers = [value for name, value in vars(module).items() if name in names and inspect.isfunction(value)]
            if any("twins" in {*inspect.unwrap(each).__code__.co_names} for each in (function, *helpers)):
                item.add_marker("kernel")


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Networks start with the same weights, whatever test ran before: torch draws others in each process."""
    if "torch" in sys.modules:
        sys.modules["torch"].manual_seed(0)


def pytest_testnodedown(node: Any) -> None:
    """Of pytest-xdist: what a worker process called. One that died has no output; pytest-xdist names its test."""
    node.config.stash.setdefault(CALLED, set()).update(getattr(node, "workeroutput", {}).get("called", ()))


def pytest_sessionfinish(session: pytest.Session) -> None:
    config = session.config
    if not config.getoption("every_kernel"):
        return
    called = config.stash[CALLED]
    if hasattr(config, "workeroutput"):
        config.workeroutput["called"] = sorted(called)
        return
    missing = [kernel for kernel in kernels() if kernel not in called]
    if missing:
        print(f"\n{len(missing)} kernels were not called:", *missing, sep="\n  ")
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def kernels() -> Iterator[str]:
    """Every function under ``@njit``, as ``FILE:NAME``."""
    for path in files(".py", "edgeperc", "bench", "export"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.FunctionDef) and any("njit" in ast.unparse(d) for d in node.decorator_list):
                yield f"{path}:{node.name}"


def cache_root() -> Path:
    """A folder of this user, outside the checkout, for what is unpacked once and used by many runs."""
    default = Path.home() / ("AppData/Local" if sys.platform == "win32" else ".cache")
    return Path(os.environ.get("XDG_CACHE_HOME", default)) / "edgeperc-tests"


def unpack_group(group: str) -> Path:
    """Unpack one group of archives, once for all processes and runs that see the same archives."""
    from filelock import FileLock  # here, so that tests without real scans need no more than pytest

    listing = "".join(f"{file.name} {file.stat().st_size}\n" for file in sorted(ARCHIVES.glob(f"{group}*.tar*")))
    name = hashlib.sha256(listing.encode()).hexdigest()[:16]
    out = cache_root() / name
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError:  # a home that cannot be written
        out = Path(tempfile.gettempdir()) / "edgeperc-tests" / name
        out.mkdir(parents=True, exist_ok=True)
    with FileLock(out / "lock"):
        if not (out / "complete").exists():
            command = [sys.executable, str(ARCHIVES / "unpack.py"), str(out), "--only", group]
            done = subprocess.run(command, capture_output=True, text=True)
            assert done.returncode == 0, f"{' '.join(command)}\n{done.stdout}{done.stderr}"
            (out / "complete").touch()
    return out / group


@pytest.fixture(scope="session", autouse=True)
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """What this computer keeps of real use (settings, compiled models) is nothing to the tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("EDGEPERC_CACHE_DIR", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="session", autouse=True)
def scenes_are_simulated_once() -> Iterator[None]:
    """Evaluations, exports and benchmarks take the same scenes, readers of maps the same scans. In `simulation` each
    is drawn anew.
    """
    from edgeperc.readers import files as readers
    from edgeperc.simulation import samples
    from scenes import Once

    once = Once()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(samples, "random_scene", once.scene)
        patch.setattr(samples, "simulate", once.scan)
        patch.setattr(readers, "find_place", once.place)
        yield


@pytest.fixture(scope="session", autouse=True)
def operators_are_listed_once() -> Iterator[None]:
    """Torch's exporter lists the operators that it knows for each graph anew, in 0.9 s: a quarter of an export."""
    if "torch" not in sys.modules or importlib.util.find_spec("onnxscript") is None:  # tests without an export
        yield
        return
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from torch.onnx._internal.exporter._registration import ONNXRegistry
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ONNXRegistry, "from_torchlib", staticmethod(functools.cache(ONNXRegistry.from_torchlib)))
        yield


@pytest.fixture(scope="session", autouse=True)
def exports_see_few_scans() -> Iterator[None]:
    """An export is verified on four simulated scans, and its card describes 32: here eight times the same four."""
    if "torch" not in sys.modules:
        yield
        return
    from edgeperc_export.data import simulate

    simulated_scan = simulate.simulated_scan

    def one_of_four(seed: int, *arguments: Any, **options: Any) -> Any:
        return simulated_scan(seed if seed < 10**9 else 10**9 + seed % 4, *arguments, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simulate, "simulated_scan", one_of_four)
        yield


@pytest.fixture(scope="module", autouse=True)
def what_was_there_is_no_garbage() -> None:
    """Else each of thousands of collections goes through all of torch, numba and the kernels."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True)
def own_signals() -> Iterator[None]:
    """No test may leave a handler: the next one that raises its signal would end the whole run."""
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.getsignal(number) for number in numbers]
    yield
    assert [signal.getsignal(number) for number in numbers] == before


@pytest.fixture
def foreground() -> Iterator[None]:
    """Ctrl-C works, and the end of the terminal, even where a shell started the tests in the background."""
    wanted = {signal.SIGINT: signal.default_int_handler, getattr(signal, "SIGHUP", signal.SIGTERM): signal.SIG_DFL}
    before = {number: signal.signal(number, handler) for number, handler in wanted.items()}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture(scope="session")
def matplotlib() -> None:
    """For tests that draw: skips them where only the runtime is installed."""
    pytest.importorskip("matplotlib")


@pytest.fixture(scope="session")
def psutil() -> None:
    """For tests that measure: skips them where only the runtime is installed."""
    pytest.importorskip("psutil")


@pytest.fixture
def shell(capsys: pytest.CaptureFixture[str]) -> Any:
    """The command line of edgeperc; `tests/export` and `tests/bench` have those of their programs."""
    from cli_helpers import Shell

    return Shell(capsys)


@pytest.fixture(scope="module")
def networks_opened_once() -> Iterator[None]:
    """Perceivers that answer one after the other share networks: to open them takes longer than to run them."""
    from edgeperc import perceiver

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(perceiver, "Session", functools.cache(perceiver.Session))
        yield


@pytest.fixture(scope="session")
def data_root() -> Callable[[str], Path]:
    """A function from the name of a group of real data to the folder that holds it unpacked.

    ``EDGEPERC_TEST_DATA`` names a folder of groups that are unpacked already. Otherwise the archives lie beside the
    checkout, in ``../shared/data``; only where that folder does not exist is the test skipped.
    """

    def folder(group: str) -> Path:
        if "EDGEPERC_TEST_DATA" in os.environ:
            unpacked = Path(os.environ["EDGEPERC_TEST_DATA"]) / group
            assert unpacked.is_dir(), f"EDGEPERC_TEST_DATA is set, but {unpacked} is no folder"
            return unpacked
        if not ARCHIVES.is_dir():
            pytest.skip("no real data: neither ../shared/data beside the checkout nor EDGEPERC_TEST_DATA")
        return unpack_group(group)

    return folder


@pytest.fixture(scope="session")
def kitti_root(data_root: Callable[[str], Path]) -> Path:
    """KITTI object detection frames: ``frames.csv`` and ``training/{velodyne,label_2,calib}``."""
    return data_root("kitti3d")


@pytest.fixture(scope="session")
def semantickitti_root(data_root: Callable[[str], Path]) -> Path:
    """SemanticKITTI: ``sequences/00/{velodyne,labels,label_origin}``."""
    return data_root("semantickitti")


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Callable[[int], Path]]:
    """A function that makes a file system of so many KiB and returns its folder; it needs root on Linux."""
    folder = tmp_path / "disk"

    def mount(size_kib: int) -> Path:
        folder.mkdir()
        command = ["mount", "-t", "tmpfs", "-o", f"size={size_kib}k,mode=755", "tmpfs", str(folder)]
        if sys.platform != "linux" or os.geteuid() != 0 or subprocess.run(command, capture_output=True).returncode:
            pytest.skip("no small file system can be mounted")
        return folder

    yield mount
    if folder.is_mount():
        subprocess.run(["umount", str(folder)], check=True)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Chromium, driven by playwright."""
    playwright = pytest.importorskip("playwright.sync_api")
    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if chromium is None:
        pytest.skip("no chromium, chromium-browser or google-chrome on the path")
    with playwright.sync_playwright() as play:
        browser = play.chromium.launch(
            executable_path=chromium, args=["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        )
        yield browser
        browser.close()
