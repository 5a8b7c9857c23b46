"""Options that several commands share, and how every command's help page is built."""

from __future__ import annotations

import argparse
import math
import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from ..inference import providers
from ..types import choices
from ..types.choices import DEFAULT_MODELS, DEFAULT_SENSOR, WEIGHTS

Commands = Any  # what ArgumentParser.add_subparsers returns; argparse keeps its class private
_WIDTH = 78

PROVIDERS = ("auto", *sorted(providers.PROVIDERS))
PRECISIONS = ("auto", *choices.PRECISIONS)


def add_command(
    commands: Commands,
    name: str,
    command: Callable[[argparse.Namespace], int],
    *,
    help: str,
    description: str,
    examples: Sequence[str],
) -> argparse.ArgumentParser:
    """Add a subcommand: ``command`` takes the parsed arguments and returns the exit code, ``examples`` are printed
    below the options.
    """
    parser: argparse.ArgumentParser = commands.add_parser(
        name,
        help=help,
        description="\n\n".join(textwrap.fill(paragraph, _WIDTH) for paragraph in description.split("\n\n")),
        epilog="\n".join(["examples:", *(f"  {example}" for example in examples)]),
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,  # an abbreviation would become ambiguous with a new option
    )
    parser.set_defaults(command=command, usage_error=parser.error)
    return parser


def add_sensor(group: Any, *, required: bool = False, of_capture: bool = False) -> None:
    """Add ``--sensor``; with ``of_capture``, it is None by default, for the sensor that a capture names."""
    default = "auto" if of_capture else DEFAULT_SENSOR
    group.add_argument(
        "--sensor",
        required=required,
        default=None if required or of_capture else DEFAULT_SENSOR,
        metavar="SENSOR",
        help="the LiDAR that recorded the scans: a name from 'edgeperc sensors', a public set (av2, ddad, lyft, "
        "pandaset, semantickitti, vod), a .json file written by 'edgeperc "
        "fit-sensor' or 'edgeperc info --write', or auto: the one that a capture names, otherwise the one whose beams "
        "are found in the points of the first scans" + (" (required)" if required else f" (default: {default})"),
    )


def add_mounting(group: Any) -> None:
    """Add options of the mounting and ``--ego-box``; `edgeperc.cli.scans.with_mounting` reads them."""
    group.add_argument(
        "--mount-height",
        type=finite_number,
        metavar="M",
        help="height of the scan's origin above the road [m] (default: found from the ground in the scans)",
    )
    group.add_argument(
        "--roll",
        type=finite_number,
        metavar="DEG",
        help="tilt of the sensor to the right, its left side up [deg]; 180: it hangs upside down (default: found from "
        "the ground in the scans)",
    )
    group.add_argument(
        "--pitch",
        type=finite_number,
        metavar="DEG",
        help="tilt of the sensor, positive if it looks down ahead [deg] (default: found from the ground in the scans)",
    )
    group.add_argument(
        "--turn",
        type=_yaw,
        metavar="DEG",
        help="direction of the scan's x axis, counter-clockwise from straight ahead [deg]: -90 for x right, y forward; "
        "or 'street': the direction of the street, found from the scans (default: 0)",
    )
    group.add_argument(
        "--extrinsic",
        type=Path,
        metavar="FILE",
        help="T_vehicle_sensor, a 4 x 4 matrix as JSON or text: maps points of a scan into a vehicle frame with x "
        "forward, z up, and z = 0 on the road (default: tilt is found from the ground in the scans)",
    )
    add_ego_box(group)


def add_ego_box(group: Any) -> None:
    """Add ``--ego-box``; `edgeperc.cli.scans.with_mounting` reads it."""
    group.add_argument(
        "--ego-box",
        nargs=6,
        type=finite_number,
        metavar=("X", "X", "Y", "Y", "Z", "Z"),
        help="the vehicle or robot that carries the sensor: lowest and highest x, y and z about the sensor, along the "
        "scan's axes [m]; points inside are dropped, e.g. --ego-box -2.5 1.5 -1 1 -1.5 -0.2; 'edgeperc info' suggests "
        "it from several scans (default: the profile's, none for the built-in ones)",
    )


