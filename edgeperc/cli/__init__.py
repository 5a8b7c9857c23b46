"""The ``edgeperc`` command: one file for each subcommand, and `main`, which runs them."""

from __future__ import annotations

from .main import main

__all__ = ["main"]
