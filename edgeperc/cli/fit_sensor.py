"""``edgeperc fit-sensor``: a sensor profile from scans."""

from __future__ import annotations

import argparse
from itertools import islice
from pathlib import Path

from ..errors import PointsError, SensorError
from ..system.atomic import write_atomic
from .arguments import Commands, add_command, add_ego_box, options
from .output import make_folder, print_rows
from .scans import check_profile_place, find_scans, nothing_below, with_mounting

_MOST_OF_PORTS = 50  # scans of a sensor that goes on sending


def add_parser(commands: Commands) -> None:
    """Add ``fit-sensor``."""
    parser = add_command(
        commands,
        "fit-sensor",
        fit_sensor_command,
        help="fit a sensor's remission to the training sensor's and write a profile",
        description="Fit a function that maps the remission of one sensor to that of another, and write a sensor "
        "profile for --sensor. It needs unlabeled scans of any streets, at least a dozen from different places. It "
        "assumes that both sensors meet surfaces of the same brightness equally often.",
        examples=[
            "edgeperc fit-sensor drives/ --sensor os1-64 --out my-os1.json",
            "edgeperc run drives/ --sensor my-os1.json",
        ],
    )
    reading = options(parser, "input")
    reading("scans SCAN...", "scan files, captures, or folders of them, as for 'run'", type=Path)
    recorded = "the LiDAR that recorded the scans, as for 'run', but not auto: 'edgeperc info' names it (required)"
    reading("--sensor SENSOR", recorded, required=True)
    add_ego_box(reading)
    reading(
        "--to SENSOR",
        "the sensor to map to: the one that the models were trained on (default: %(default)s)",
        default="hdl-64e",
    )
    options(parser, "output")("--out FILE", "the profile to write, a .json file (required)", required=True)


def fit_sensor_command(arguments: argparse.Namespace) -> int:
    """Fit a remission function and write the sensor profile."""
    from ..preprocess.sensor_fit import fit_sensor
    from ..readers.captures import read_scans
    from ..readers.ports import is_port
    from ..types.sensor import get_sensor

    files = find_scans(arguments.scans)
    if files.empty:
        raise PointsError(nothing_below(files.empty[0]))
    if arguments.out.suffix != ".json":
        raise SensorError(
            f"{arguments.out}: expected a name that ends in .json: --sensor reads other names as built-in sensors"
        )
    check_profile_place(arguments.out)
    make_folder(arguments.out.parent, "--out")
    scans = [
        points
        for path in files.paths
        for _, points in islice(read_scans(path), _MOST_OF_PORTS if is_port(path) else None)
    ]
    profile, functions = fit_sensor(scans, get_sensor(with_mounting(arguments.sensor, arguments)), arguments.to)
    assert profile.remission is not None
    write_atomic(arguments.out, (profile.to_json() + "\n").encode())
    rows = [
        (f.kind, f"RMSE {f.rmse:.4f}; coefficients {', '.join(f'{c:.5g}' for c in f.coefficients)}") for f in functions
    ]
    print_rows([*rows, ("written", f"{arguments.out}: {profile.name} with the {profile.remission.kind}")])
    return 0
