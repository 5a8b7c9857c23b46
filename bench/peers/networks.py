"""The networks at other image sizes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from edgeperc import ModelError
from edgeperc.card import TopViewGeometry
from edgeperc.session import Session
from edgeperc.zoo import model_path

__all__ = ["resized"]


def resized(model: str, share: float, folder: Path) -> Path:
    """A model of the same network for a view of ``share`` times the pixels, its weights at random.

    A range image gets as many times the columns, a top view reaches as many times as far.

    Raises
    ------
    ModelError
        The card does not say how the network was made, or the network does not fit such an image.
    """
    from edgeperc_export.networks import build
    from edgeperc_export.recipe import Recipe
    from edgeperc_export.to_onnx import to_graph, write_card

    path = Path(model) if model.endswith(".onnx") else model_path(model)
    card = Session(path, "cpu").card
    recipe = card.training.get("recipe")
    if not isinstance(recipe, dict):
        raise ModelError(f"the card of {path} has no training recipe, by which its network could be made again")
    view: Any = card.view
    if isinstance(view, TopViewGeometry):
        near, far = view.x_range_m
        view = replace(view, x_range_m=(near, near + share * (far - near)))
    else:
        view = replace(view, width=round(share * view.width))
    card = replace(card, view=view, golden=None)
    made = folder / f"{card.name}-{share:g}.onnx"
    write_card(to_graph(build(Recipe(**recipe)), card), card, made)
    return made
