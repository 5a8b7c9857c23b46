"""The networks in other engines: torch, OpenVINO's own API, MNN and ncnn."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from edgeperc import ModelError
from edgeperc.types.points import Floats32

from .arithmetic import openvino_request


@dataclass(frozen=True)
class Engine:
    """A network ready to run: ``run`` returns the outputs of ``input`` (C, H, W) by name, without the batch axis."""

    input: Floats32
    run: Callable[[], Mapping[str, Floats32]]


def open_engine(library: str, precision: str, path: Path, n_threads: int) -> Engine:
    """Open a model in an engine; onnxruntime is its CPU provider. Only torch (by autocast) and openvino know
    ``"bf16"``; MNN and ncnn run what their converters make of the graph. Raises ModelError.
    """
    if library in ("mnn", "ncnn"):
        with tempfile.TemporaryDirectory() as folder:
            return (_open_mnn if library == "mnn" else _open_ncnn)(path, Path(folder), n_threads)
    if library == "onnxruntime":
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = n_threads
        # As in edgeperc. Otherwise the threads of one network spin on the cores that another network needs: two
        # networks took 77 ms instead of 25 ms.
        options.add_session_config_entry("session.force_spinning_stop", "1")
        session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
        (entry,) = session.get_inputs()
        names, batch = [o.name for o in session.get_outputs()], np.zeros(entry.shape, np.float32)
        return Engine(batch[0], lambda: _first(names, session.run(names, {entry.name: batch})))
    if library == "openvino":
        import openvino

        model = openvino.Core().read_model(path)
        request = openvino_request(model, precision, n_threads)
        batch = np.zeros(list(model.input(0).shape), np.float32)
        request.set_input_tensor(openvino.Tensor(batch, shared_memory=True))

        def by_openvino() -> dict[str, Floats32]:
            request.infer()
            return {o.any_name: request.get_tensor(o).data[0] for o in request.model_outputs}

        return Engine(batch[0], by_openvino)
    import torch

    torch.set_num_threads(n_threads)
    network, shape, names = torch_network(path)
    if library == "torch.compile":
        import torch._inductor.config as inductor

        inductor.compile_threads = 1  # a pool of processes would outlive this one
        network = torch.compile(network)
    tensor = torch.zeros(shape)

    def by_torch() -> dict[str, Floats32]:
        with torch.inference_mode(), torch.autocast("cpu", torch.bfloat16, enabled=precision == "bf16"):
            return _first(names, (output.float().numpy() for output in network(tensor)))

    return Engine(tensor.numpy()[0], by_torch)


def _open_mnn(path: Path, folder: Path, n_threads: int) -> Engine:
    """Convert a model to MNN, and open it. On x86-64, its lower precisions gave the same outputs in the same time."""
    import MNN.expr
    import MNN.nn

    made = folder / "model.mnn"
    # Not MNN.tools.mnnconvert, which calls this, but installs a package by pip and sends the computer's id to a server.
    convert = [sys.executable, "-c", "import _tools, sys; _tools.mnnconvert(sys.argv)", "-f", "ONNX"]
    _convert([*convert, "--bizCode", "edgeperc", "--modelFile", str(path), "--MNNModel", str(made)], path, made)
    name, shape, names = _signature(path)
    runtime = MNN.nn.create_runtime_manager(({"backend": 0, "numThread": n_threads, "precision": "high"},))
    network = MNN.nn.load_module_from_file(str(made), [name], names, runtime_manager=runtime)
    image, batch = MNN.expr.placeholder(list(shape), MNN.expr.NCHW), np.zeros(shape, np.float32)

    def by_mnn() -> dict[str, Floats32]:
        image.write(batch)
        outputs = network.forward([image])
        if len(outputs) != len(names):  # it prints why, and answers with nothing
            raise ModelError(f"MNN cannot run {path.name}")
        return _first(names, (MNN.expr.convert(o, MNN.expr.NCHW).read() for o in outputs))

    return Engine(batch[0], by_mnn)


def _open_ncnn(path: Path, folder: Path, n_threads: int) -> Engine:
    """Convert a model to ncnn by pnnx, and open it."""
    import ncnn

    _, shape, names = _signature(path)
    copied, spec = folder / path.name, importlib.util.find_spec("pnnx")  # pnnx writes next to the model
    copied.write_bytes(path.read_bytes())
    assert spec is not None
    assert spec.origin is not None
    parameters, weights = copied.with_suffix(".ncnn.param"), copied.with_suffix(".ncnn.bin")
    sizes = ",".join(map(str, shape))
    _convert(
        [str(Path(spec.origin).with_name("pnnx")), str(copied), f"inputshape=[{sizes}]", "fp16=0"], path, parameters
    )
    network = ncnn.Net()
    network.opt.num_threads = n_threads
    if network.load_param(str(parameters)) or network.load_model(str(weights)):
        raise ModelError(f"ncnn cannot run {path.name}: it lacks a layer that pnnx translated the graph to")
    image = np.zeros(shape[1:], np.float32)

    def by_ncnn() -> dict[str, Floats32]:
        extractor = network.create_extractor()
        extractor.input("in0", ncnn.Mat(image))
        return {n: np.asarray(extractor.extract(f"out{k}")[1]) for k, n in enumerate(names)}

    return Engine(image, by_ncnn)


def _convert(command: Sequence[str], path: Path, made: Path) -> None:
    """Run an engine's converter, which must make a file."""
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=made.parent)
    if done.returncode or not made.exists():
        reason = " ".join((done.stderr or done.stdout).split())[-200:]
        raise ModelError(f"{Path(command[0]).name} cannot convert {path.name}: {reason}")


