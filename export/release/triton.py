"""Writes a model repository of NVIDIA's Triton Inference Server.

Each network is a model of the onnxruntime backend. The model ``edgeperc``, of the Python backend, takes a scan, has
Triton run the networks, and returns the labels and the record that ``edgeperc run --json`` prints.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from edgeperc.errors import ModelError
from edgeperc.system.atomic import write_atomic
from edgeperc.types.card import ModelCard
from edgeperc.types.sensor import get_sensor
from edgeperc.types.views import RangeImageGeometry, TopViewGeometry
from edgeperc.zoo import DEFAULT, model_path

from . import triton_model

PIPELINE = "edgeperc"


def write_repository(out: Path, models: Sequence[str | Path] = DEFAULT, *, sensor: str = "hdl-64e") -> list[Path]:
    """Write a model repository for networks of scans (a name stands for its fp32 file) and a built-in sensor; models of
    the same names in it are replaced, each file as a whole. Returns their folders. Raises ModelError, SensorError.
    """
    name = get_sensor(sensor).name
    files = [(ModelCard.read(path), path) for path in map(model_path, models)]
    taken, views = {PIPELINE}, {"range_image", "top_view", "objects"}
    for card, path in files:
        if card.name.lower() in taken or card.view.kind not in views:
            raise ModelError(
                f"{path}: {card.name} is of a camera or of pillars, or another one has its name or view; expected at "
                "most one network of range images, one of top views and one of objects"
            )
        taken.add(card.name.lower())  # one folder, where upper and lower case are the same
        views.remove(card.view.kind)
    version = out / PIPELINE / "1"
    version.mkdir(parents=True, exist_ok=True)
    # For their cards, and where the networks' inputs are made
    copies = [version / f"{card.name}.onnx" for card, _ in files]
    for (card, path), copy in zip(files, copies, strict=True):
        content = path.read_bytes()
        (out / card.name / "1").mkdir(parents=True, exist_ok=True)
        write_atomic(out / card.name / "1" / "model.onnx", content)
        write_atomic(copy, content)
        write_atomic(out / card.name / "config.pbtxt", _network_config(card).encode())
    write_atomic(version / "model.py", Path(triton_model.__file__).read_bytes())
    write_atomic(out / PIPELINE / "config.pbtxt", _pipeline_config([card for card, _ in files], name).encode())
    for old in {*version.glob("*.onnx")} - {*copies}:
        old.unlink()
    return [out / each for each in (*(card.name for card, _ in files), PIPELINE)]


def _network_config(card: ModelCard) -> str:
    shape = [-1 if n is None else n for n in card.input_shape]
    outputs = [
        (o.name, "FP32", [-1 if n is None else n for n in card.output_shape(o.kind)], False) for o in card.outputs
    ]
    return _config(card.name, "onnxruntime", [(card.input.name, "FP32", shape, False)], outputs)


def _pipeline_config(cards: Sequence[ModelCard], sensor: str) -> str:
    outputs: list[_Tensor] = [("record", "STRING", [1], False)]
    for card in cards:
        if isinstance(card.view, RangeImageGeometry):
            outputs.append(("labels", "UINT8", [-1], False))
        if isinstance(card.view, TopViewGeometry):
            outputs.append(("cells", "UINT8", [card.view.height, card.view.width], False))
    inputs: list[_Tensor] = [("points", "FP32", [-1, 4], False), ("stamp_s", "FP64", [1], True)]
    # One instance, because it learns the mounting of the sensor from its first scans.
    text = _config(PIPELINE, "python", inputs, outputs, {"sensor": sensor})
    return f"{text}instance_group [ {{ count: 1 kind: KIND_CPU }} ]\n"


_Tensor = tuple[str, str, Sequence[int], bool]
"""Name, data type, shape, and whether it may be left out."""


def _config(
    name: str, backend: str, inputs: Sequence[_Tensor], outputs: Sequence[_Tensor], parameters: Mapping[str, str] = {}
) -> str:
    """``config.pbtxt``, a ModelConfig in protobuf's text format."""
    lines = [f"name: {quoted(name)}", f"backend: {quoted(backend)}", "max_batch_size: 0"]
    for field, tensors in (("input", inputs), ("output", outputs)):
        for tensor, kind, shape, optional in tensors:
            more = " optional: true" if optional else ""
            dims = f"dims: {[*shape]}"
            lines.append(f"{field} {{ name: {quoted(tensor)} data_type: TYPE_{kind} {dims}{more} }}")
    lines += [
        f"parameters {{ key: {quoted(key)} value {{ string_value: {quoted(value)} }} }}"
        for key, value in parameters.items()
    ]
    return "\n".join(lines) + "\n"


def quoted(text: str) -> str:
    """A string of protobuf's text format: bytes of UTF-8, escaped in octal where they are not plain."""
    return '"' + "".join(chr(b) if 32 <= b < 127 and b not in b'"\\' else f"\\{b:03o}" for b in text.encode()) + '"'
