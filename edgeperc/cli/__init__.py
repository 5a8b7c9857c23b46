"""The ``edgeperc`` command, one file a subcommand; `main` runs it."""

from __future__ import annotations

from .main import main

__all__ = ["main"]
