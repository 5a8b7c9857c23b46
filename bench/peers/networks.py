"""The networks at other image sizes, and the networks of others with random weights."""

from __future__ import annotations

from dataclasses import fields, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from edgeperc import ModelError
from edgeperc.inference.session import golden_input
from edgeperc.types.detector import PillarGeometry
from edgeperc.types.points import Floats32
from edgeperc.types.views import ObjectGeometry, TopViewGeometry
from edgeperc.zoo import resolve

POINTPILLARS = "PointPillars 496x432"
OTHERS: dict[str, tuple[str, tuple[str, ...], tuple[int, int, int]]] = {
    "SqueezeSegV2 64x512": ("squeezesegv2.SqueezeSegV2", ("logits",), (5, 64, 512)),
    "SalsaNext 64x512": ("salsanext.SalsaNext", ("logits",), (5, 64, 512)),
    "SalsaNext 64x2048": ("salsanext.SalsaNext", ("logits",), (5, 64, 2048)),
    "FIDNet 64x2048": ("resnets.FIDNet", ("logits",), (5, 64, 2048)),
    "CENet 64x2048": ("resnets.CENet", ("logits",), (5, 64, 2048)),
    "SFA3D 608x608": ("resnets.SFA3D", ("heat", "offset", "direction", "height", "size"), (3, 608, 608)),
    POINTPILLARS: ("pointpillars.PointPillars", ("scores", "boxes", "directions"), (64, 496, 432)),
}
"""Networks of others: where they are, their outputs, logits or what boxes are read off, and their input's shape."""


def resized(model: str, share: float, folder: Path) -> Path:
    """A model's network with random weights in fp32 for ``share`` times the columns or range. Raises ModelError."""
    from edgeperc_export.networks import build
    from edgeperc_export.recipe import Recipe
    from edgeperc_export.release.to_onnx import to_graph, write_card

    card = resolve(model)[0].card
    if isinstance(card.view, ObjectGeometry | PillarGeometry):
        return Path(model)  # which has no image
    recipe = card.training.get("recipe")
    if not isinstance(recipe, dict):
        raise ModelError(f"the card of {model} has no training recipe; without one its network cannot be rebuilt")
    view: Any = card.view
    if isinstance(view, TopViewGeometry):
        near, far = view.x_range_m
        view = replace(view, x_range_m=(near, near + share * (far - near)))
    else:
        view = replace(view, width=round(share * view.width))
    card = replace(card, view=view, golden=None, precision="fp32", precisions={})
    made = folder / f"{card.name}-{share:g}.onnx"
    known = {each.name for each in fields(Recipe)}  # an option that is gone was one of training, not of the network
    write_card(to_graph(build(Recipe(**{name: recipe[name] for name in known & {*recipe}})), card), card, made)
    return made


def write_others(folder: Path) -> None:
    """Write each network of `OTHERS` with random weights in fp32 and int8, and its input. int8 is as in edgeperc's
    models; the ranges are of the one input, because random weights have no accuracy to lose.
    """
    import onnx
    import torch
    from onnxruntime.quantization import CalibrationDataReader, QuantType, quantize_static
    from onnxruntime.quantization.quant_utils import add_pre_process_metadata

    from edgeperc_export.networks.pointseg import initialize
    from edgeperc_export.release.quantize import ROUNDED_OPS, folded
    from edgeperc_export.release.to_onnx import traced

    class Once(CalibrationDataReader):  # type: ignore[misc]
        def __init__(self, image: Floats32) -> None:
            self._left = [{"image": image}]

        def get_next(self) -> dict[str, Floats32] | None:
            return self._left.pop() if self._left else None

    for name, (where, outputs, shape) in OTHERS.items():
        module, _, made = where.partition(".")
        torch.manual_seed(0)
        network = getattr(import_module(f"edgeperc_export.networks.{module}"), made)()
        initialize(network)
        image = golden_input(0, (1, *shape))
        np.save(folder / f"{name}.npy", image[0])
        fp32 = folder / f"{name} fp32.onnx"
        onnx.save(traced(network, "forward", torch.from_numpy(image), "image", outputs), fp32)
        model = folded(fp32)
        add_pre_process_metadata(model)  # else it asks for it
        quantize_static(
            model,
            folder / f"{name} int8.onnx",
            Once(image),
            op_types_to_quantize=[*ROUNDED_OPS, "AveragePool", "LeakyRelu"],
            per_channel=True,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
        )
