"""Imports run one way, the runtime stays light, and the house keeps its size."""

from __future__ import annotations

import ast
import functools
import graphlib
import re
import subprocess
import sys
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

from checkout import REPOSITORY, files

PACKAGES = {
    "edgeperc.zoo": REPOSITORY / "models",
    "edgeperc": REPOSITORY / "edgeperc",
    "edgeperc_export": REPOSITORY / "export",
    "edgeperc_bench": REPOSITORY / "bench",
}

# A module imports from the lines above its own, never from its own line. A new module gets its place here.
FLOORS = {
    "edgeperc": """
        errors
        system.__init__ system.clock system.extras system.fields system.interpreter
        system.atomic system.lanes system.names
        system.printable
        system.machine system.remote
        system.pool
        system.ray_cluster
        system.compiling system.kernel_stamp
        system.kernel_cache
        system.kernels
        system.compilation system.draws types.points
        types.rigid
        types.__init__ types.choices types.mounting types.onnx_file types.views
        types.detector
        types.card types.sensor
        types.perception
        types.frame types.geometry
        ground.observed ground.planes
        ground.__init__ ground.ceiling ground.leveling ground.scan
        objects.rectangles
        objects.__init__ objects.candidate_boxes objects.candidates objects.linkage objects.refine
        objects.cluster objects.crops
        objects.persons
        objects.boxes
        preprocess.__init__ preprocess.fitness preprocess.health preprocess.interpolation preprocess.returns
        preprocess.condition preprocess.ego preprocess.findings preprocess.motion
        preprocess.sensor_estimate
        preprocess.sensor_fit
        preprocess.remission
        tracking.imm tracking.jpda tracking.ukf
        tracking.egomotion tracking.lives
        tracking.tracks
        tracking.tracker
        tracking.smoothing
        tracking.__init__
        tracking.moving tracking.zones
        zoo.__init__
        agreement.__init__ agreement.votes
        agreement.rules
        agreement.cells
        camera.__init__ camera.calibration camera.image
        camera.painting
        inference.__init__ inference.box_heads inference.crop inference.pillars inference.projection inference.providers
        inference.decode inference.detections inference.listing
        inference.session
        inference.object_network inference.pillar_network inference.sessions
        road.__init__ road.around road.outline
        road.ahead road.grid
        road.rolling road.sweeps
        pipeline
        readers.units
        readers.__init__ readers.origin readers.pcap readers.ports readers.scan_odometry readers.times readers.unknown
        readers.clouds readers.images readers.ouster readers.packets readers.tables
        readers.alternation readers.livox_packets readers.mems_packets readers.ouster_packets readers.spinning_packets
        readers.inflate readers.mirror_packets readers.pcd readers.ply readers.raw readers.senders
        readers.lidars readers.mcap readers.text
        readers.bags readers.files readers.packet_messages
        readers.decoders
        readers.identify readers.worker
        readers.apart
        readers.captures
        records
        simulation.ray_draws
        simulation.raycast
        simulation.scene simulation.shapes
        simulation.vehicles simulation.weather
        simulation.people
        simulation.street
        simulation.camera simulation.roadside
        simulation.drawn simulation.halls simulation.layouts simulation.yards
        simulation.__init__ simulation.samples
        view.colors
        view.canvas view.content
        view.files view.page view.picture view.tracks
        view.painted
        view.__init__
        datasets.__init__ datasets.annotations datasets.images datasets.parquet datasets.pickled datasets.splits
        datasets.kitti datasets.layout
        datasets.tree
        datasets.kitti_trees datasets.once datasets.waymo
        datasets.trees
        datasets.scan_folder
        live warm_up
        perceiver
        evaluation.__init__ evaluation.metrics evaluation.mistakes evaluation.painting
        evaluation.tracking_metrics
        evaluation.ab3dmot evaluation.causes evaluation.center_ap evaluation.headings evaluation.kitti_ap
        evaluation.predictions evaluation.tables
        evaluation.truth
        evaluation.judge
        evaluation.camvid evaluation.consistency evaluation.evaluate evaluation.tracking evaluation.transfer
        ros2.__init__ ros2.graph ros2.messages
        ros2.odometry
        ros2.node ros2.rclpy_graph ros2.zenoh_graph
        sinks.__init__ sinks.relay sinks.run_file sinks.scene
        sinks.foxglove sinks.page sinks.prelabels sinks.rerun sinks.rosbag sinks.static
        cli.arguments cli.evaluation.__init__ cli.output cli.straighten
        cli.completion cli.doctor cli.evaluation.box_tables cli.evaluation.painting cli.evaluation.unlabeled
        cli.lists cli.program
        cli.report cli.scans cli.sinks
        cli.scan_times
        cli.cvat cli.evaluation.sensors cli.fit_sensor cli.info cli.outputs cli.side_by_side
        cli.evaluation.scans cli.run
        cli.demo cli.evaluation.tracking cli.ros2
        cli.main
        cli.__init__
        __main__
        __init__
    """,
    "edgeperc_export": """
        data.__init__ data.processes data.scans data.targets
        data.beams data.roads data.simulate
        data.augment data.scan_sets
        recipe
        cards
        networks.objects networks.pointseg networks.ssadnet
        networks.camseg networks.edge networks.lodnn networks.pointpillars networks.resnets networks.salsanext
        networks.segnet networks.squeezesegv2 networks.unet
        networks.fcn
        networks.__init__
        training.__init__ training.bfloat16 training.checkpoint training.log training.losses
        training.object_task training.ranks
        training.camera training.object_samples training.start training.task
        training.images training.object_sets training.teacher
        training.object_batches training.samples
        training.sources
        training.train
        training.ablation training.camvid
        release.__init__ release.int8_graph release.models_page release.object_graph release.object_parity
        release.thinned release.triton_model
        release.to_onnx release.triton
        release.quantize
        release.agree release.object_int8
        database.__init__ database.files
        database.coco database.folds database.torch
        database.label_page database.scenes
        database.build
        database.cli
        make
        cli
        __init__
    """,
    "edgeperc_bench": """
        application conditions context inputs options samples scenarios
        document loadgen render start
        plots report surroundings worker
        accuracy
        measure robots solid_state
        peers.__init__ peers.arithmetic peers.networks peers.rounds
        peers.engines peers.ground peers.pillars peers.projection peers.slam peers.tracking
        peers.camera peers.family peers.numpy_pipeline
        peers.contenders
        peers.tables
        peers.turns
        commands.__init__ commands.common commands.compare
        commands.matrix commands.peers commands.run commands.scaling commands.soak
        cli
        __init__
    """,
}

