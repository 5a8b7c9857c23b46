"""Sessions: shipped models open, and every way of being unusable has its own error."""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import onnxruntime
import pytest

import edgeperc.inference.session as session_module
from edgeperc import errors
from edgeperc.inference import providers
from edgeperc.inference.providers import PROVIDERS, available_providers
from edgeperc.inference.session import Session, golden_input
from edgeperc.system.machine import fingerprint, settings_path, write_settings
from edgeperc.types.card import CARD_KEY
from edgeperc.zoo import Variant, digest, listed, model_path, resolve


def edited(tmp_path: Path, name: str, *changes: tuple[bytes, bytes]) -> Path:
    """A shipped model with bytes of its card replaced by as many others, so that the file stays well formed."""
    blob = model_path(name).read_bytes()
    for old, new in changes:
        assert len(old) == len(new)
        assert blob.count(old) == 1, old
        blob = blob.replace(old, new)
    path = tmp_path / "edited.onnx"
    path.write_bytes(blob)
    return path


@pytest.mark.parametrize("variant", listed(), ids=str)
def test_shipped_model_reproduces_the_golden_outputs(variant: Variant) -> None:
    session = Session(str(variant), "cpu")
    assert (session.path, session.card.name, session.precision) == (variant.path, variant.name, variant.precision)
    assert session.description == f"{variant.name} {variant.precision}, CPUExecutionProvider"
    # Before 1.28, onnxruntime rounds some int8 values between layers otherwise: 0.05 with AVX2.
    is_recent = tuple(map(int, onnxruntime.__version__.split(".")[:2])) >= (1, 28)
    assert session.golden_deviation < (0.01 if is_recent or variant.precision == "fp32" else 0.1)
    assert session.sha256 == session.digest == hashlib.sha256(variant.path.read_bytes()).hexdigest()


@pytest.mark.parametrize("variant", listed(), ids=str)
def test_shipped_model_has_no_data_of_its_computer(variant: Variant) -> None:
    blob = variant.path.read_bytes()
    for word in (
        b"/home/",
        b"/Users/",
        b"/tmp/",
        b"site-packages",
        str(Path.home()).encode(),
        str(Path.cwd()).encode(),
    ):
        assert word not in blob


def test_a_second_run_overwrites_the_first() -> None:
    session = Session(model_path("pointseg"), "cpu", n_threads=1)
    logits = session.outputs["class_logits"]
    session.input[:] = golden_input(1, session.input.shape)
    session.run()
    first = logits.copy()
    session.input[:] = 0.0
    session.run()
    assert not np.array_equal(first, logits)
    session.input[:] = golden_input(1, session.input.shape)
    session.run()
    np.testing.assert_array_equal(first, logits)


def test_a_graph_with_other_constants_has_its_own_answers_and_buffers() -> None:
    session = Session("objects", "cpu", n_threads=1)
    all_closely, none_closely = session.with_constants(least=-np.inf), session.with_constants(least=np.inf)
    batch = np.random.default_rng(0).normal(size=(40, *session.input.shape[1:])).astype(np.float32)

    def dropped(network: Session) -> int:
        network.input[:40] = batch
        return int(np.count_nonzero(network.run(40)["objects"][:40, 0] == 12.0))  # the logit of background

    for _ in range(3):
        assert dropped(all_closely) == 0
        assert dropped(none_closely) == 40
        assert 0 < dropped(session) < 40
        none_closely = session.with_constants(least=np.inf, unknown=1.0)  # the former one is destroyed
    session.input[:40] = 0.0
    np.testing.assert_array_equal(all_closely.input[:40], batch)


def test_a_file_that_changed_since_it_was_opened_is_not_opened_again(tmp_path: Path) -> None:
    path = tmp_path / "objects.onnx"
    path.write_bytes(model_path("objects").read_bytes())
    session = Session(path, "cpu", n_threads=1)
    path.write_bytes(model_path("ssadnet").read_bytes())
    with pytest.raises(errors.ModelFileError, match="changed since it was opened"):
        session.with_constants(least=0.0)


def test_the_golden_input_never_changes() -> None:
    x = golden_input(0, (2, 3))
    assert x.dtype == np.float32
    assert np.abs(golden_input(5, (10_000,))).max() <= 1.0
    assert abs(float(golden_input(5, (10_000,)).mean())) < 0.05
    # PCG64 promises its raw bits for good.
    raw = np.random.PCG64(0).random_raw(6) >> np.uint64(40)
    np.testing.assert_array_equal(x.ravel(), raw.astype(np.float32) / np.float32(2**23) - np.float32(1))


