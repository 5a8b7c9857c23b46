"""The entry point of function.yaml: nuclio looks for both names here."""

from edgeperc.cli.cvat import handler, init_context

__all__ = ["handler", "init_context"]
