"""``edgeperc models``, ``edgeperc sensors`` and ``edgeperc providers``: what there is to choose from."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from .arguments import DEFAULT, Commands, add_command
from .output import print_columns, say

__all__ = ["add_parser", "models_command", "providers_command", "sensors_command"]


def add_parser(commands: Commands) -> None:
    """Add ``models``, ``sensors`` and ``providers``."""
    for name, command, help, description in (
        (
            "models",
            models_command,
            "the installed models: what each is for, its size, its speed here",
            "List the installed models. The names are for --model. 'measured here' is the median time of a scan [ms] "
            "with the fastest setting that 'edgeperc-bench matrix --recommend' found on this computer.",
        ),
        (
            "sensors",
            sensors_command,
            "the built-in sensors: beams, field of view, remission",
            "List the built-in sensors. The names are for --sensor; another sensor is described by a .json file, see "
            "'edgeperc fit-sensor'. 'adapted' says whether its remission is mapped to the training sensor's.",
        ),
        (
            "providers",
            providers_command,
            "the execution providers: which of them run on this computer",
            "List onnxruntime's execution providers. The names are for --provider. The first available one of cuda, "
            "openvino and cpu is taken by --provider auto if nothing was measured here.",
        ),
    ):
        parser = add_command(
            commands,
            name,
            command,
            help=help,
            description=description,
            examples=[f"edgeperc {name}", f"edgeperc {name} --json"],
        )
        output = parser.add_argument_group("output")
        output.add_argument("--json", action="store_true", help="print one JSON object for each line of the table")


def models_command(arguments: argparse.Namespace) -> int:
    """Print the installed models."""
    columns = {
        "name": lambda of: of["name"],
        "default": lambda of: _mark(of["default"]),
        "for": lambda of: of["task"],
        "size [MB]": lambda of: ", ".join(f"{name} {size:.1f}" for name, size in of["size_mb"].items()),
        "measured here": lambda of: "-" if of["ms"] is None else f"{of['ms']:.1f} ms, {of['setting']}",
        "licence": lambda of: str(of["licence"]).partition(",")[0],
    }
    return _print(_models(), columns, arguments)


def sensors_command(arguments: argparse.Namespace) -> int:
    """Print the built-in sensors."""
    columns = {
        "name": lambda of: of["name"],
        "default": lambda of: _mark(of["default"]),
        "beams": lambda of: str(of["n_beams"]),
        "elevations [deg]": lambda of: f"{of['fov_down_deg']:g} .. {of['fov_up_deg']:g}",
        "columns": lambda of: str(of["columns"]),
        "remission": lambda of: "{:g} .. {:g}".format(*of["remission_range"]),
        "range [m]": lambda of: f"{of['min_range_m']:g} .. {of['max_range_m']:g}",
        "height [m]": lambda of: f"{of['mount_height_m']:g}",
        "adapted": lambda of: _mark(of["adapted"]),
    }
    return _print(_sensors(), columns, arguments)


def providers_command(arguments: argparse.Namespace) -> int:
    """Print the execution providers."""
    columns = {
        "name": lambda of: of["name"],
        "available": lambda of: _mark(of["available"]),
        "onnxruntime's name": lambda of: of["onnxruntime"],
    }
    return _print(_providers(), columns, arguments)


def _mark(flag: bool) -> str:
    return "yes" if flag else "-"


def _print(
    records: Sequence[Mapping[str, Any]],
    columns: Mapping[str, Callable[[Mapping[str, Any]], str]],
    arguments: argparse.Namespace,
) -> int:
    if arguments.json:
        for record in records:
            say(json.dumps(record, allow_nan=False))
    else:
        print_columns([*columns], [[cell(record) for cell in columns.values()] for record in records])
    return 0


def _models() -> list[dict[str, Any]]:
    from ..listing import purpose
    from ..tuning import fingerprint, read_setting, settings_path
    from ..zoo import digest, resolve, shipped_models

    machine, records = fingerprint(), []
    for name in shipped_models():
        variants = resolve(name)
        card = variants[0].card
        setting = read_setting(settings_path(), machine, digest(variants)) or {}
        records.append(
            {
                "name": name,
                "version": card.version,
                "default": name in DEFAULT,
                "task": purpose(card),
                "size_mb": {variant.precision: round(variant.path.stat().st_size / 1e6, 2) for variant in variants},
                "licence": card.training.get("licence", "not said"),
                "ms": setting.get("p50_ms"),
                "setting": " ".join(str(setting[key]) for key in ("provider", "precision") if key in setting) or None,
                "path": str(variants[0].path),
            }
        )
    return records


def _sensors() -> list[dict[str, Any]]:
    from ..sensor import SENSORS

    keys = ("n_beams", "fov_up_deg", "fov_down_deg", "columns", "remission_range", "min_range_m", "max_range_m")
    return [
        {
            "name": profile.name,
            "default": profile.name == "hdl-64e",
            **{key: getattr(profile, key) for key in (*keys, "mount_height_m")},
            "adapted": profile.remission is not None,
        }
        for profile in SENSORS.values()
    ]


def _providers() -> list[dict[str, Any]]:
    from ..session import PROVIDERS, available_providers

    present = available_providers()
    return [{"name": name, "available": name in present, "onnxruntime": full} for name, full in PROVIDERS.items()]