@pytest.mark.parametrize(
    ("old", "new", "error", "message"),
    [
        (CARD_KEY.encode(), b"someone.cards", errors.CardError, r"has no card.*edgeperc-export card"),
        (b'"block":[2,4]', b'"block":[2,2]', errors.CardMismatchError, "its card declares tensor"),
        (b'"schema":3', b'"schema":9', errors.CardError, r"edited\.onnx: the card has schema 9.*upgrade edgeperc"),
        (
            b'"positions":',
            b'"positionz":',
            errors.CardError,
            r"edited\.onnx: golden.outputs\['logits'\] lacks positions",
        ),
        (
            b'"name":"range_image"',
            b'"name":"range_imagE"',
            errors.CardMismatchError,
            r"card names input 'range_imagE', the graph has \['range_image'\]",
        ),
    ],
)
def test_wrong_cards(tmp_path: Path, old: bytes, new: bytes, error: type[Exception], message: str) -> None:
    path = edited(tmp_path, "pointseg", (old, new))
    with pytest.raises(error, match=message):
        Session(path, "cpu")


def test_swapped_outputs(tmp_path: Path) -> None:
    card = Session(model_path("ssadnet"), "cpu").card
    first, second = (json.dumps(asdict(o), separators=(",", ":"), sort_keys=True) for o in card.outputs)
    names = [o.name for o in card.outputs]
    swapped = f"{first},{second}".replace(names[0], "@").replace(names[1], names[0]).replace("@", names[1])
    path = edited(tmp_path, "ssadnet", (f"{first},{second}".encode(), swapped.encode()))
    with pytest.raises(
        errors.CardError, match=r"golden.outputs\['segmentation'\] has position 398883; the output has 55000"
    ):
        Session(path, "cpu")


def test_weights_that_changed_are_noticed(tmp_path: Path) -> None:
    onnx = pytest.importorskip("onnx")
    model = onnx.load(model_path("pointseg"))
    largest = max(model.graph.initializer, key=lambda t: len(t.raw_data))
    weights = np.frombuffer(largest.raw_data, np.float32) * np.float32(3)
    largest.raw_data = weights.tobytes()
    onnx.save(model, tmp_path / "changed.onnx")
    with pytest.raises(errors.CardMismatchError, match="standard deviations away from the exporter's"):
        Session(tmp_path / "changed.onnx", "cpu")


def test_external_weights_are_refused_wherever_they_lie(tmp_path: Path) -> None:
    onnx = pytest.importorskip("onnx")
    outside = tmp_path / "outside.bin"
    inside = tmp_path / "folder"
    inside.mkdir()
    for location in ("weights.bin", "../outside.bin", str(outside)):
        model = onnx.load(model_path("pointseg"))
        tensor = max(model.graph.initializer, key=lambda t: len(t.raw_data))
        for target in (outside, inside / "weights.bin"):
            target.write_bytes(tensor.raw_data)
        tensor.ClearField("raw_data")
        tensor.data_location = onnx.TensorProto.EXTERNAL
        tensor.external_data.add(key="location", value=location)
        path = inside / "model.onnx"
        path.write_bytes(model.SerializeToString())
        with pytest.raises(errors.ModelFileError, match="weights in other files"):
            Session(path, "cpu")


@pytest.mark.parametrize("content", [b"", b"not a model", b"\x08\x07" * 100, "truncated", "missing"])
def test_file_that_is_not_a_model(tmp_path: Path, content: bytes | str) -> None:
    path = tmp_path / "model.onnx"
    if content != "missing":
        path.write_bytes(content if isinstance(content, bytes) else model_path("pointseg").read_bytes()[:200_000])
    with pytest.raises(errors.ModelError, match=r"model\.onnx"):
        Session(path, "cpu")


def test_every_provider_is_available_or_refused() -> None:
    present = available_providers()
    assert "cpu" in present
    for name in PROVIDERS:
        if name not in present:
            with pytest.raises(errors.ProviderError, match=f"{name!r} is not available.*present: .*cpu"):
                Session(model_path("pointseg"), name)


@pytest.mark.parametrize("name", ["gpu", "CPUExecutionProvider", "", "openvino:bf16"])
def test_unknown_providers_are_refused(name: str) -> None:
    text = (
        "ask for provider 'openvino' and precision 'bf16'" if ":" in name else "is unknown.*; expected auto or one of"
    )
    with pytest.raises(errors.ProviderError, match=text):
        Session("pointseg", name)


