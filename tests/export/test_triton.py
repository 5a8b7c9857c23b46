"""The Triton repository: its configurations parse, and its Python model answers as a Perceiver does."""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from edgeperc import Perceiver
from edgeperc.errors import ModelError, SensorError
from edgeperc.records import scan_record
from edgeperc.types.card import ModelCard
from edgeperc.zoo import DEFAULT, model_path
from edgeperc_export import cli
from edgeperc_export.release.triton import write_repository
from scenes import urban


@pytest.fixture(scope="module")
def repository(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("triton")
    assert cli.main(["triton", str(out)]) == 0
    return out


def stub(repository: Path) -> ModuleType:
    """What the Python backend offers to a model; requests to networks are answered by onnxruntime."""
    onnxruntime = pytest.importorskip("onnxruntime")

    def tensor(name: str, array: np.ndarray) -> SimpleNamespace:
        return SimpleNamespace(name=lambda: name, as_numpy=lambda: array)

    def response(output_tensors: list[Any], error: Any = None) -> SimpleNamespace:
        return SimpleNamespace(tensors=output_tensors, has_error=lambda: error is not None, error=lambda: error)

    class InferenceRequest:
        def __init__(
            self, model_name: str, requested_output_names: list[str], inputs: list[Any], preferred_memory: object
        ) -> None:
            self.model, self.wanted, self.tensors = model_name, requested_output_names, inputs

        def exec(self) -> SimpleNamespace:
            session = onnxruntime.InferenceSession(str(repository / self.model / "1" / "model.onnx"))
            found = session.run(self.wanted, {each.name(): each.as_numpy() for each in self.tensors})
            return response([tensor(*pair) for pair in zip(self.wanted, found, strict=True)])

    def tensor_of(holder: Any, name: str) -> Any:
        return next((each for each in holder.tensors if each.name() == name), None)

    module = ModuleType("triton_python_backend_utils")
    vars(module).update(
        Tensor=tensor,
        InferenceRequest=InferenceRequest,
        InferenceResponse=response,
        TritonError=lambda text: SimpleNamespace(message=lambda: text),
        PreferredMemory=lambda kind, device: None,
        TRITONSERVER_MEMORY_CPU=0,
        get_input_tensor_by_name=tensor_of,
        get_output_tensor_by_name=tensor_of,
    )
    return module


def loaded(repository: Path) -> Any:
    """The Python model, from its file."""
    spec = importlib.util.spec_from_file_location("model", repository / "edgeperc" / "1" / "model.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    model = module.TritonPythonModel()
    model.initialize({"model_config": json.dumps({"parameters": {"sensor": {"string_value": "hdl-64e"}}})})
    return model


@pytest.mark.filterwarnings("ignore::UserWarning")  # what a simulated scan is unlike
def test_the_python_model_answers_as_a_perceiver(repository: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    triton = stub(repository)
    monkeypatch.setitem(sys.modules, "triton_python_backend_utils", triton)
    model = loaded(repository)
    perceive = Perceiver([model_path(name) for name in DEFAULT], provider="cpu", n_threads=1)
    scans = [urban(k).points for k in range(2)]
    requests = [
        SimpleNamespace(tensors=[triton.Tensor("points", scans[0])]),
        SimpleNamespace(
            tensors=[triton.Tensor("points", scans[1]), triton.Tensor("stamp_s", np.array([1.5], np.float64))]
        ),
        SimpleNamespace(tensors=[triton.Tensor("points", np.zeros((3, 2), np.float32))]),
    ]
    *answers, refused = model.execute(requests)
    for answer, points, stamp_s in zip(answers, scans, (None, 1.5), strict=True):
        expected = perceive(points, stamp_s)
        found = {tensor.name(): tensor.as_numpy() for tensor in answer.tensors}
        assert {*found} == {"record", "labels", "cells"}
        np.testing.assert_array_equal(found["labels"], expected.require_points().labels)
        np.testing.assert_array_equal(found["cells"], expected.require_top_view().labels)
        record, of_perceiver = json.loads(found["record"][0]), json.loads(json.dumps(scan_record(expected)))
        for each in (record, of_perceiver):
            del each["stage_ms"]
        assert record == of_perceiver
    assert refused.has_error()
    assert "expected (n, 4)" in refused.error().message()

    # A network that fails is an error of the request.
    broken = triton.InferenceResponse([], triton.TritonError("out of memory"))
    monkeypatch.setattr(triton.InferenceRequest, "exec", lambda self: broken)
    (answer,) = model.execute(requests[:1])
    assert "out of memory" in answer.error().message()


def test_the_configurations_are_tritons(repository: Path) -> None:
    """Parsed by protobuf, as the server parses them, and held against the files."""
    configurations = pytest.importorskip("tritonclient.grpc.model_config_pb2")
    from google.protobuf import text_format

    for folder in sorted(repository.iterdir()):
        text = (folder / "config.pbtxt").read_text()
        config = text_format.Parse(text, configurations.ModelConfig())
        assert config.name == folder.name
        assert config.max_batch_size == 0
        if folder.name == "edgeperc":
            assert config.backend == "python"
            assert config.parameters["sensor"].string_value == "hdl-64e"
            assert [tensor.name for tensor in config.input] == ["points", "stamp_s"]
            assert [tensor.optional for tensor in config.input] == [False, True]
            assert {tensor.name for tensor in config.output} == {"record", "labels", "cells"}
            continue
        assert config.backend == "onnxruntime"
        card = ModelCard.read(folder / "1" / "model.onnx")
        (tensor,) = config.input
        assert [n if n >= 0 else None for n in tensor.dims] == [*card.input_shape]
        assert tensor.data_type == configurations.TYPE_FP32
        for tensor, output in zip(config.output, card.outputs, strict=True):
            assert tensor.name == output.name
            assert [n if n >= 0 else None for n in tensor.dims] == [*card.output_shape(output.kind)]


def test_what_is_written(repository: Path, tmp_path: Path) -> None:
    files = {str(path.relative_to(repository)) for path in repository.rglob("*") if path.is_file()}
    files = {name for name in files if not name.endswith(".pyc")}  # another test runs model.py
    networks = {f"{name}/{file}" for name in DEFAULT for file in ("config.pbtxt", "1/model.onnx")}
    assert files == networks | {
        *("edgeperc/config.pbtxt", "edgeperc/1/model.py"),
        *(f"edgeperc/1/{name}.onnx" for name in DEFAULT),
    }
    # Again, with another network: what is gone is not perceived with.
    write_repository(repository_of_one := tmp_path / "one", DEFAULT)
    folders = write_repository(repository_of_one, ["pointseg"], sensor="vlp-16")
    assert [folder.name for folder in folders] == ["pointseg", "edgeperc"]
    text = (repository_of_one / "edgeperc" / "config.pbtxt").read_text()
    assert "vlp-16" in text
    assert '"cells"' not in text
    assert [path.name for path in (repository_of_one / "edgeperc" / "1").glob("*.onnx")] == ["pointseg.onnx"]


@pytest.mark.skipif(os.name != "posix", reason="Windows has no such limit")
def test_a_full_disk_leaves_a_repository_as_it_was(repository: Path, tmp_path: Path) -> None:
    """The pipeline had lost its networks, and one of them was cut off."""
    shutil.copytree(repository, tmp_path, dirs_exist_ok=True)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.onnx")}
    code = (
        "import resource, sys; from pathlib import Path; from edgeperc_export.release.triton import write_repository;"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000)); write_repository(Path(sys.argv[1]))"
    )
    done = subprocess.run([sys.executable, "-c", code, tmp_path], capture_output=True, text=True)
    assert "File too large" in done.stderr
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.onnx*")} == before


def test_what_is_refused(tmp_path: Path) -> None:
    for other in ("pointseg:int8", "sceneseg"):
        with pytest.raises(ModelError, match="another one has its name or view"):
            write_repository(tmp_path, ["pointseg", other])
    with pytest.raises(SensorError):
        write_repository(tmp_path, sensor="nothing")
    assert not [*tmp_path.iterdir()]
