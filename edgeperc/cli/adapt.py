"""``edgeperc adapt fit``: a sensor profile from scans."""

from __future__ import annotations

import argparse

from ..errors import PointsError, SensorError
from .output import print_rows
from .run import find_scans

__all__ = ["fit_command"]

# adapt


def fit_command(arguments: argparse.Namespace) -> int:
    """``edgeperc adapt fit``: fit a remission function and write the sensor profile."""
    from ..readers.captures import read_scans
    from ..sensor import get_sensor
    from ..sensor_fit import fit_sensor

    paths, empty = find_scans(arguments.scans)
    if empty:
        raise PointsError(f"{empty[0]}: no scan in this folder; expected scans or captures")
    if arguments.out.suffix != ".json":
        raise SensorError(f"{arguments.out}: a profile's name ends in .json, so that --sensor knows it for a file")
    scans = [points for path in paths for _, points in read_scans(path)]
    profile, functions = fit_sensor(scans, get_sensor(arguments.sensor), arguments.to)
    assert profile.remission is not None
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(profile.to_json() + "\n", encoding="utf-8")
    rows = [
        (f.kind, f"RMSE {f.rmse:.4f}; coefficients {', '.join(f'{c:.5g}' for c in f.coefficients)}") for f in functions
    ]
    print_rows([*rows, ("written", f"{arguments.out}: {profile.name} with the {profile.remission.kind}")])
    return 0
