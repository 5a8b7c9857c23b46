"""Run networks, from their input to their raw outputs. This is the only module that imports onnxruntime.

There is no silent fallback: if a requested provider is absent, or would leave part of the graph to another provider,
construction raises `ProviderError`. ``"auto"`` takes the setting that was measured to be the fastest on this computer
(``edgeperc-bench matrix --recommend``), else the first of `AUTO` that runs the whole model and reproduces the card's
golden outputs. `edgeperc.zoo.choose` selects the variant of a network and its precision.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from types import MappingProxyType
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from ..errors import (
    CardError,
    CardMismatchError,
    EdgepercError,
    InferenceError,
    ModelFileError,
    ProviderError,
    SettingsError,
)
from ..system.fields import OPTIONS
from ..system.interpreter import kept_in_forks, native_call
from ..system.machine import (
    MAX_THREADS,
    compiled_folder,
    cpu_features,
    fingerprint,
    keep_compiled,
    read_setting,
    settings_path,
    usable_cores,
)
from ..system.printable import printable
from ..types.card import ModelCard
from ..types.detector import PillarGeometry
from ..types.onnx_file import TRUST, check_graph, read_model
from ..types.points import Floats32
from ..types.views import CameraGeometry, ObjectGeometry
from ..zoo import Variant, choose, digest, resolve
from .decode import fill_pixels
from .providers import (
    AUTO,
    PLUGINS,
    PROVIDERS,
    SHARING,
    available_providers,
    check_names,
    is_available,
    is_of_engine,
    load_onnxruntime,
    plugin_devices,
    recompiles,
)

logger = logging.getLogger(__name__)

# Largest accepted deviation, in standard deviations of an output. The same graph in fp32 differs by 1e-5 between
# engines; tripled weights of one layer give 0.5.
MAX_GOLDEN_DEVIATION = {"fp32": 0.02, "bf16": 0.5, "int8": 0.5}
# Share of the golden values that must be within that deviation. If two maxima in max-pooling differ only by rounding,
# engines may unpool to either one, and a few pixels differ from there on.
GOLDEN_SHARE = 0.9
# Candidates of one run of an object network, and of its golden input.
MAX_ROWS, GOLDEN_ROWS = 256, 16
# Of a detector's inputs beside the points: onnxruntime's names of the types that a graph may take.
WHOLE = {"int32": np.int32, "int64": np.int64, "float": np.float32}
IN_FLOAT32 = (
    "export the graph again with inputs and outputs in float32; weights may stay in half precision (keep_io_types=True "
    "of onnxconverter_common.float16)"
)
"""What to do with a graph that takes or gives other types."""
# The largest network of this project takes 0.2 s on one core of a server.
MAX_FIRST_RUN_S = 30.0


_Attempt = tuple[str, Variant, str, int | None]
"""Provider, variant, precision and number of threads."""


class Session:
    """One network, loaded, checked against its card and warmed up, with buffers of its own.

    model, provider, precision, n_threads, trusted : as in `edgeperc.Perceiver`, for one network.
    at_once : number of sessions that run at the same time. If it is above 1 and ``n_threads`` is None, the providers
        ``cpu`` and ``openvino`` get as large a part of the usable cores, or fewer if fewer were measured.

    Raises OptionError, ModelFileError, CardError, CardMismatchError, ProviderError, MissingExtraError, and
    InferenceError if the first run failed.

    It belongs to its process. A forked child may drop it and end. It runs there only with ``provider="cpu"`` and
    ``n_threads=1``: the threads of a provider do not exist there, and waiting for them would never end. It cannot be
    pickled.

    ``input`` takes the network's input before `run`: (C, H, W); of an object network (`MAX_ROWS`, points, channels), a
    row for each candidate; of a detector (pillars, points, channels), whose inputs by name are ``inputs``. ``outputs``
    are by output kind, of a detector by name, without the batch axis, and overwritten by every `run`; values of blocks
    are written to their pixels (`OutputSpec`), ``raw`` has them as the graph gives them. ``short`` and ``provider`` are
    the active one as a key of `PROVIDERS` and as onnxruntime calls it, ``precision`` is the active one, ``digest`` the
    key of the network's measured settings (`edgeperc.zoo.digest`), ``options`` are for reports. ``golden_deviation`` is
    that of the outputs for the card's golden input from the exporter's, in standard deviations (90th percentile); NaN
    if the card has none, which is logged as a warning.
    """

    def __init__(
        self,
        model: str | os.PathLike[str],
        provider: str = "auto",
        *,
        precision: str = "auto",
        n_threads: int | None = None,
        at_once: int = 1,
        trusted: bool = False,
    ) -> None:
        if n_threads is not None:
            n_threads = OPTIONS.whole("n_threads", n_threads, 1, MAX_THREADS)
        check_names(provider, precision)
        self._trusted, self._at_once = trusted, at_once if n_threads is None else 1
        self._made_in, self._running_in = os.getpid(), 0
        ort = load_onnxruntime()
        variants = resolve(model)
        self.digest = digest(variants)
        attempts = self._attempts(variants, provider, precision, n_threads)
        for attempt in attempts:
            try:
                self._prepare(ort, *attempt)
                break
            except (CardMismatchError, InferenceError, ProviderError) as exc:
                if attempt == attempts[-1]:
                    raise
                short, _, runs_in, _ = attempt
                logger.warning("provider auto skips %s on %s in %s: %s", variants[0].name, short, runs_in, exc)

    def _attempts(
        self, variants: Sequence[Variant], provider: str, precision: str, n_threads: int | None
    ) -> list[_Attempt]:
        """The settings to try, in this order: one, or several if provider or precision is "auto"."""
        features = cpu_features()
        candidates = [(provider, precision, n_threads)]
        if provider == "auto":
            fit = [short for short in available_providers() if not recompiles(short, variants[0].card.view.kind)]
            candidates = [(short, precision, n_threads) for short in AUTO if short in fit]
            candidates = [*self._measured_best(variants[0].name, precision, n_threads, fit), *candidates]
        elif not is_available(provider):
            raise ProviderError(
                f"provider {provider!r} is not available on this computer (present: "
                f"{', '.join(available_providers())}); "
                "install its onnxruntime build or plugin, or choose one that is present"
            )
        attempts: list[_Attempt] = []
        refusal = None
        for short, wanted, threads in candidates:
            try:
                variant, runs_in = choose(variants, short, wanted, features)
            except ProviderError as exc:
                refusal = exc
                continue
            attempts.append((short, variant, runs_in, threads))
            if precision == "auto" and runs_in != "fp32" and variants[0].precision == "fp32":
                attempts.append((short, variants[0], "fp32", threads))
        if not attempts:
            raise refusal or ProviderError(f"none of {', '.join(AUTO)} is available; install edgeperc[cpu]")
        return attempts

    def _measured_best(
        self, name: str, precision: str, n_threads: int | None, fit: Sequence[str]
    ) -> list[tuple[str, str, int | None]]:
        """The fastest provider, precision and threads measured on this computer; empty if none was measured."""
        try:
            setting = read_setting(settings_path(), fingerprint(), self.digest)
        except SettingsError as exc:
            logger.warning("provider auto cannot read the settings measured on this computer: %s", exc)
            return []
        if setting is None or precision not in ("auto", setting["precision"]):
            return []
        if setting["provider"] not in fit:
            logger.warning(
                "provider auto skips %s on %s, which was measured as the fastest: it is no longer available, or "
                "compiles this network anew for many scans",
                *(name, printable(setting["provider"][:80])),
            )
            return []
        return [(setting["provider"], setting["precision"], setting["n_threads"] if n_threads is None else n_threads)]

    def _prepare(self, ort: Any, short: str, variant: Variant, precision: str, n_threads: int | None) -> None:
        self.path, self.card = variant.path, variant.card
        self.short, self.provider, self.precision = short, PROVIDERS[short], precision
        blob = read_model(self.path)
        folds = check_graph(blob, self.path, trusted=self._trusted)
        if not folds and short not in ("cpu", "cuda"):
            raise ProviderError(
                f"{self.path}: it computes sizes from constants alone, which provider {short!r} would do while it "
                f"opens the file, where nothing can stop it; choose provider 'cpu', or {TRUST}"
            )
        self.sha256 = hashlib.sha256(blob).hexdigest()
        cores = usable_cores()
        self.shares_cores = short in SHARING and 1 < self._at_once <= cores
        if self.shares_cores:  # the most threads of a network that was measured alone would let the others wait
            n_threads = min(n_threads or cores, cores // self._at_once)
        elif n_threads is None and short in SHARING and cores < (os.cpu_count() or 1):
            n_threads = cores  # a provider counts the computer's: two threads on one core took 57 in place of 39 ms
        self._has_threads = short != "cpu" or n_threads != 1
        self._opened_with = short, precision, n_threads, folds
        with native_call():
            self.inference = kept_in_forks(self._open(ort, blob, *self._opened_with))
        self._check_graph()
        with terminated(ort, None if self._trusted else MAX_FIRST_RUN_S) as run_options:
            self._bind(run_options)
            self.golden_deviation = self.warm_up(MAX_GOLDEN_DEVIATION[precision], run_options)

    @property
    def description(self) -> str:
        """The active network, precision and provider: ``"pointseg int8, CPUExecutionProvider"``."""
        return f"{self.card.name} {self.precision}, {self.provider}"

    def _open(
        self,
        ort: Any,
        blob: bytes,
        short: str,
        precision: str,
        n_threads: int | None,
        folds: bool,
        constants: Mapping[str, Any] = MappingProxyType({}),
    ) -> Any:
        options = ort.SessionOptions()
        for name, value in constants.items():
            options.add_initializer(name, value)
        options.log_severity_level = 4
        options.inter_op_num_threads = 1
        options.use_deterministic_compute = True
        if n_threads is not None:
            options.intra_op_num_threads = n_threads
        # The memory pattern would be allocated in addition to the blocks of the first run: 38 and 54 MB more, not
        # faster.
        options.enable_mem_pattern = False
        # Threads that spin between two runs occupy the cores that the Perceiver's other network needs: both networks in
        # turn took 357 ms with spinning and 290 ms without. Within a run, threads may spin.
        entries = {"session.force_spinning_stop": "1"}
        if short != "cpu":
            # Running part of the graph on the CPU provider would be a silent fallback.
            entries["session.disable_cpu_ep_fallback"] = "1"
        for key, value in entries.items():
            options.add_session_config_entry(key, value)
        plugin = plugin_devices(ort, short) if short in PLUGINS else []
        # If a provider fails, onnxruntime takes others and prints to stdout; before 1.23 no argument forbids it.
        refuse = property(lambda _: False, lambda *_: None)
        network = type("Network", (ort.InferenceSession,), {"_enable_fallback": refuse})
        settings: dict[str, str] = {}
        compiled = None
        try:
            if plugin:
                if short == "openvino":
                    hint = "bf16" if precision == "bf16" else "f32"  # layers that are not int8 run in fp32
                    cpu = {"INFERENCE_PRECISION_HINT": hint, "PERFORMANCE_HINT": "LATENCY"}
                    if n_threads is not None:
                        cpu["INFERENCE_NUM_THREADS"] = str(n_threads)
                    if self.shares_cores:  # else the threads of both sessions are tied to the same cores
                        cpu["ENABLE_CPU_PINNING"] = "NO"
                    engine = f"onnxruntime {ort.__version__}, {version(PLUGINS[short])}"
                    compiled = compiled_folder(engine, self.sha256, precision)
                    if compiled is not None:
                        cpu["CACHE_DIR"] = str(compiled)
                    settings["load_config"] = json.dumps({"CPU": cpu})
                elif short == "qnn":
                    settings["htp_performance_mode"] = "burst"  # its default clocks the NPU down between two scans
                options.add_provider_for_devices(plugin[:1], settings)
                session = network(blob, options)
            else:
                unused = [] if folds else ["ConstantFolding"]
                session = network(blob, options, [PROVIDERS[short]], disabled_optimizers=unused)
            session.disable_fallback()  # of runs, if a newer version names its attribute otherwise
            for each in (*session.get_inputs(), *session.get_outputs()):
                _ = each.name, each.shape  # fails if one is not UTF-8
        except Exception as exc:
            if not is_of_engine(exc):
                raise
            if short == "cpu":
                raise ModelFileError(f"{self.path}: onnxruntime {ort.__version__} cannot open it: {exc}") from exc
            raise ProviderError(f"{self.path}: provider {short!r} cannot run this model: {exc}") from exc
        threads = "the provider's choice" if n_threads is None else str(n_threads)
        self.options = {"threads": threads, "deterministic": "1", **entries, **settings}
        active = session.get_providers()
        if active[0] != PROVIDERS[short]:
            raise ProviderError(f"{self.path}: asked for {PROVIDERS[short]}, onnxruntime made {active} active")
        if compiled is not None:
            keep_compiled(compiled)
        return session

    def _check_graph(self) -> None:
        card = self.card
        inputs = {i.name: i for i in self.inference.get_inputs()}
        outputs = {o.name: o for o in self.inference.get_outputs()}
        expected = input_shapes(card)
        if set(inputs) != set(expected):
            named = f"input {card.input.name!r}" if len(expected) == 1 else f"inputs {list(expected)}"
            raise CardMismatchError(f"{self.path}: card names {named}, the graph has {list(inputs)}")
        for name, shape in expected.items():
            self._match(name, inputs[name], shape, ("float",) if name == card.input.name else tuple(WHOLE))
        for output in card.outputs:
            if output.name not in outputs:
                raise CardMismatchError(
                    f"{self.path}: card names output {output.name!r}, the graph has {list(outputs)}"
                )
            self._match(output.name, outputs[output.name], self.card.shape_of(output))

    def _match(
        self, name: str, node: Any, expected: tuple[int | None, ...], types: tuple[str, ...] = ("float",)
    ) -> None:
        shape = tuple(node.shape)
        # A graph may leave a dimension open (a name or None); the first run then checks the shape.
        fits = len(shape) == len(expected) and all(
            e is None or not isinstance(s, int) or s == e for s, e in zip(shape, expected, strict=True)
        )
        is_of_type = node.type in [f"tensor({each})" for each in types]
        if not fits or not is_of_type:
            raise CardMismatchError(
                f"{self.path}: {name!r} is {node.type} of shape {shape} in the graph; its card declares "
                f"tensor({' or '.join(types)}) of shape {expected} (None: any)"
                + ("" if is_of_type else f"; {IN_FLOAT32}")
            )

    def _bind(self, run_options: Any) -> None:
        card = self.card
        n_rows = card.view.max_pillars if isinstance(card.view, PillarGeometry) else MAX_ROWS
        batch = np.zeros([n_rows if n is None else n for n in card.input_shape], np.float32)
        self.binding = self.inference.io_binding()
        self.raw: dict[str, Floats32] = {}
        self.outputs: dict[str, Floats32] = {}
        self._batch = batch  # the binding holds a bare pointer
        self._pillars = isinstance(card.view, PillarGeometry)
        self._has_rows = card.input_shape[0] is None
        self.inputs: dict[str, NDArray[Any]] = {}
        if self._pillars:
            self._bind_pillars(run_options)
            return
        self.input: Floats32 = batch if self._has_rows else batch[0]
        if self._has_rows:
            for output in card.outputs:
                shape = card.output_shape(output.kind)
                self.raw[output.kind] = self.outputs[output.kind] = np.zeros((MAX_ROWS, *shape[1:]), np.float32)
            return
        for output, shape in zip(card.outputs, self._shapes({card.input.name: batch}, run_options), strict=True):
            if isinstance(card.view, CameraGeometry) and (card.view.height % shape[2] or card.view.width % shape[3]):
                raise CardMismatchError(
                    f"{self.path}: {output.name!r} has shape {shape}; expected rows and columns that divide the view's "
                    f"{card.view.height} and {card.view.width}"
                )
            self._bind_output(output.name, output.kind, shape)
            if output.block != (1, 1):
                assert not isinstance(card.view, ObjectGeometry)  # whose outputs have no blocks
                pixels = (len(card.classes), card.view.height, card.view.width)
                self.outputs[output.kind] = np.zeros(pixels, np.float32)
        self._bound_input = (card.input.name, "cpu", 0, np.float32, batch.shape, batch.ctypes.data)

    def _bind_pillars(self, run_options: Any) -> None:
        """Buffers of a detector: as many rows as there are pillars, where the graph does not want all of them."""
        card, nodes = self.card, {each.name: each for each in self.inference.get_inputs()}
        for name, shape in input_shapes(card).items():
            kind = WHOLE[nodes[name].type.removeprefix("tensor(").removesuffix(")")]
            whole = (len(self._batch), *(n for n in shape[1:] if n is not None))
            self.inputs[name] = self._batch if name == card.input.name else np.zeros(whole, kind)
        self.input = self._batch
        declared = [nodes[name].shape[0] for name in self.inputs]
        self._all_rows = any(isinstance(n, int) for n in declared)
        wrong = [n for n in declared if isinstance(n, int) and n != len(self._batch)]
        if wrong:
            raise CardMismatchError(
                f"{self.path}: the graph takes {wrong[0]} pillars, its card declares view.max_pillars "
                f"{len(self._batch)}; expected the same number, or a graph that takes any"
            )
        n_rows = len(self._batch) if self._all_rows else 2
        feed = {name: array[:n_rows] for name, array in self.inputs.items()}
        for output, shape in zip(card.outputs, self._shapes(feed, run_options), strict=True):
            self._bind_output(output.name, output.name, shape)

    def _bind_output(self, name: str, key: str, shape: tuple[int, ...]) -> None:
        buffer = np.zeros(shape, np.float32)
        self.binding.bind_output(name, "cpu", 0, np.float32, buffer.shape, buffer.ctypes.data)
        self.raw[key] = self.outputs[key] = buffer[0]

    def _shapes(self, feed: Mapping[str, NDArray[Any]], run_options: Any) -> list[tuple[int, ...]]:
        """Shapes of the outputs, from the graph, or from a run if the graph leaves dimensions open."""
        declared = {o.name: tuple(o.shape) for o in self.inference.get_outputs()}
        shapes = [declared[o.name] for o in self.card.outputs]
        if all(isinstance(n, int) for shape in shapes for n in shape):
            return shapes
        try:
            with native_call():
                answers = self.inference.run([o.name for o in self.card.outputs], feed, run_options)
        except Exception as exc:
            if not is_of_engine(exc):
                raise
            raise InferenceError(f"{self.path}: the first run on {self.provider} failed: {exc}") from exc
        for output, answer in zip(self.card.outputs, answers, strict=True):
            expected = self.card.shape_of(output)
            if answer.ndim != len(expected) or any(
                e is not None and s != e for s, e in zip(answer.shape, expected, strict=True)
            ):
                raise CardMismatchError(
                    f"{self.path}: {output.name!r} has shape {answer.shape} after a run; its card declares {expected}"
                )
        return [answer.shape for answer in answers]

    def warm_up(self, limit: float, run_options: Any) -> float:
        """Run the golden input; return the largest deviation from the recorded answers."""
        golden, n_rows = self.card.golden, golden_shape(self.card)[0] if self._has_rows else 1
        if self._pillars:
            for name, array in golden_feed(self.card, 0 if golden is None else golden.seed).items():
                self.inputs[name][:n_rows] = array
        if golden is None:
            logger.warning(
                "the card of %s has no golden record: the outputs on %s are not compared with the exporter's",
                *(self.path, self.provider),
            )
            self.run_bound(n_rows, run_options)
            return float("nan")
        self._batch[:n_rows] = golden_input(golden.seed, golden_shape(self.card))
        if hashlib.sha256(self._batch[:n_rows].tobytes()).hexdigest() != golden.input_sha256:
            raise CardMismatchError(
                f"{self.path}: the golden input does not have the card's SHA-256; export the model again"
            )
        self.run_bound(n_rows, run_options)
        self.input[:] = 0.0
        deviation = 0.0
        for output in self.card.outputs:
            known = golden.outputs.get(output.name)
            here = self.raw[output.name if self._pillars else output.kind]
            here = (here[:n_rows] if self._has_rows and not self._pillars else here).reshape(-1)
            if known is None:
                raise CardMismatchError(f"{self.path}: the card's golden record lacks output {output.name!r}")
            try:
                golden.check_output(output.name, len(here))
            except CardError as exc:
                raise CardError(f"{self.path}: {exc}; export the model again") from exc
            here = here[np.asarray(known["positions"], np.int64)]
            apart = np.abs(here - np.asarray(known["values"], np.float32)) / max(float(known["std"]), 1e-6)
            typical = np.quantile(apart, GOLDEN_SHARE) if np.isfinite(here).all() else np.inf
            deviation = max(deviation, float(typical))
        if deviation > limit:
            raise CardMismatchError(
                f"{self.path}: on {self.provider} the golden input gives answers {deviation:.2g} standard deviations "
                "away from the exporter's; the file or the provider has changed the network"
            )
        return deviation

    def run(self, n_rows: int = 1) -> Mapping[str, Floats32]:
        """Run the network on `input`.

        ``n_rows``: of an object network, how many rows of `input`, from the first one on, hold candidates; 1 to
        `MAX_ROWS`. Of a detector, how many rows of `inputs` hold pillars, at least 1; the others may be overwritten.
        Returns mapping of str to ndarray: `outputs`, which the next run overwrites; of an object network, its first
        ``n_rows`` rows are new.
        Raises InferenceError.
        """
        here = os.getpid()
        if here != self._made_in and (self._has_threads or self._running_in not in (0, here)):
            raise InferenceError(
                f"{self.path}: this session was made in process {self._made_in}, whose threads do not exist in process "
                f"{here}; construct the Perceiver in the process that calls it. With provider 'cpu' and n_threads=1 it "
                "also works in a process that is forked between two calls"
            )
        self._running_in = here
        try:
            self.run_bound(n_rows)
        finally:
            self._running_in = 0
        return self.outputs

    def second(self) -> Session:
        """The same network with buffers of its own: two threads may run both sessions at the same time."""
        if self.short == "cpu":
            return self._twin(load_onnxruntime(), self.inference)
        second = self.with_constants()  # the others run one graph in one thread at a time
        second.run_bound(1)  # the first run takes longer
        return second

    def with_constants(self, **constants: float) -> Session:
        """The same network with scalars of its graph in place of those in the file, and with buffers of its own."""
        ort, blob = load_onnxruntime(), read_model(self.path)
        if hashlib.sha256(blob).hexdigest() != self.sha256:
            raise ModelFileError(f"{self.path} has changed since it was opened; construct the Perceiver again")
        # onnxruntime does not own them.
        values = {
            name: ort.OrtValue.ortvalue_from_numpy(np.array(each, np.float32)) for name, each in constants.items()
        }
        with native_call():
            inference = kept_in_forks(self._open(ort, blob, *self._opened_with, constants=values))
        return self._twin(ort, inference, _constants=values)

    def _twin(self, ort: Any, inference: Any, **others: Any) -> Session:
        """The same with another graph, and buffers of its own."""
        twin = object.__new__(Session)
        vars(twin).update(vars(self), inference=inference, **others)
        with terminated(ort, None) as run_options:
            twin._bind(run_options)
        return twin

    def spread(self) -> None:
        """Write the values of blocks in `raw` to their pixels in `outputs`; `run` does so."""
        for output in self.card.outputs:
            if output.block != (1, 1):
                fill_pixels(self.raw[output.kind], *output.block, self.outputs[output.kind])

    def __reduce__(self) -> NoReturn:
        raise EdgepercError(
            f"a session of {self.path} cannot be pickled or copied; construct a Perceiver or Session in each process"
        )

    def run_bound(self, n_rows: int, *run_options: Any) -> None:
        """One run on the bound buffers, of so many rows where the batch has rows."""
        try:
            # Bind before every run: a provider with its own memory copies the input only when it is bound.
            if self._pillars:
                for name, array in self.inputs.items():
                    # Of a pillar alone, OpenPCDet's graphs squeeze the axis away. The same one again changes nothing.
                    rows = array if self._all_rows else array[: max(n_rows, 2)]
                    rows[n_rows:] = rows[n_rows - 1]
                    self.binding.bind_input(name, "cpu", 0, rows.dtype, rows.shape, rows.ctypes.data)
            elif self._has_rows:
                array = self._batch[:n_rows]
                self.binding.bind_input(self.card.input.name, "cpu", 0, np.float32, array.shape, array.ctypes.data)
                for output in self.card.outputs:
                    array = self.raw[output.kind][:n_rows]
                    self.binding.bind_output(output.name, "cpu", 0, np.float32, array.shape, array.ctypes.data)
            else:
                self.binding.bind_input(*self._bound_input)
            with native_call():
                self.inference.run_with_iobinding(self.binding, *run_options)
        except Exception as exc:
            if not is_of_engine(exc):
                raise
            raise InferenceError(f"{self.path}: a run on {self.provider} failed: {exc}") from exc
        self.spread()


@contextmanager
def terminated(ort: Any, after_s: float | None) -> Iterator[Any]:
    """Run options with which onnxruntime stops between two operators after ``after_s`` seconds; None: never."""
    options = ort.RunOptions()
    options.log_severity_level = 4
    if after_s is None:
        yield options
        return
    timer = threading.Timer(after_s, setattr, (options, "terminate", True))
    timer.daemon = True
    timer.start()
    try:
        yield options
    except InferenceError as exc:
        if not options.terminate:
            raise
        raise InferenceError(
            f"{exc} (the first runs of a file that is not trusted may take {after_s:g} s); try again on an idle "
            f"computer, or {TRUST}"
        ) from exc
    finally:
        timer.cancel()


def input_shapes(card: ModelCard) -> dict[str, tuple[int | None, ...]]:
    """Shapes of the graph's inputs by name; None where any length is allowed."""
    shapes = {card.input.name: card.input_shape}
    if isinstance(card.view, PillarGeometry):
        shapes |= {card.view.num_points: (None,)} if card.view.num_points else {}
        shapes |= {card.view.coords: (None, 4)}
    return shapes