def _first(names: Sequence[str], outputs: Iterable[Any]) -> dict[str, Floats32]:
    """Outputs by name, without the batch axis."""
    return {name: output[0] for name, output in zip(names, outputs, strict=True)}


def _signature(path: Path) -> tuple[str, tuple[int, ...], list[str]]:
    """Name and shape of a graph's input, and the names of its outputs."""
    import onnx

    graph = onnx.load(path).graph
    (entry,) = graph.input
    return entry.name, tuple(d.dim_value for d in entry.type.tensor_type.shape.dim), [o.name for o in graph.output]


def torch_network(path: Path) -> tuple[Any, tuple[int, ...], list[str]]:
    """A model's graph as a torch module, the shape of its input and the names of its outputs. Raises ModelError."""
    import onnx
    import torch

    graph = onnx.load(path).graph
    root, traced = torch.nn.Module(), torch.fx.Graph()
    # Constants are tensors, everything else is a node of the traced graph.
    values: dict[str, Any] = {t.name: torch.from_numpy(onnx.numpy_helper.to_array(t).copy()) for t in graph.initializer}
    name, shape, names = _signature(path)
    values[name] = traced.placeholder("x")
    for k, node in enumerate(graph.node):
        attributes = {a.name: onnx.helper.get_attribute_value(a) for a in node.attribute}
        inputs = [values[name] if name else None for name in node.input]
        function, arguments = _in_torch(node.op_type, inputs, attributes)
        if all(isinstance(value, torch.Tensor) for value in inputs):
            values[node.output[0]] = function(*arguments)
            continue
        for j, value in enumerate(arguments):
            if isinstance(value, torch.Tensor):
                root.register_buffer(f"constant_{k}_{j}", value)
                arguments[j] = traced.get_attr(f"constant_{k}_{j}")
        values[node.output[0]] = traced.call_function(function, tuple(arguments))
    traced.output(tuple(values[name] for name in names))
    return torch.fx.GraphModule(root, traced).eval(), shape, names


def _in_torch(op: str, inputs: Sequence[Any], attributes: Mapping[str, Any]) -> tuple[Callable[..., Any], list[Any]]:
    """The torch function of an ONNX operator, and its arguments in order."""
    import torch
    import torch.nn.functional as F

    x, *others = inputs
    pads = attributes.get("pads", [0, 0, 0, 0])
    if pads[:2] != pads[2:]:
        raise ModelError(f"{op} pads {pads}, not the same on both sides; no torch function does")
    plain: dict[str, Callable[..., Any]] = {
        "Add": torch.add, "Equal": torch.eq, "Mul": torch.mul, "Relu": torch.relu, "Sigmoid": torch.sigmoid,
        "Where": torch.where,
    }  # fmt: skip
    if op in plain:
        return plain[op], list(inputs)
    bias = others[1] if len(others) > 1 else None
    if op == "Conv":
        last = [attributes["dilations"], attributes["group"]]
        return F.conv2d, [x, others[0], bias, attributes["strides"], pads[:2], *last]
    if op == "ConvTranspose":
        extra = attributes.get("output_padding", [0, 0])
        last = [extra, attributes.get("group", 1), attributes.get("dilations", [1, 1])]
        return F.conv_transpose2d, [x, others[0], bias, attributes["strides"], pads[:2], *last]
    if op == "Elu":
        return F.elu, [x, attributes.get("alpha", 1.0)]
    if op == "MaxPool" and not attributes.get("ceil_mode") and set(attributes.get("dilations", [1])) == {1}:
        return F.max_pool2d, [x, attributes["kernel_shape"], attributes["strides"], pads[:2]]
    if op == "Concat":
        return torch.cat, [list(inputs), attributes["axis"]]
    if op == "ReduceMean":
        return torch.mean, [x, others[0].tolist(), bool(attributes.get("keepdims", 1))]
    if op == "Expand":
        return torch.Tensor.expand, [x, [-1 if n == 1 else n for n in others[0].tolist()]]
    modes = {b"nearest": "nearest", b"linear": "bilinear"}
    if op == "Resize" and attributes.get("mode") in modes:
        _, scales, *sizes = others
        size = sizes[0].tolist()[2:] if sizes else None
        return F.interpolate, [x, size, None if sizes else scales.tolist()[2:], modes[attributes["mode"]]]
    if op == "DepthToSpace" and attributes.get("mode") == b"CRD":
        return F.pixel_shuffle, [x, attributes["blocksize"]]
    if op == "Reshape":
        return torch.reshape, [x, others[0].tolist()]
    if op == "Transpose":
        return torch.permute, [x, attributes["perm"]]
    if op == "Cast" and isinstance(x, torch.Tensor):
        return torch.Tensor.float, [x]
    if op == "Cast":  # a mask; torch multiplies by it as it is
        return torch.Tensor.contiguous, [x]
    raise ModelError(f"operator {op} has no translation to torch here")