def _yaw(text: str) -> float | str:
    return text if text == "street" else finite_number(text)


def _place(text: str) -> float | str:
    return text if text == "auto" else finite_number(text)


def with_whole_options(given: Sequence[str]) -> list[str]:
    """Arguments in which ``--origin auto`` has the three values that argparse expects."""
    whole: list[str] = []
    for argument in given:
        is_auto = argument == "auto" and whole[-1:] == ["--origin"]
        whole += ["auto"] * 3 if is_auto else [argument]
    return whole


def add_topic(group: Any) -> None:
    """Add ``--topic``."""
    group.add_argument(
        "--topic",
        metavar="NAME",
        help="what to read of several sensors: the topic of a bag, TOPIC@FRAME, the serial number of an Ouster, the "
        "address of a Velodyne (default: the only one)",
    )


def add_fields(group: Any) -> None:
    """Add ``--columns``, ``--remission-field``, ``--remission-range`` and ``--origin``."""
    group.add_argument(
        "--columns",
        nargs="+",
        metavar="NAME",
        help="what .bin files hold for each point, in order; after the paths: --columns x y z intensity ring (default: "
        "x y z remission, unless the values show that there are more or fewer)",
    )
    group.add_argument(
        "--remission-field",
        metavar="NAME",
        help="the field to take the remission from (default: the first of remission, intensity, i, reflectivity, "
        "reflectance; reflectivity for an Ouster)",
    )
    group.add_argument(
        "--remission-range",
        nargs=2,
        type=finite_number,
        metavar=("LOW", "HIGH"),
        help="lowest and highest raw value of the remission, such as 0 65535 (default: the sensor's)",
    )
    group.add_argument(
        "--origin",
        nargs=3,
        type=_place,
        metavar=("X", "Y", "Z"),
        help="place of the sensor in the map [m], for scan files with coordinates of a map: it is subtracted, and "
        "--json and --ply give boxes and points in the map; or 'auto', for a level sensor: where its beams meet "
        "(default: 0 0 0)",
    )


def reading_options(arguments: argparse.Namespace) -> dict[str, Any]:
    """Options of `edgeperc.read_scans` from ``--topic`` and those of `add_fields`."""
    return {"topic": arguments.topic, **file_options(arguments)}


def file_options(arguments: argparse.Namespace) -> dict[str, Any]:
    """Options of `edgeperc.read_points` from those of `add_fields`."""
    origin = arguments.origin
    if origin is not None and "auto" in origin:
        if set(origin) != {"auto"}:
            arguments.usage_error(f"--origin {' '.join(map(str, origin))}: expected X Y Z, or auto")
        origin = "auto"
    return {"columns": arguments.columns, "remission_field": arguments.remission_field, "origin_m": origin}


def add_model(group: Any, default: Sequence[str] = DEFAULT_MODELS) -> None:
    """Add ``--model``, which may be repeated."""
    group.add_argument(
        "--model",
        action="append",
        metavar="MODEL",
        help="a name from 'edgeperc models', one of its variants such as pointseg:int8, or the path of an .onnx file "
        f"with a card; repeat the option to run one model of each kind (default: {' and '.join(default)})",
    )
    group.add_argument(
        "--weights",
        choices=(*WEIGHTS,),
        default="default",
        help=f"open: {', '.join(WEIGHTS['open'])}, which anyone may use commercially, in place of the most accurate "
        "models, whose weights have the terms of KITTI (default: %(default)s)",
    )


def chosen_models(arguments: argparse.Namespace) -> Sequence[str]:
    """The models of ``--model`` or of ``--weights``."""
    if arguments.model and arguments.weights != "default":
        arguments.usage_error(f"--model and --weights {arguments.weights} both name models; leave out one")
    return arguments.model or WEIGHTS[arguments.weights]


