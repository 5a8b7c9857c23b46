"""The ``edgeperc`` command: one file for each subcommand, and `main`, which runs them."""

from .main import main

__all__ = ["main"]
