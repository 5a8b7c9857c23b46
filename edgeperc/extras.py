"""Import packages of the optional extras."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from .errors import MissingExtraError

__all__ = ["require"]


def require(module: str, extra: str, purpose: str, *, package: str | None = None) -> Any:
    """Import a module of an optional package.

    Parameters
    ----------
    module : str
        Dotted name, e.g. ``"matplotlib"``.
    extra : str
        The extra of edgeperc that installs the package.
    purpose : str
        What needs the package; the beginning of the error message.
    package : str, optional
        Name on PyPI if it is not the module's top-level name.

    Returns
    -------
    module

    Raises
    ------
    MissingExtraError
        The module cannot be imported; the message gives the command that installs it.
    """
    try:
        return import_module(module)
    except ImportError as exc:
        raise MissingExtraError(package or module.partition(".")[0], extra, purpose) from exc