def add_provider(group: Any, *, provider: str = "auto", precision: str = "auto") -> None:
    """Add ``--provider`` and ``--precision``."""
    group.add_argument(
        "--provider",
        default=provider,
        metavar="PROVIDER",
        help=f"the onnxruntime execution provider: {', '.join(PROVIDERS)}; auto takes the fastest one measured "
        "on this computer or, without a measurement, the first of cuda, openvino and cpu that runs the model; with any "
        "other name, it is an error if that provider is not available (default: %(default)s)",
    )
    group.add_argument(
        "--precision",
        choices=PRECISIONS,
        default=precision,
        help="number format of the networks' arithmetic; auto takes bf16 or int8 only if the model's card shows that "
        "its results agree with fp32 (default: %(default)s)",
    )


def add_network(group: Any) -> None:
    """Add options of networks: `add_provider`, ``--threads``, ``--trusted``, ``--boxes-from``, ``--full-turn``."""
    add_provider(group)
    group.add_argument(
        "--threads",
        type=positive,
        metavar="N",
        help="threads inside one network (default: the provider's choice, usually one for each core)",
    )
    group.add_argument(
        "--trusted",
        action="store_true",
        help="open models whose graphs have unusual operators, subgraphs or sizes; only for files whose "
        "origin you know (default: refuse them)",
    )
    add_boxes_from(group)
    add_agreement(group)
    group.add_argument(
        "--full-turn",
        action="store_true",
        help="run the range-image model on all four quarters of the turn, so that every point around the vehicle gets "
        "a class; the network takes four times as long (default: only the quarter ahead)",
    )


def add_boxes_from(group: Any) -> None:
    """Add ``--score-threshold`` and ``--boxes-from``."""
    group.add_argument(
        "--score-threshold",
        type=share,
        metavar="S",
        help="return boxes from this score on, 0 to 1; published figures of detectors are mostly from 0.1 on "
        "(default: each model's)",
    )
    group.add_argument(
        "--boxes-from",
        choices=("both", "network", "clusters"),
        default="both",
        help="network: boxes of the top-view model (vehicles ahead); clusters: boxes around clusters of labeled "
        "points (every class, where points have a class); both: network boxes, and cluster boxes where there are no "
        "network boxes (default: %(default)s)",
    )


def add_agreement(group: Any) -> None:
    """Add ``--no-agreement``."""
    group.add_argument(
        "--no-agreement",
        action="store_true",
        help="return the labels, boxes and cells of the networks as they are (default: correct them by one another, by "
        "the ground and by clusters)",
    )


def add_adapt(group: Any) -> None:
    """Add ``--adapt``."""
    group.add_argument(
        "--adapt",
        choices=("both", "remission", "interpolation", "none"),
        default="both",
        help="how to adapt scans of a sensor other than the training sensor: remission maps its remission to the "
        "training sensor's, interpolation fills the range image between its beams; no effect on an hdl-64e (default: "
        "%(default)s)",
    )


def positive(text: str) -> int:
    """Parse a count of at least 1."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{value} is too small; expected 1 or more")
    return value


def positive_number(text: str) -> float:
    """Parse a finite number above 0."""
    value = float(text)
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{value} is out of range; expected a number above 0")
    return value


def finite_number(text: str) -> float:
    """Parse a finite number."""
    value = float(text)
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{value} is not finite; expected a number")
    return value


def share(text: str) -> float:
    """Parse a number in 0..1."""
    value = finite_number(text)
    if not 0.0 <= value <= 1.0:
        raise argparse.ArgumentTypeError(f"{value:g} is not in 0..1")
    return value


def add_figures_file(group: Any) -> None:
    """Add ``--json FILE``, for the commands that print tables."""
    group.add_argument(
        "--json",
        type=Path,
        metavar="FILE",
        help="write all figures to this JSON file, with the command line that produced them (default: tables only)",
    )
