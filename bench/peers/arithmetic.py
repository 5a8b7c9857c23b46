"""Count the work of a network and measure the peak of this machine: together a lower bound for every latency.

A network's multiplications are those of its convolutions and matrix products, counted from the ONNX graph; taps that
only meet padding are counted separately, because an engine can skip them. The machine's peak is measured next to the
networks, with the installed libraries: large matrix products, and a copy of more memory than any cache holds. The bound
holds for direct convolution; Winograd's method needs fewer multiplications but more of all other operations.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from edgeperc import ModelError

PRODUCT_SIZE = 1536
COPY_BYTES = 1 << 28


@dataclass(frozen=True)
class Cost:
    """The work of a network; traffic is counted in values, not bytes."""

    macs: int  # multiply-accumulates including padding, as usually reported
    padding_macs: int  # the part of them that meets padding only
    weights: int  # read by convolutions and matrix products; other operators can be fused into them
    activations: int  # read or written by them


def cost(model: Path | Any) -> Cost:
    """Count the multiplications and traffic of a network, of a file or an onnx.ModelProto. Raises ModelError."""
    import onnx

    loaded = onnx.load(model) if isinstance(model, Path) else model
    graph = onnx.shape_inference.infer_shapes(loaded, data_prop=True).graph
    named = *graph.input, *graph.output, *graph.value_info
    shapes = {v.name: tuple(d.dim_value for d in v.type.tensor_type.shape.dim) for v in named}
    shapes |= {t.name: tuple(t.dims) for t in graph.initializer}
    constant = {t.name for t in graph.initializer}
    macs = inside = weights = activations = 0
    for node in graph.node:
        if all(name in constant for name in node.input):  # weights converted from half precision or int8
            constant.update(node.output)
        if node.op_type not in ("Conv", "ConvTranspose", "Gemm", "MatMul"):
            continue
        if not all(math.prod(shapes.get(name, (0,))) for name in (*filter(None, node.input), *node.output)):
            raise ModelError(f"{node.op_type} {node.name}: a shape is not fixed; export with fixed shapes")
        attributes = {a.name: onnx.helper.get_attribute_value(a) for a in node.attribute}
        x, w, y = shapes[node.input[0]], shapes[node.input[1]], shapes[node.output[0]]
        if node.op_type in ("Conv", "ConvTranspose"):
            if attributes.get("auto_pad", b"NOTSET") != b"NOTSET":
                raise ModelError(f"{node.op_type} {node.name} leaves padding to the engine; export with explicit pads")
            # The side where each tap is multiplied once: a convolution's outputs, a transposed one's inputs.
            here, there = (y, x) if node.op_type == "Conv" else (x, y)
            axes = range(len(w) - 2)
            strides, dilations = (attributes.get(name, [1 for _ in axes]) for name in ("strides", "dilations"))
            pads = attributes.get("pads", [0 for _ in axes])
            met = [n_taps_inside(here[2 + k], there[2 + k], w[2 + k], strides[k], pads[k], dilations[k]) for k in axes]
            channels = here[0] * here[1] * w[1]
            macs += channels * math.prod(here[2:]) * math.prod(w[2:])
            inside += channels * math.prod(met)
        else:
            depth = x[0] if attributes.get("transA") else x[-1]
            macs += math.prod(y) * depth
            inside += math.prod(y) * depth
        weights += sum(math.prod(shapes[name]) for name in node.input if name in constant)
        activations += sum(math.prod(shapes[name]) for name in node.input if name and name not in constant)
        activations += math.prod(y)
    return Cost(macs, macs - inside, weights, activations)


def n_taps_inside(n_here: int, n_there: int, kernel: int, stride: int, pad: int, dilation: int) -> int:
    """Number of pairs of a position and a tap, along one axis, that do not fall on padding."""
    places = np.arange(n_here)[:, None] * stride - pad + np.arange(kernel) * dilation
    return int(np.count_nonzero((places >= 0) & (places < n_there)))


def matrix_product(library: str, precision: str, n_threads: int) -> Callable[[], object]:
    """A product of `PRODUCT_SIZE` ** 3 multiplications; numpy takes its threads from the environment at the start."""
    n = PRODUCT_SIZE
    a, b = np.random.default_rng(0).standard_normal((2, n, n), np.float32)
    if library == "numpy":
        out = np.empty_like(a)
        return lambda: np.matmul(a, b, out=out)
    if library == "openvino":
        import openvino
        from openvino import opset13

        left, right = opset13.parameter([n, n], np.float32), opset13.parameter([n, n], np.float32)
        model = openvino.Model([opset13.matmul(left, right, False, False)], [left, right])
        request = openvino_request(model, precision, n_threads)
        for k, matrix in enumerate((a, b)):
            request.set_input_tensor(k, openvino.Tensor(matrix))
        return request.infer
    import torch

    torch.set_num_threads(n_threads)
    if precision == "int8":
        left, right = (torch.from_numpy(np.clip(32.0 * m, -127.0, 127.0).astype(np.int8)) for m in (a, b))
        return lambda: torch._int_mm(left, right)
    left, right = (torch.from_numpy(m).to({"fp32": torch.float32, "bf16": torch.bfloat16}[precision]) for m in (a, b))
    return lambda: torch.mm(left, right)


def openvino_request(model: Any, precision: str, n_threads: int) -> Any:
    """A model in OpenVINO's own API, configured for low latency on the CPU."""
    import openvino

    settings = {
        "PERFORMANCE_HINT": "LATENCY",
        "INFERENCE_NUM_THREADS": n_threads,
        "INFERENCE_PRECISION_HINT": {"fp32": "f32", "bf16": "bf16"}[precision],
    }
    return openvino.Core().compile_model(model, "CPU", settings).create_infer_request()


def memory_copy(n_threads: int) -> Callable[[], object]:
    """A copy of `COPY_BYTES`, an equal part for each thread."""
    source, target = np.ones(COPY_BYTES // 8), np.zeros(COPY_BYTES // 8)
    parts: Sequence[Any] = list(zip(np.array_split(target, n_threads), np.array_split(source, n_threads), strict=True))
    pool = ThreadPoolExecutor(n_threads)
    return lambda: list(pool.map(lambda part: np.copyto(*part), parts))