NEVER = {"edgeperc_bench", "edgeperc_export", "onnx", "pydantic", "scipy", "torch", "yaml"}
NEEDED = {"edgeperc", "llvmlite", "numba", "numpy", *sys.stdlib_module_names}
RIVALS = "edgeperc_bench.peers."
TALK_TO_ONNXRUNTIME = {"edgeperc.inference.providers", "edgeperc.inference.session"}
# Names with an underscore of argparse, named tuples, numba and ouster-sdk that tests use.
OF_OTHERS = {"_512x10", "_actions", "_choices_actions", "_replace", "_cache", "_defined_symbols", "_engine"}
# Where a name may begin with one underscore; without any, a file need not be parsed.
PRIVATE = re.compile(r"(?<!\w)_(?!_)\w|\._\b")
# Functions that are lists of options.
LONG_BODIES = {"add_parser"}
MANY_PARAMETERS = {("edgeperc.perceiver", "__init__")}
# File names that occur more than once: how often, and why.
SAME_NAME = {
    "camera": (3, "the camera's networks measured, simulated, trained"),
    "camvid": (2, "the data set evaluated, trained on"),
    "cli": (3, "one a program"),
    "files": (3, "the files of readers, of pictures, of the database"),
    "images": (3, "images read, labeled, trained on"),
    "page": (2, "the page, and the sink that writes it"),
    "painting": (3, "painting, its evaluation, the command of that"),
    "pillars": (2, "a detector's input, its rivals' input"),
    "projection": (2, "the projection, and its rivals"),
    "report": (2, "of a scan, of a benchmark"),
    "run": (2, "a command of two programs"),
    "samples": (3, "of the simulation, of the training, of times"),
    "scans": (3, "scans of a command, of its evaluation, of the training"),
    "scene": (2, "simulated, shown by viewers"),
    "start": (2, "of a benchmark, of the training"),
    "tables": (3, "of figures, of rivals, of capture files"),
    "tracking": (3, "its evaluation, the command of that, its rivals"),
    "tracks": (2, "tracks, and how they are drawn"),
    "worker": (2, "a process that decodes, one that measures"),
}
# Packages of the runtime that only tools import.
WINGS = {"edgeperc.datasets", "edgeperc.evaluation", "edgeperc.simulation"}