def golden_shape(card: ModelCard) -> tuple[int, ...]:
    """Shape of the input of a card's golden record; `GOLDEN_ROWS` candidates or pillars."""
    n_rows = min(GOLDEN_ROWS, card.view.max_pillars) if isinstance(card.view, PillarGeometry) else GOLDEN_ROWS
    return tuple(n_rows if n is None else n for n in card.input_shape)


def golden_feed(card: ModelCard, seed: int) -> dict[str, NDArray[Any]]:
    """The inputs of a card's golden record: `golden_input`; pillars are full and lie in the first cells."""
    shape = golden_shape(card)
    feed: dict[str, NDArray[Any]] = {card.input.name: golden_input(seed, shape)}
    if isinstance(card.view, PillarGeometry):
        if card.view.num_points:
            feed[card.view.num_points] = np.full(shape[0], shape[1], np.int32)
        rows, columns = np.divmod(np.arange(shape[0], dtype=np.int32), card.view.width)
        feed[card.view.coords] = np.stack([0 * rows, 0 * rows, rows, columns], axis=1)
    return feed


def golden_input(seed: int, shape: tuple[int, ...]) -> Floats32:
    """The input of a card's golden record: uniform noise in -1..1, float32 of ``shape`` (`edgeperc.card.Golden`)."""
    # From raw bits: these bytes are the same on every platform and numpy version, which normal() does not promise.
    bits = np.random.PCG64(seed).random_raw(int(np.prod(shape)))
    uniform = (bits >> np.uint64(40)).astype(np.float32) / np.float32(2**23) - np.float32(1.0)
    return uniform.reshape(shape)
