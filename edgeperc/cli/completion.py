"""``edgeperc completion``: a script that completes the command line in a shell."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import Any

from ..system.extras import require
from .arguments import PROVIDERS, Commands, add_command, options

SHELLS = ("bash", "zsh", "fish", "tcsh")


def add_parser(commands: Commands) -> None:
    """Add ``completion``."""
    parser = add_command(
        commands,
        "completion",
        completion_command,
        help="print a script that completes commands, options and names in a shell",
        description="Print a completion script: commands, options, files, and the names of models, sensors and "
        "providers. Install the extra 'completion' first.",
        examples=[
            "edgeperc completion bash > ~/.local/share/bash-completion/completions/edgeperc",
            "edgeperc completion zsh > ~/.zfunc/_edgeperc    # with fpath+=~/.zfunc",
            "edgeperc completion fish > ~/.config/fish/completions/edgeperc.fish",
            "edgeperc completion tcsh > ~/.edgeperc.tcsh     # with source ~/.edgeperc.tcsh",
        ],
    )
    options(parser)("shell SHELL", "bash, zsh, fish or tcsh", choices=SHELLS)


def completion_command(arguments: argparse.Namespace) -> int:
    """Print the script."""
    shtab = require("shtab", "completion", "Completing a command line")
    from ..types.sensor import PUBLIC_SENSORS, SENSORS
    from ..zoo import shipped_models

    names = {"model": shipped_models(), "sensor": (*SENSORS, *PUBLIC_SENSORS), "provider": PROVIDERS}
    functions: dict[str, list[str]] = {"bash": [], "zsh": [], "fish": []}
    completed = {
        **dict.fromkeys(("FILE", "PATH", "SCAN", "DATASET", "SENSOR=SOURCE", "ROOT"), shtab.FILE),
        "DIR": shtab.DIRECTORY,
    }
    for kind, values in names.items():
        function, choices = f"_edgeperc_{kind}_or_file", " ".join(values)
        completed[kind.upper()] = {"bash": function, "zsh": function, "fish": f"({function})", "tcsh": f"({choices})"}
        # For a function with "file" in its name, shtab adds no space after a completed folder.
        functions["bash"].append(f'{function}() {{ compgen -W \'{choices}\' -- "$1"; compgen -f -- "$1"; }}')
        functions["zsh"].append(f"{function}() {{ compadd {choices}; _files; }}")
        given = "(commandline -ct)"
        functions["fish"].append(f"function {function}; printf '%s\\n' {choices}; __fish_complete_path {given}; end")
    completed["MODEL|SCAN|IMAGE"] = completed["MODEL"]
    for action in _actions(arguments.parser):
        if action.choices is None and action.metavar in completed:
            action.complete = completed[action.metavar]
    preamble = {shell: "\n".join(lines) for shell, lines in functions.items()}
    print(shtab.complete(arguments.parser, arguments.shell, preamble=preamble))
    return 0


def _actions(parser: argparse.ArgumentParser) -> Iterator[Any]:
    """The arguments of a parser and of its subcommands."""
    for action in parser._actions:
        yield action
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                yield from _actions(command)
