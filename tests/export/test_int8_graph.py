"""Changes of a graph for int8 leave its function as it is."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("onnx")
pytest.importorskip("torch")

import onnx
import onnxruntime
from onnx import TensorProto, helper, numpy_helper

from edgeperc_export.release.int8_graph import equalize, repeat_pixels

RNG = np.random.default_rng(0)
IMAGE = RNG.normal(size=(1, 3, 8, 12)).astype(np.float32)


def graph_of(*nodes: onnx.NodeProto, constants: dict[str, np.ndarray], image: np.ndarray = IMAGE) -> onnx.ModelProto:
    """A graph from "image" to "out"."""
    ends = [
        helper.make_tensor_value_info("image", TensorProto.FLOAT, image.shape),
        helper.make_tensor_value_info("out", TensorProto.FLOAT, [None] * 4),
    ]
    weights = [numpy_helper.from_array(value, name) for name, value in constants.items()]
    graph = helper.make_graph([*nodes], "g", ends[:1], ends[1:], weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    model = onnx.shape_inference.infer_shapes(model)
    onnx.checker.check_model(model, full_check=True)
    return model


def run(model: onnx.ModelProto, names: tuple[str, ...] = (), image: np.ndarray = IMAGE) -> dict[str, np.ndarray]:
    """The output, and inner tensors."""
    more = onnx.ModelProto()
    more.CopyFrom(model)
    more.graph.output.extend(helper.make_empty_tensor_value_info(name) for name in names)
    session = onnxruntime.InferenceSession(more.SerializeToString(), providers=["CPUExecutionProvider"])
    return dict(zip(("out", *names), session.run(["out", *names], {"image": image}), strict=True))


def conv(source: str, name: str, target: str, **attributes: object) -> onnx.NodeProto:
    return helper.make_node("Conv", [source, f"{name}_w", f"{name}_b"], [target], name=target, **attributes)


def weights(name: str, out: int, into: int, size: int = 3) -> dict[str, np.ndarray]:
    """Weights that make channels of very different sizes."""
    scale = np.geomspace(0.01, 10.0, out)
    w = RNG.normal(size=(out, into, size, size)) * scale[:, None, None, None]
    return {f"{name}_w": w.astype(np.float32), f"{name}_b": (RNG.normal(size=out) * scale).astype(np.float32)}


SAME = {"pads": [1, 1, 1, 1]}
CONSTANTS = weights("a", 6, 3) | weights("b", 6, 6) | weights("c", 4, 6)
INNER = ("x", "rx", "y", "sum", "z")
SOME = np.float32([1, 1, 0, 1, 1, 1])


def residual(*, made: str = "x", **of_second: object) -> list[onnx.NodeProto]:
    """Convolution a, a residual block with convolution b, and the last convolution, c."""
    return [
        conv("image", "a", "x", **SAME),
        helper.make_node("Relu", [made], ["rx"], name="relu"),
        conv("rx", "b", "y", **SAME, **of_second),
        helper.make_node("Add", ["rx", "y"], ["sum"], name="add"),
        helper.make_node("Relu", ["sum"], ["z"], name="relu_2"),
        conv("z", "c", "out", **SAME),
    ]


def sizes(model: onnx.ModelProto, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    return {name: abs(values).max((0, 2, 3)).astype(np.float64) for name, values in run(model, names).items()}


def test_channels_get_the_same_size_and_outputs_stay() -> None:
    model = graph_of(*residual(), constants=CONSTANTS)
    before, size = run(model)["out"], sizes(model, INNER)
    equalize(model, size)
    np.testing.assert_allclose(run(model)["out"], before, rtol=1e-3, atol=1e-3 * abs(before).max())
    after = sizes(model, INNER)
    whole = np.max([after[name] for name in INNER], axis=0)  # one factor for all that the addition ties
    np.testing.assert_allclose(whole, whole.max(), rtol=1e-3)
    assert size["rx"].max() / size["rx"].min() > 100.0


def between(*nodes: onnx.NodeProto, **more: np.ndarray) -> onnx.ModelProto:
    """Convolution a makes x, and convolution c reads z."""
    last = conv("z", "c", "out", **SAME)
    return graph_of(conv("image", "a", "x", **SAME), *nodes, last, constants=CONSTANTS | more)


@pytest.mark.parametrize(
    "model",
    [
        between(helper.make_node("Sigmoid", ["x"], ["z"])),
        between(helper.make_node("Add", ["x", "one"], ["z"]), one=np.ones((1, 6, 1, 1), np.float32)),
        between(helper.make_node("Mul", ["x", "x"], ["z"])),
        between(conv("x", "b", "z", **SAME), b_w=CONSTANTS["c_w"][[0] * 6], b_b=CONSTANTS["b_b"]),
        graph_of(  # one channel is added to six
            *residual(), constants=CONSTANTS | {"b_w": CONSTANTS["b_w"][:1], "b_b": CONSTANTS["b_b"][:1]}
        ),
        graph_of(*residual(group=6), constants=CONSTANTS | {"b_w": CONSTANTS["b_w"][:, :1]}),
        graph_of(*residual(made="image"), constants=CONSTANTS | weights("b", 3, 3) | weights("c", 4, 3)),
        graph_of(  # a channel that is always 0
            conv("image", "a", "x", **SAME),
            conv("x", "c", "out", **SAME),
            constants=CONSTANTS | {"a_w": CONSTANTS["a_w"] * SOME[:, None, None, None], "a_b": CONSTANTS["a_b"] * SOME},
        ),
        graph_of(  # one weight for two convolutions
            conv("image", "a", "x", **SAME),
            conv("x", "b", "y", **SAME),
            conv("y", "b", "z", **SAME),
            conv("z", "c", "out", **SAME),
            constants=CONSTANTS,
        ),
    ],
    ids=["sigmoid", "constant", "product", "dense", "one channel", "grouped", "input", "zero", "shared"],
)
def test_what_is_not_homogeneous_keeps_its_function(model: onnx.ModelProto) -> None:
    names = tuple(name for node in model.graph.node for name in node.output if name != "out")
    before, size = run(model)["out"], sizes(model, names)
    equalize(model, size)
    np.testing.assert_allclose(run(model)["out"], before, rtol=1e-3, atol=1e-3 * abs(before).max())


def resized(scales: tuple[float, float], step: float = 0.05, **attributes: str) -> onnx.ModelProto:
    """An image in int8 that is resized; ``step`` is that of the result, 0.05 that of the image."""
    options = {"mode": "nearest", "coordinate_transformation_mode": "asymmetric", "nearest_mode": "floor"} | attributes
    nodes = [
        helper.make_node("QuantizeLinear", ["image", "step", "zero"], ["q"], name="q"),
        helper.make_node("DequantizeLinear", ["q", "step", "zero"], ["x"], name="dq"),
        helper.make_node("Resize", ["x", "", "scales"], ["y"], name="up", **options),
        helper.make_node("QuantizeLinear", ["y", "other", "zero"], ["p"], name="p"),
        helper.make_node("DequantizeLinear", ["p", "other", "zero"], ["out"], name="dp"),
    ]
    constants = {"step": np.float32(0.05), "zero": np.uint8(128), "scales": np.array([1, 1, *scales], np.float32)}
    same = step == 0.05
    nodes[3].input[1] = nodes[4].input[1] = "step" if same else "other"
    return graph_of(*nodes, constants=constants | ({} if same else {"other": np.float32(step)}))


@pytest.mark.parametrize("scales", [(2, 2), (1, 2), (3, 1), (2, 3)])
def test_repeated_pixels_are_those_of_resize(scales: tuple[int, int]) -> None:
    model = resized(scales)
    before = run(model)["out"]
    repeat_pixels(model)
    onnx.checker.check_model(model, full_check=True)
    assert "Resize" not in {node.op_type for node in model.graph.node}
    assert {each.name for each in model.graph.initializer} == {"step", "zero", "up_wide", "up_high"}
    np.testing.assert_array_equal(run(model)["out"], before)
    assert before.shape == (1, 3, 8 * scales[0], 12 * scales[1])


@pytest.mark.parametrize(
    "model",
    [
        resized((2, 2), mode="linear"),
        resized((2, 2), coordinate_transformation_mode="half_pixel"),
        resized((2, 2), nearest_mode="ceil"),
        resized((1.5, 2)),
        resized((0.5, 0.5)),
        resized((2, 2), step=0.1),
    ],
    ids=["linear", "half pixels", "ceil", "part of a pixel", "smaller", "other steps"],
)
def test_other_ways_to_resize_stay(model: onnx.ModelProto) -> None:
    before = model.SerializeToString(deterministic=True)
    repeat_pixels(model)
    if before != model.SerializeToString(deterministic=True):
        raise AssertionError([node.op_type for node in model.graph.node])
