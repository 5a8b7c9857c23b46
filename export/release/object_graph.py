"""The graph of the object network: a first look at all candidates, and a close look at those that it keeps."""

from __future__ import annotations

from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, compose, helper, numpy_helper

from ..networks.objects import CLOSE, LEAST, LOOK, rejected


def with_first_look(look: onnx.ModelProto, close: onnx.ModelProto) -> onnx.ModelProto:
    """Join two graphs of one input: ``close`` gets the candidates, sorted because no operator that scatters is allowed,
    whose logit of ``look`` reaches `LEAST`; each then takes its row of the outputs, or that of `rejected`.
    """
    source, output = close.graph.input[0], close.graph.output[0]
    look, close = compose.add_prefix(look, LOOK), compose.add_prefix(close, CLOSE)
    logits, inner, outer = look.graph.output[0].name, close.graph.input[0].name, close.graph.output[0].name
    constants: dict[str, NDArray[Any]] = {
        "least": np.array(LEAST, np.float32),  # of -inf, all get a close look (`inference.object_network`)
        "zero": np.zeros(1, np.int64),
        "one": np.ones(1, np.int64),
        "last": rejected(output.type.tensor_type.shape.dim[1].dim_value).numpy()[np.newaxis],
    }
    first: list[_Step] = [("Identity", [source.name], [look.graph.input[0].name], {})]
    sift: list[_Step] = [
        ("GreaterOrEqual", [logits, "least"], ["is_kept"], {}),
        ("Cast", ["is_kept"], ["each"], {"to": TensorProto.INT64}),
        ("ReduceSum", ["each", "zero"], ["n_kept"], {"keepdims": 1}),
        ("Max", ["n_kept", "one"], ["n_close"], {}),  # not all engines compute products of nothing
        ("Shape", [logits], ["n_all"], {}),
        ("TopK", [logits, "n_all"], ["falling", "order"], {}),
        ("Slice", ["order", "zero", "n_close"], ["kept"], {}),
        ("Gather", [source.name, "kept"], [inner], {"axis": 0}),
    ]
    spread: list[_Step] = [
        ("Cast", ["order"], ["places"], {"to": TensorProto.FLOAT}),
        ("TopK", ["places", "n_all"], ["rising", "rank"], {"largest": 0}),
        ("Min", ["rank", "n_kept"], ["row"], {}),
        ("Slice", [outer, "zero", "n_kept"], ["close"], {}),
        ("Concat", ["close", "last"], ["rows"], {"axis": 0}),
        ("Gather", ["rows", "row"], [output.name], {"axis": 0}),
    ]
    begin, middle, end = (
        [helper.make_node(op, inputs, outputs, **more) for op, inputs, outputs, more in part]
        for part in (first, sift, spread)
    )
    graph = helper.make_graph(
        [*begin, *look.graph.node, *middle, *close.graph.node, *end],
        "objects",
        [source],
        [output],
        [
            *look.graph.initializer,
            *close.graph.initializer,
            *(numpy_helper.from_array(value, name) for name, value in constants.items()),
        ],
    )
    model = helper.make_model(graph, opset_imports=close.opset_import, ir_version=close.ir_version)
    model.producer_name = close.producer_name
    return model


_Step = tuple[str, list[str], list[str], dict[str, Any]]
"""Operator, inputs, outputs and attributes."""
