"""Import packages of the optional extras."""

from __future__ import annotations

import os
import sys
from importlib import import_module
from typing import Any

from ..errors import MissingExtraError


def require(module: str, extra: str, purpose: str, *, package: str | None = None) -> Any:
    """Import a module of an optional package; the error names the extra that installs it, and what needs it.

    purpose : the beginning of the error message.
    package : name on PyPI if it is not the module's top-level name.
    """
    try:
        return import_module(module)
    except ImportError as exc:
        damaged = "" if isinstance(exc, ModuleNotFoundError) else str(exc)
        raise MissingExtraError(package or module.partition(".")[0], extra, purpose, damaged) from exc


def without_telemetry() -> None:
    """Set ``ORT_DISABLE_TELEMETRY=1`` in this process, before onnxruntime is imported.

    Since version 1.29, importing onnxruntime on Linux writes a device id and a database of events for Microsoft into
    the user's cache folder. A value that is already set stays. If onnxruntime is already imported, nothing changes,
    because it reads the variable only then.
    """
    if "onnxruntime" not in sys.modules:
        os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
