"""``edgeperc models``, ``edgeperc sensors`` and ``edgeperc providers``: tables of what is available."""

from __future__ import annotations

import argparse
import json
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from typing import Any

from ..errors import SettingsError
from ..types.choices import DEFAULT_SENSOR, PUBLIC_SETS
from .arguments import Commands, add_command, options
from .output import print_columns, print_line


def add_parser(commands: Commands) -> None:
    """Add ``models``, ``sensors`` and ``providers``."""
    for name, command, help, description in (
        (
            "models",
            models_command,
            "the installed models: what each is for, its size, its speed here",
            "List the installed models. Pass a name to --model. 'measured here' is the median time of a scan [ms] "
            "with the fastest setting that 'edgeperc-bench matrix --recommend' found on this computer.",
        ),
        (
            "sensors",
            sensors_command,
            "the built-in sensors: beams, field of view, remission",
            f"List the built-in sensors. Pass a name to --sensor, or a public set: {', '.join(PUBLIC_SETS)}. For "
            "another sensor, pass a .json file, see 'edgeperc fit-sensor'. 'mapped to' is the sensor whose remission "
            "scale the remission is mapped to, 'gathered' the time of a scan of one that does not spin, with the beams "
            "and columns that then show.",
        ),
        (
            "providers",
            providers_command,
            "the execution providers, which of them are available here, and how to install the others",
            "List onnxruntime's execution providers. Pass a name to --provider. If nothing was measured here, "
            "--provider auto takes the first available one of cuda, openvino and cpu.",
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
        options(parser, "output")("--json", "print one JSON object for each line of the table")


def models_command(arguments: argparse.Namespace) -> int:
    """Print `edgeperc.models`, with the fastest setting measured on this computer."""
    from ..inference.listing import models
    from ..system.machine import fingerprint, read_setting, settings_path
    from ..zoo import digest, resolve

    machine, listed = fingerprint(), models()
    measured: list[dict[str, Any] | None] = [None] * len(listed)
    try:
        measured = [read_setting(settings_path(), machine, digest(resolve(model.name))) for model in listed]
    except SettingsError as exc:
        warnings.warn(f"what was measured on this computer is not shown: {exc}", stacklevel=2)
    return _print(
        [{**_fields(model), "measured": setting} for model, setting in zip(listed, measured, strict=True)],
        {
            "name": lambda row: row["name"],
            "default": lambda row: _mark(row["default"]),
            "for": lambda row: row["purpose"],
            "size [MB]": lambda row: ", ".join(f"{precision} {mb:.1f}" for precision, mb in row["variants"].items()),
            "measured here": lambda row: _measured(row["measured"]),
            "licence": lambda row: row["licence"].partition(",")[0],
        },
        arguments,
    )


def sensors_command(arguments: argparse.Namespace) -> int:
    """Print `edgeperc.sensors`."""
    from ..inference.listing import sensors

    return _print(
        [{**_fields(sensor), "default": sensor.name == DEFAULT_SENSOR} for sensor in sensors()],
        {
            "name": lambda row: row["name"],
            "default": lambda row: _mark(row["default"]),
            "beams": lambda row: str(row["beams"]),
            "elevations [deg]": lambda row: "{:g} .. {:g}".format(*row["field_of_view_deg"]),
            "columns": lambda row: str(row["columns"]),
            "remission": lambda row: "{:g} .. {:g}".format(*row["remission_range"]),
            "range [m]": lambda row: "{:g} .. {:g}".format(*row["range_m"]),
            "mapped to": lambda row: row["rendered_as"] or "-",
            "gathered": lambda row: "-" if row["accumulate_s"] is None else f"{row['accumulate_s']:g} s",
        },
        arguments,
    )


def providers_command(arguments: argparse.Namespace) -> int:
    """Print `edgeperc.providers`."""
    from ..inference.listing import providers

    return _print(
        [_fields(provider) for provider in providers()],
        {
            "name": lambda row: row["name"],
            "available": lambda row: _mark(row["available"]),
            "installed by": lambda row: row["installed_by"],
        },
        arguments,
    )


def _fields(record: Any) -> dict[str, Any]:
    return {field.name: getattr(record, field.name) for field in fields(record)}


def _measured(setting: Mapping[str, Any] | None) -> str:
    if setting is None:
        return "-"
    ran = " ".join(str(setting[key]) for key in ("provider", "precision") if key in setting)
    return f"{setting['p50_ms']:.1f} ms, {ran}" if "p50_ms" in setting else ran


def _mark(flag: bool) -> str:
    return "yes" if flag else "-"


def _print(
    records: Sequence[Mapping[str, Any]],
    columns: Mapping[str, Callable[[Mapping[str, Any]], str]],
    arguments: argparse.Namespace,
) -> int:
    if arguments.json:
        for record in records:
            plain = {key: dict(value) if isinstance(value, Mapping) else value for key, value in record.items()}
            print_line(json.dumps(plain, allow_nan=False, default=str))
    else:
        print_columns([*columns], [[cell(record) for cell in columns.values()] for record in records])
    return 0
