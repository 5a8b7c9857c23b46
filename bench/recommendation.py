"""The setting that was fastest on this kind of machine, kept in a file so that a later program can use it."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from .report import ReportError

__all__ = ["read_recommendation", "write_recommendation"]

SCHEMA = 1


def write_recommendation(path: Path, machine: str, entries: Mapping[str, Mapping[str, Any]]) -> None:
    """Put settings into a file, beside those of other machines and models, in place of older ones.

    Parameters
    ----------
    path : Path
        JSON: ``{"schema": 1, "machines": {fingerprint: {model SHA-256: entry}}}``; made where there is none.
    machine : str
        Of `edgeperc_bench.context.fingerprint`.
    entries : mapping
        Model SHA-256 to ``provider`` and ``n_threads``, as `edgeperc.Perceiver` takes them, and what they rest on:
        ``name``, ``p50_ms``, ``onnxruntime``, ``measured``.

    Raises
    ------
    ReportError
        The file is there and is something else.
    """
    document = _read(path) if path.exists() else {"schema": SCHEMA, "machines": {}}
    document["machines"].setdefault(machine, {}).update({sha: dict(entry) for sha, entry in entries.items()})
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"{path.name}.part{os.getpid()}")
    part.write_text(json.dumps(document, indent=1, sort_keys=True, allow_nan=False) + "\n", encoding="utf-8")
    part.replace(path)  # a reader finds the old file or the new one, whole


def read_recommendation(path: Path, machine: str, sha256: str) -> dict[str, Any] | None:
    """The setting for a machine and a model; None where nobody measured it.

    Raises
    ------
    ReportError
    """
    entry: dict[str, Any] | None = _read(path)["machines"].get(machine, {}).get(sha256) if path.exists() else None
    return entry


def _read(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as exc:
        raise ReportError(f"{path} cannot be read as recommendations: {exc}") from exc
    if (
        not isinstance(document, dict)
        or document.get("schema") != SCHEMA
        or not isinstance(document.get("machines"), dict)
    ):
        raise ReportError(f"{path} holds no recommendations of schema {SCHEMA}; name another file, or delete it")
    return document
