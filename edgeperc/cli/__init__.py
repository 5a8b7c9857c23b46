"""The ``edgeperc`` command: one file for each subcommand; `main` joins them."""

from __future__ import annotations

from .main import main

__all__ = ["main"]
