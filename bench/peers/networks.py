"""The networks at other image sizes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from edgeperc import ModelError
from edgeperc.types.views import TopViewGeometry
from edgeperc.zoo import resolve


def resized(model: str, share: float, folder: Path) -> Path:
    """Make the same network for a view with ``share`` times the pixels, with random weights in fp32.

    A range image gets ``share`` times the columns, a top view ``share`` times the range.

    Raises ModelError.
    """
    from edgeperc_export.networks import build
    from edgeperc_export.recipe import Recipe
    from edgeperc_export.release.to_onnx import to_graph, write_card

    variant = resolve(model)[0]
    card = variant.card
    recipe = card.training.get("recipe")
    if not isinstance(recipe, dict):
        raise ModelError(
            f"the card of {variant.path} has no training recipe; without one its network cannot be rebuilt"
        )
    view: Any = card.view
    if isinstance(view, TopViewGeometry):
        near, far = view.x_range_m
        view = replace(view, x_range_m=(near, near + share * (far - near)))
    else:
        view = replace(view, width=round(share * view.width))
    card = replace(card, view=view, golden=None, precision="fp32", precisions={})
    made = folder / f"{card.name}-{share:g}.onnx"
    write_card(to_graph(build(Recipe(**recipe)), card), card, made)
    return made