@functools.cache
def modules() -> dict[str, Path]:
    """Every module of the three packages by its dotted name; a package's own is called ``__init__``."""
    found = {}
    for package, folder in PACKAGES.items():
        for path in files(".py", str(folder.relative_to(REPOSITORY))):
            found[".".join([package, *path.relative_to(folder).with_suffix("").parts])] = path
    return found


@functools.cache
def tree_of(name: str) -> ast.Module:
    return ast.parse(modules()[name].read_text("utf-8"))


RUNTIME = sorted(name for name in modules() if name.startswith("edgeperc."))


def last_name(node: ast.expr) -> str:
    """Of a name or an attribute."""
    return str(getattr(node, "attr", getattr(node, "id", "")))


@functools.cache
def nodes(tree: ast.AST, running: bool = False) -> tuple[ast.AST, ...]:
    """Of a module, kept, for most tests here look at each; ``running``: without what only type checkers read."""
    found, pending = [], [tree]
    while pending:
        node = pending.pop()
        if not (running and isinstance(node, ast.If) and last_name(node.test) == "TYPE_CHECKING"):
            found.append(node)
            pending.extend(ast.iter_child_nodes(node))
    return tuple(found)


def imported(name: str, tree: ast.AST, running: bool = False) -> Iterator[str]:
    """Absolute dotted names of everything that a module imports, inside functions too."""
    for node in nodes(tree, running):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = name.split(".")[: -node.level] if node.level else []
            assert above or not node.level, f"line {node.lineno}: a relative import that leaves the package"
            origin = ".".join(filter(None, [*above, node.module]))
            yield from (f"{origin}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Call) and last_name(node.func).endswith(("import_module", "__import__", "require")):
            yield from (str(name.value) for name in node.args[:1] if isinstance(name, ast.Constant))


def packages_imported(name: str, tree: ast.AST) -> set[str]:
    """Top-level names of what a module imports."""
    return {dotted.partition(".")[0] for dotted in imported(name, tree)}


@functools.cache
def own_imports(name: str, running: bool = False) -> set[str]:
    """Modules of the three packages that a module imports, for its types, too, unless ``running``."""
    known, found = modules(), set()
    for dotted in imported(name, tree_of(name), running):
        parent = dotted.rpartition(".")[0]
        candidates = (dotted, f"{dotted}.__init__", parent, f"{parent}.__init__")
        found |= {next((each for each in candidates if each in known), name)}
    # The packages' faces hand names on without importing what they name.
    return found - {name, "edgeperc.__init__"}


def unit_of(name: str) -> str:
    """The top-level module or package that a module belongs to."""
    return ".".join(name.split(".")[:2])


@functools.cache
def floor_of(name: str) -> int:
    """The line of `FLOORS` that a module stands on."""
    package, _, inside = name.partition(".")
    floors = [line.split() for line in FLOORS[package].strip().splitlines()]
    found = [k for k, line in enumerate(floors) if inside in line]
    assert len(found) == 1, f"{name} stands on {len(found)} lines of FLOORS[{package!r}]; give it one"
    return found[0]


def at_import(tree: ast.Module) -> Iterator[ast.stmt]:
    """Statements that run when a module is imported: everything outside functions."""
    pending: list[ast.stmt] = list(tree.body)
    while pending:
        statement = pending.pop()
        if isinstance(statement, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        yield statement
        pending.extend(child for child in ast.walk(statement) if isinstance(child, ast.stmt) and child is not statement)


def test_floors_list_all_modules() -> None:
    named = {f"{package}.{inside}" for package, floors in FLOORS.items() for inside in floors.split()}
    assert named == {*modules()}


def test_imports_run_one_way() -> None:
    """Down the floors of its package; ``export`` and ``bench`` stand on the runtime, and the rivals on ``export``."""
    for name in modules():
        package = name.partition(".")[0]
        may = {"edgeperc": set(), "edgeperc_export": {"edgeperc"}, "edgeperc_bench": {"edgeperc"}}[package]
        if name.startswith(RIVALS):
            may = {"edgeperc", "edgeperc_export"}
        for other in own_imports(name):
            if other.partition(".")[0] == package:
                assert floor_of(other) < floor_of(name), f"{name} imports {other}, which stands no lower"
            else:
                assert other.partition(".")[0] in may, f"{name} imports {other}"


def test_no_import_cycles() -> None:
    graph = {name: own_imports(name) for name in modules() if name != "edgeperc.__init__"}
    assert list(TopologicalSorter(graph).static_order())  # raises CycleError, which names the cycle


def test_only_tools_import_the_wings() -> None:
    """Data sets, simulation and evaluation are for tools; no part of what perceives a scan imports them."""
    for name in RUNTIME:
        if unit_of(name) not in {*WINGS, "edgeperc.cli"}:
            assert not {unit_of(other) for other in own_imports(name)} & WINGS, name


def test_private_names_stay_in_their_module() -> None:
    for name in modules():
        for node in nodes(tree_of(name)):
            if isinstance(node, ast.ImportFrom) and (node.level or str(node.module).startswith("edgeperc")):
                private = [alias.name for alias in node.names if alias.name.startswith("_") and alias.name[1] != "_"]
                assert not private, f"{name} imports {private} of {node.module}"


def test_tests_use_public_names() -> None:
    """What a test needs of a module has a name without an underscore."""
    others = {"argparse", "core", "os", "sys", "self", "cls"}
    reached = []
    for path in files(".py", "tests"):
        text = path.read_text("utf-8")
        for node in ast.walk(ast.parse(text)) if PRIVATE.search(text) else ():
            names: list[str] = []
            if isinstance(node, ast.ImportFrom) and str(node.module).startswith("edgeperc"):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.Attribute) and node.attr[0] == "_" and ast.unparse(node.value) not in others:
                names = [node.attr]
            elif isinstance(node, ast.Call) and last_name(node.func).endswith(("setattr", "object", "multiple")):
                names = [str(a.value).rpartition(".")[2] for a in node.args[:2] if isinstance(a, ast.Constant)]
                names += [str(keyword.arg) for keyword in node.keywords]
            private = {each for each in names if each.startswith("_") and each[1:2] != "_"} - OF_OTHERS
            reached += [f"{path.name}:{node.lineno} {each}" for each in private]
    assert not reached


def test_the_listing_explains_the_system() -> None:
    """At most eight modules lie directly in the package; all others are in packages that name the data flow."""
    flat = [name for name in RUNTIME if name.count(".") == 1 and modules()[name].parent.name == "edgeperc"]
    assert len(flat) <= 8, flat
    units = {unit_of(name) for name in RUNTIME}
    edges = {(unit_of(name), unit_of(other)) for name in RUNTIME for other in own_imports(name)}
    edges = {(one, other) for one, other in edges if one != other}
    assert len(units) <= 27
    assert len(edges) <= 165
    below: dict[str, set[str]] = {unit: set() for unit in units}
    for name in RUNTIME:
        below[unit_of(name)] |= {unit_of(other) for other in own_imports(name, running=True)} - {unit_of(name)}
    layers: dict[str, int] = {}
    for unit in graphlib.TopologicalSorter(below).static_order():
        layers[unit] = 1 + max((layers[other] for other in below[unit]), default=0)
    assert max(layers.values()) <= 11, sorted((n, u) for u, n in layers.items())


def test_files_have_at_most_750_lines() -> None:
    for name in modules():
        assert modules()[name].read_text("utf-8").count("\n") <= 750, name


def functions(tree: ast.AST) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    for node in nodes(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield node


def n_parameters(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Without `self` and `cls`."""
    of = function.args
    names = [each.arg for each in (*of.posonlyargs, *of.args, *of.kwonlyargs, *filter(None, (of.vararg, of.kwarg)))]
    return len(names) - (names[:1] in (["self"], ["cls"]))


def test_functions_are_small() -> None:
    """Bodies of at most 80 lines without the docstring, at most 12 parameters; kernels have at most 8."""
    for name in modules():
        tree = tree_of(name)
        compiled = {kernel.name for kernel, _ in kernels(tree)}
        for function in functions(tree):
            body = function.body[ast.get_docstring(function) is not None :]
            n_lines = int(body[-1].end_lineno or 0) - body[0].lineno + 1 if body else 0
            where, n = f"{name}.{function.name}", n_parameters(function)
            assert n_lines <= 80 or function.name in LONG_BODIES, f"{where} has a body of {n_lines} lines"
            most = 8 if function.name in compiled else 12
            assert n <= most or (name, function.name) in MANY_PARAMETERS, f"{where} has {n} parameters"


def test_a_file_name_occurs_once() -> None:
    """A name says which module is meant; two of one name are two sides of one thing, or stand here with the reason."""
    folders: dict[str, list[str]] = {}
    for name in modules():
        folder, _, file = name.rpartition(".")
        folders.setdefault(file, []).append(folder)
    twice = {file: names for file, names in folders.items() if len(names) > 1 and file != "__init__"}
    assert {file: len(names) for file, names in twice.items()} == {file: n for file, (n, _) in SAME_NAME.items()}


def test_the_runtime_is_light() -> None:
    for name in RUNTIME:
        tree = tree_of(name)
        packages = packages_imported(name, tree)
        assert not packages & NEVER, name
        assert name in TALK_TO_ONNXRUNTIME or "onnxruntime" not in packages, f"{name}: {TALK_TO_ONNXRUNTIME} talk to it"
        for statement in at_import(tree):
            if isinstance(statement, ast.Import | ast.ImportFrom):
                others = packages_imported(name, statement) - NEEDED
                assert not others, f"{name}, line {statement.lineno}: import {others} where it is used"


def test_the_tests_of_what_loads_extras_run_without_them() -> None:
    """By ``make test-minimal``. `evaluation` draws, and its tests of that are skipped without matplotlib."""
    loading = {name for name in RUNTIME if packages_imported(name, tree_of(name)) - NEEDED - {"onnxruntime"}}
    lines = (REPOSITORY / "Makefile").read_text().splitlines()
    (run,) = (line.partition("= ")[2].split() for line in lines if "LOADING = " in line)
    assert {name.split(".")[1] for name in loading} == {*run, "evaluation"} - {"bench"}
    for name in " ".join(line.partition("= ")[2] for line in lines if "ALIKE " in line.partition("= ")[0]).split():
        taken = {*imported(name, ast.parse((REPOSITORY / f"tests/{name}.py").read_text("utf-8")))}
        taken |= {dotted.rpartition(".")[0] for dotted in taken}
        assert not taken & loading - {"edgeperc.cli.output"}, name  # its bar is drawn in tests/cli/test_cli.py


def test_library_code_leaves_the_process_alone() -> None:
    """No exit, no print and no logging set-up outside the command line."""
    # The one puts back the handler that ray.init replaces, the other's calls are in its worker processes.
    own = {"edgeperc.system.ray_cluster": {"signal.signal"}, "edgeperc.system.pool": {"signal.signal", "os._exit"}}
    others = {"signal.signal", "print", "exit", "quit", "sys.exit", "os._exit", "logging.basicConfig"}
    for name in RUNTIME:
        if not name.startswith("edgeperc.cli.") and name != "edgeperc.__main__":
            calls = {ast.unparse(node.func) for node in nodes(tree_of(name)) if isinstance(node, ast.Call)}
            assert not (others - own.get(name, set())) & calls, name


def test_bench_imports_only_the_runtime() -> None:
    """It measures what a vehicle installs: nothing of training, and what draws or drives it only where asked for.

    Rivals stand on what they stand on, but only when they are asked for too.
    """
    rivals = {"edgeperc_export", "onnx", "onnxruntime", "openvino", "scipy", "torch"}
    for name in (name for name in modules() if name.startswith("edgeperc_bench.")):
        tree = tree_of(name)
        assert name.startswith(RIVALS) or not packages_imported(name, tree) & rivals, name
        for statement in at_import(tree):
            if isinstance(statement, ast.Import | ast.ImportFrom):
                assert not packages_imported(name, statement) & ({"matplotlib", "mlperf_loadgen"} | rivals), name


def kernels(tree: ast.Module) -> Iterator[tuple[ast.FunctionDef, ast.expr]]:
    """Functions under numba's decorator, each with it."""
    for node in nodes(tree):
        if isinstance(node, ast.FunctionDef):
            for decorator in node.decorator_list:
                bare = decorator.func if isinstance(decorator, ast.Call) else decorator
                if ast.unparse(bare).rpartition(".")[2] in {"guvectorize", "jit", "njit", "vectorize"}:
                    yield node, decorator


def test_kernels_follow_the_conventions() -> None:
    """Cached, without the GIL; never parallel (aborts the process when two threads call) or fastmath (drops guards)."""
    for name in RUNTIME:
        for kernel, decorator in kernels(tree_of(name)):
            where = f"{name}.{kernel.name}"
            assert isinstance(decorator, ast.Call), f"{where}: write @njit(cache=True, nogil=True)"
            options = {keyword.arg: ast.unparse(keyword.value) for keyword in decorator.keywords}
            assert options.get("cache") == options.get("nogil") == "True", f"{where}: {options}"
            assert not options.keys() & {"fastmath", "parallel"}, f"{where}: {options}"


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
