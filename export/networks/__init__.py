"""The networks, one file each."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import nn

from ..cards import card_of
from ..recipe import Recipe
from .camseg import CamSeg
from .edge import PointSegEdge, SSADNetEdge
from .fcn import FCN
from .lodnn import LoDNN, LoDNNEdge
from .objects import ObjectNet
from .pointseg import PointSeg
from .segnet import SegNet
from .squeezesegv2 import KULSeg, SqueezeSegV2
from .ssadnet import SSADNet
from .unet import UNet

__all__ = ["EDGE", "build"]

EDGE: dict[str, type[nn.Module]] = {"lodnn": LoDNNEdge, "pointseg": PointSegEdge, "ssadnet": SSADNetEdge}

LARGE: dict[str, Callable[..., nn.Module]] = {
    **{"camseg": CamSeg, "segnet": SegNet, "fcn8": partial(FCN, stride=8), "fcn16": partial(FCN, stride=16)},
    **{"unet": UNet, "unet-small": partial(UNet, width=16), "unet-small-leaky": partial(UNet, width=16, leaky=True)},
    **{"unet-long": partial(UNet, n_levels=7), "objects": ObjectNet, "pointseg": PointSeg},
    **{"squeezesegv2": SqueezeSegV2, "kulseg": KULSeg, "lodnn": LoDNN, "ssadnet": SSADNet},
}


def build(recipe: Recipe) -> nn.Module:
    """The network of a recipe, with initial weights drawn from the recipe's seed. Raises ValueError."""
    card = card_of(recipe, version="0")
    sizes: dict[str, Any] = {"n_channels": len(card.input.channels), "n_classes": len(card.classes)}
    if recipe.network == "ssadnet":
        sizes["front"] = recipe.front
    torch.manual_seed(recipe.seed)
    if recipe.edge:
        if recipe.network not in EDGE:
            raise ValueError(f"{recipe.network} has no network for small computers; expected {' or '.join(EDGE)}")
        if recipe.network != "lodnn":
            sizes["width"] = recipe.width
        return EDGE[recipe.network](**sizes)
    if recipe.width != 1.0:
        raise ValueError(f"width is {recipe.width:g}; only networks for small computers (--edge) have one")
    sizes["dropout"] = recipe.dropout
    if recipe.network in ("camseg", "pointseg"):
        sizes["deep_supervision"] = recipe.deep_supervision > 0.0
    if recipe.network in ("lodnn", "ssadnet"):
        sizes |= {"context_width": recipe.context_width, "batch_norm": recipe.batch_norm}
    if recipe.network == "ssadnet":
        sizes["head"] = recipe.head
    return LARGE[recipe.network](**sizes)