@pytest.mark.parametrize(
    ("model", "precision", "message"),
    [
        ("pointseg", "fp16", "precision 'fp16' is unknown \\(did you mean bf16\\?\\); expected auto, fp32, bf16, int8"),
        ("pointseg", "bf16", "cannot run in precision 'bf16' on provider 'cpu', only in fp32 or int8; bf16 needs"),
        ("pointseg:int8", "fp32", "only in int8; give a model whose weights are stored in fp32"),
        ("pointseg:fp32", "int8", "only in fp32; give a model whose weights are stored in int8"),
    ],
)
def test_unavailable_precision_is_refused(model: str, precision: str, message: str) -> None:
    with pytest.raises(errors.ProviderError, match=message):
        Session(model, "cpu", precision=precision)


@pytest.mark.parametrize("precision", ["fp32", "int8"])
def test_a_precision_picks_the_variant(precision: str) -> None:
    session = Session("pointseg", "cpu", precision=precision)
    assert (session.precision, session.path) == (precision, model_path(f"pointseg:{precision}"))
    assert session.digest == digest(resolve("pointseg"))


def test_auto_takes_int8_where_it_is_native(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(session_module, "cpu_features", lambda: frozenset({"avx512_vnni"}))
    assert Session("pointseg", "cpu").description == "pointseg int8, CPUExecutionProvider"
    assert Session("pointseg", "cpu", precision="fp32").description == "pointseg fp32, CPUExecutionProvider"
    monkeypatch.setattr(session_module, "cpu_features", lambda: frozenset({"avx2"}))
    assert Session("pointseg", "cpu").description == "pointseg int8, CPUExecutionProvider"  # its weights have 7 bits
    monkeypatch.setattr(session_module, "cpu_features", lambda: frozenset({"sse4_2"}))
    assert Session("pointseg", "cpu").description == "pointseg fp32, CPUExecutionProvider"


def test_auto_skips_a_provider_that_cannot_run_the_model(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    # A provider that is said to be there, and that no onnxruntime can make active.
    monkeypatch.setattr(session_module, "PROVIDERS", {"mirage": "MirageExecutionProvider", **PROVIDERS})
    monkeypatch.setattr(session_module, "AUTO", ("mirage", "cpu"))
    monkeypatch.setattr(session_module, "available_providers", lambda: ("mirage", "cpu"))
    monkeypatch.setattr(session_module, "is_available", lambda _: True)
    assert Session(model_path("pointseg"), "auto").provider == "CPUExecutionProvider"
    assert "auto skips pointseg on mirage in fp32" in caplog.text
    with pytest.raises(errors.ProviderError):
        Session(model_path("pointseg"), "mirage")


def test_the_openvino_plugin_agrees_with_the_cpu_provider(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    if "openvino" not in available_providers():
        pytest.skip("the OpenVINO plugin is absent, or finds no device of Intel's")
    for variant in listed():
        # Between layers, OpenVINO rounds int8 values otherwise: `camseg` is 0.09 off, and has a mean IoU of 75.1 % as
        # on the CPU provider.
        limit = 0.001 if variant.precision == "fp32" else 0.1
        assert Session(str(variant), "openvino", precision=variant.precision).golden_deviation < limit
    monkeypatch.setenv("EDGEPERC_CACHE_DIR", str(tmp_path))
    made = []
    for _ in range(2):
        Session("lodnn:int8", "openvino")
        made.append([(file, file.stat().st_mtime_ns) for file in tmp_path.rglob("*") if file.is_file()])
    assert len(made[0]) == 2  # the compiled model and its digest
    assert made[1] == made[0]


class FakePlugins:
    """onnxruntime with plugins whose devices compute on the CPU provider, under the plugins' names."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, devices: Sequence[tuple[str, str]]) -> None:
        self.libraries: list[str] = []
        self.chosen: list[tuple[str, dict[str, str]]] = []
        self.ort = ort = session_module.load_onnxruntime()
        fakes = [
            SimpleNamespace(ep_name=name, device=SimpleNamespace(type=SimpleNamespace(name=kind)))
            for name, kind in devices
        ]
        plugins = self

        class Options:
            def __init__(self) -> None:
                self.own, self.names = ort.SessionOptions(), list[str]()

            def __getattr__(self, name: str) -> object:
                return getattr(self.own, name)

            def add_session_config_entry(self, key: str, value: str) -> None:
                if key != "session.disable_cpu_ep_fallback":  # the CPU provider stands in for the device
                    self.own.add_session_config_entry(key, value)

            def add_provider_for_devices(self, given: Sequence[SimpleNamespace], settings: dict[str, str]) -> None:
                plugins.chosen += [(device.device.type.name, dict(settings)) for device in given]
                self.names += [device.ep_name for device in given]

        class Inference:
            def __init__(self, blob: bytes, options: Options, providers: object = None, **more: int) -> None:
                self.own, self.names = ort.InferenceSession(blob, options.own, ["CPUExecutionProvider"]), options.names

            def __getattr__(self, name: str) -> object:
                return getattr(self.own, name)

            def get_providers(self) -> list[str]:
                return [*self.names, "CPUExecutionProvider"]

        class Ort:
            SessionOptions, InferenceSession = Options, Inference

            def __getattr__(self, name: str) -> object:
                return getattr(ort, name)

            def get_available_providers(self) -> list[str]:
                return ["CPUExecutionProvider"]  # onnxruntime also lists the plugins that this process has loaded

            def get_ep_devices(self) -> list[SimpleNamespace]:
                return fakes if plugins.libraries else []

            def register_execution_provider_library(self, name: str, library: str) -> None:
                assert name in {device.ep_name for device in fakes}
                plugins.libraries.append(library)

        for module in (providers, session_module):
            monkeypatch.setattr(module, "load_onnxruntime", Ort)
        for short, package in session_module.PLUGINS.items():
            offered = PROVIDERS[short] in {name for name, _ in devices}
            fake = SimpleNamespace(get_library_path=lambda package=package: f"{package}.so") if offered else None
            monkeypatch.setitem(sys.modules, package, fake)  # None: it cannot be imported


def test_qualcomms_plugin_runs_int8_on_the_npu(monkeypatch: pytest.MonkeyPatch) -> None:
    name = PROVIDERS["qnn"]
    fake = FakePlugins(monkeypatch, [(name, "CPU"), (name, "GPU"), (name, "NPU")])
    assert available_providers() == ("qnn", "cpu")
    assert fake.libraries == ["onnxruntime_qnn.so"]
    monkeypatch.setattr(session_module, "cpu_features", lambda: frozenset({"asimd"}))  # no int8 on the processor
    assert Session("pointseg", "qnn").description == f"pointseg int8, {name}"
    assert fake.chosen == [("NPU", {"htp_performance_mode": "burst"})]
    assert Session("pointseg", "qnn", precision="fp32").precision == "fp32"
    assert Session("pointseg", "auto").short == "cpu"  # it was not measured on this computer


def test_the_webgpu_plugin_runs_fp32(monkeypatch: pytest.MonkeyPatch) -> None:
    fake = FakePlugins(monkeypatch, [(PROVIDERS["webgpu"], "GPU")])
    assert available_providers() == ("webgpu", "cpu")
    assert Session("pointseg", "webgpu").description == f"pointseg fp32, {PROVIDERS['webgpu']}"
    assert fake.chosen == [("GPU", {})]
    with pytest.raises(errors.ProviderError, match="provider 'qnn' is not available"):
        Session("pointseg", "qnn")


def test_a_plugin_that_does_not_load_is_no_matter_of_other_providers(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    FakePlugins(monkeypatch, [(PROVIDERS["webgpu"], "GPU")])
    monkeypatch.setattr(sys.modules["onnxruntime_ep_webgpu"], "get_library_path", lambda: 1 / 0)
    assert [Session("pointseg", provider).short for provider in ("cpu", "auto")] == ["cpu", "cpu"]
    assert caplog.text.count("'webgpu' is installed but does not load") == 1
    with pytest.raises(errors.ProviderError, match=r"does not load: .* uninstall it"):
        Session("pointseg", "webgpu")


def test_auto_does_not_let_openvino_compile_each_number_of_candidates(monkeypatch: pytest.MonkeyPatch) -> None:
    fake = FakePlugins(monkeypatch, [(PROVIDERS["openvino"], "CPU")])
    monkeypatch.setattr(session_module, "version", lambda package: f"{package} 1.0")
    assert available_providers() == ("openvino", "cpu")
    assert [Session(name, "auto").short for name in ("pointseg", "objects")] == ["openvino", "cpu"]
    fake.chosen.clear()
    session = Session("objects", "openvino", n_threads=1)  # as it was asked for
    assert (session.short, session.second().short) == ("openvino", "openvino")
    one, other = fake.chosen
    assert one == other
    assert '"INFERENCE_NUM_THREADS": "1"' in json.dumps(json.loads(one[1]["load_config"]))


def test_a_failing_run_is_an_inference_error_unless_a_signals_handler_raised() -> None:
    session = Session(model_path("pointseg"), "cpu")

    class Broken:
        def __init__(self, error: Exception) -> None:
            self.error = error

        def run_with_iobinding(self, _: object) -> None:
            raise self.error

    _network = session.inference  # before 1.24, a binding does not keep its network
    late = TimeoutError("of signal.alarm")
    engines = type("Fail", (Exception,), {"__module__": "onnxruntime.capi.onnxruntime_pybind11_state"})
    for error in (RuntimeError("no memory"), engines("no memory"), late):
        session.inference = Broken(error)
        with pytest.raises(TimeoutError if error is late else errors.InferenceError, match=str(error)):
            session.run()


def test_the_input_is_bound_for_every_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """A provider with memory of its own copies what is bound, when it is bound: plugins answered to the first input."""
    session = Session(model_path("pointseg"), "cpu")
    seen: list[float] = []

    class Device:
        def bind_input(self, *bound: object) -> None:
            assert bound[-1] == session.input.ctypes.data
            self.copied = float(session.input[0, 0, 0])

        def run_with_iobinding(self, binding: Device) -> None:
            seen.append(binding.copied)

    session.inference = session.binding = Device()
    for value in (1.0, 2.0):
        session.input[:] = value
        session.run()
    assert seen == [1.0, 2.0]


def test_auto_skips_a_provider_that_gives_other_outputs(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    warm_up = Session.warm_up

    def wrong(self: Session, limit: float, run_options: object) -> float:
        if self.precision == "int8":
            raise errors.CardMismatchError("off by far")
        return warm_up(self, limit, run_options)

    monkeypatch.setattr(Session, "warm_up", wrong)
    monkeypatch.setattr(session_module, "cpu_features", lambda: frozenset({"avx512_vnni"}))
    assert Session("pointseg", "cpu").description == "pointseg fp32, CPUExecutionProvider"
    assert "auto skips pointseg on cpu in int8: off by far" in caplog.text
    with pytest.raises(errors.CardMismatchError, match="off by far"):
        Session("pointseg", "cpu", precision="int8")


def test_auto_takes_the_setting_that_was_measured_here(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("EDGEPERC_CACHE_DIR", str(tmp_path))
    path = model_path("pointseg")
    sha = hashlib.sha256(path.read_bytes()).hexdigest()
    keep = partial(write_settings, settings_path(), fingerprint())
    keep({sha: {"provider": "cpu", "precision": "fp32", "n_threads": 1}})
    assert Session(path, "auto").options["threads"] == "1"
    assert Session(path, "auto", n_threads=2).options["threads"] == "2"
    assert Session(path, "cpu").options["threads"] == "the provider's choice"
    with monkeypatch.context() as four:
        four.setattr(session_module, "usable_cores", lambda: 4)
        for measured, threads in ((1, "1"), (4, "2")):  # of a network alone
            keep({sha: {"provider": "cpu", "precision": "fp32", "n_threads": measured}})
            beside = Session(path, "auto", at_once=2)
            assert (beside.shares_cores, beside.options["threads"]) == (True, threads)
    keep({sha: {"provider": "qnn", "precision": "fp32", "n_threads": 1}})
    assert Session(path, "auto").options["threads"] == "the provider's choice"
    assert "pointseg on qnn, which was measured as the fastest: it is no longer available" in caplog.text
    monkeypatch.setattr(session_module, "cpu_features", frozenset)
    keep({digest(resolve("pointseg")): {"provider": "cpu", "precision": "int8", "n_threads": 1}})
    assert Session("pointseg").precision == "int8"  # though nothing is known of the processor
    assert Session("pointseg", precision="fp32").options["threads"] == "the provider's choice"
    settings_path().write_text("{")
    assert Session(path, "auto").options["threads"] == "the provider's choice"
    assert "auto cannot read the settings measured on this computer" in caplog.text


@pytest.mark.parametrize("n_threads", [0, -1, 4097, 10**400])
def test_the_number_of_threads_is_bounded(n_threads: int) -> None:
    with pytest.raises(errors.OptionError, match=r"n_threads is -?[0-9.]+; expected a whole number from 1 to 4096"):
        Session(model_path("pointseg"), "cpu", n_threads=n_threads)
