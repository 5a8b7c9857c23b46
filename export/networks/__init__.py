"""The networks, one file each."""

from __future__ import annotations

import torch
from torch import nn

from ..recipe import Recipe, task_name
from .edge import PointSegEdge, SSADNetEdge
from .kulseg import KULSeg
from .lodnn import LoDNN, LoDNNEdge
from .pointseg import PointSeg
from .squeezesegv2 import SqueezeSegV2
from .ssadnet import SSADNet

__all__ = ["EDGE", "build"]

EDGE: dict[str, type[nn.Module]] = {"lodnn": LoDNNEdge, "pointseg": PointSegEdge, "ssadnet": SSADNetEdge}


def build(recipe: Recipe) -> nn.Module:
    """The network of a recipe, with initial weights drawn from the recipe's seed.

    Raises
    ------
    ValueError
        The network or its head is unknown, or the network has no version for small computers.
    """
    task_name(recipe.network)  # raises ValueError for an unknown network
    torch.manual_seed(recipe.seed)
    if recipe.edge:
        if recipe.network not in EDGE:
            raise ValueError(f"{recipe.network} has no network for small computers; expected {' or '.join(EDGE)}")
        return EDGE[recipe.network]()
    if recipe.network == "pointseg":
        return PointSeg(dropout=recipe.dropout, deep_supervision=recipe.deep_supervision > 0.0)
    if recipe.network == "squeezesegv2":
        return SqueezeSegV2(dropout=recipe.dropout)
    if recipe.network == "kulseg":
        return KULSeg(dropout=recipe.dropout)
    if recipe.network == "lodnn":
        return LoDNN(context_width=recipe.context_width, batch_norm=recipe.batch_norm, dropout=recipe.dropout)
    width, norm = recipe.context_width, recipe.batch_norm
    return SSADNet(head=recipe.head, context_width=width, batch_norm=norm, dropout=recipe.dropout)
