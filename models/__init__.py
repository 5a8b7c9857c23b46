"""The models that come with edgeperc: .onnx files, each carrying its card; installed as ``edgeperc.zoo``."""

from __future__ import annotations

import os
from importlib import resources
from pathlib import Path

from edgeperc.errors import ModelFileError

__all__ = ["DEFAULT", "model_path", "resolve", "shipped_models"]


def shipped_models() -> tuple[str, ...]:
    """Names of the models in this installation, sorted."""
    names = (entry.name for entry in resources.files(__name__).iterdir())
    return tuple(sorted(name.removesuffix(".onnx") for name in names if name.endswith(".onnx")))


def model_path(name: str) -> Path:
    """Where a shipped model lies.

    Parameters
    ----------
    name : str
        One of `shipped_models`, such as ``"pointseg"``.

    Returns
    -------
    path : Path
        The .onnx file.

    Raises
    ------
    ModelFileError
        No model of that name is shipped; the message lists those that are.
    """
    shipped = shipped_models()
    if name not in shipped:
        known = ", ".join(shipped) or "none in this installation"
        raise ModelFileError(f"no model is called {name!r}. Shipped: {known}. Or give the path of an .onnx file.")
    return Path(str(resources.files(__name__).joinpath(f"{name}.onnx")))


DEFAULT = ("ssadnet", "pointseg")


def resolve(model: str | os.PathLike[str]) -> Path:
    """A shipped name, or anything that looks like a file, as a path."""
    if isinstance(model, str) and Path(model).suffix != ".onnx":
        return model_path(model)
    return Path(model)
