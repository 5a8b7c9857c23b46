"""Options that several commands share, and how every command's help page is built."""

from __future__ import annotations

import argparse
import math
import shlex
import textwrap
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any

from ..inference import providers
from ..system.remote import Remote, location
from ..types import choices
from ..types.choices import DEFAULT_MODELS, DEFAULT_SENSOR, PUBLIC_SETS, WEIGHTS

Commands = Any  # what ArgumentParser.add_subparsers returns; argparse keeps its class private
_WIDTH = 78

Options = Callable[..., None]  # of `options`

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
    """Add a subcommand: ``command`` returns the exit code, ``examples`` are printed below the options."""
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


def options(parser: argparse.ArgumentParser, title: str | None = None, **defaults: Any) -> Options:
    """A function that adds options, to the group of a title, as the help shows them: ``--live``, ``--json FILE``,
    ``paths PATH...``, ``--size W H``. One without a value is a flag, a FILE or DIR is a path. ``defaults`` are kept.
    """
    parser.set_defaults(**defaults)
    group = parser if title is None else parser.add_argument_group(title)

    def add(shown: str, help: str, **settings: Any) -> None:
        name, *values = shown.removesuffix("...").split()
        if shown.endswith("..."):
            settings["nargs"] = "+"
        elif len(values) > 1:
            settings["nargs"] = len(values)
        if values:
            metavar = values[0] if len(values) == 1 else tuple(values)
            settings = {"metavar": metavar, "type": _local if values[0] in ("FILE", "DIR") else None} | settings
        elif name.startswith("-") and "choices" not in settings:
            settings.setdefault("action", "store_true")
        group.add_argument(name, help=help, **settings)

    return add


def keywords(arguments: argparse.Namespace, *names: str, **renamed: str) -> dict[str, Any]:
    """Options as arguments of a function that calls them the same, or by the parameter: ``n_threads="threads"``."""
    same = {name: name for name in names}
    return {name: getattr(arguments, option) for name, option in (same | renamed).items()}


def _local(text: str) -> Path:
    path = location(text)
    if isinstance(path, Remote):  # as a path it would be a folder with the name of the protocol
        raise argparse.ArgumentTypeError(f"{text} is a URL; expected a path of this computer")
    return path


def add_sensor(group: Options, *, of_capture: bool = False) -> None:
    """Add ``--sensor``; with ``of_capture``, it is None by default, for the sensor that a capture names."""
    default = "auto" if of_capture else DEFAULT_SENSOR
    group(
        "--sensor SENSOR",
        "the LiDAR that recorded the scans: a name from 'edgeperc sensors', a public set "
        f"({', '.join(PUBLIC_SETS)}), a .json file written by 'edgeperc fit-sensor' or 'edgeperc info --write', or "
        "auto: the one that a capture names, otherwise the one whose beams "
        f"are found in the points of the first scans (default: {default})",
        default=None if of_capture else DEFAULT_SENSOR,
    )


def add_mounting(group: Options) -> None:
    """Add options of the mounting and ``--ego-box``; `edgeperc.cli.scans.with_mounting` reads them."""
    group(
        "--mount-height M",
        "height of the scan's origin above the road [m] (default: found from the ground in the scans)",
        type=finite_number,
    )
    group(
        "--roll DEG",
        "tilt of the sensor to the right, its left side up [deg]; 180: it hangs upside down (default: found from "
        "the ground in the scans)",
        type=finite_number,
    )
    group(
        "--pitch DEG",
        "tilt of the sensor, positive if it looks down ahead [deg] (default: found from the ground in the scans)",
        type=finite_number,
    )
    group(
        "--turn DEG",
        "direction of the scan's x axis, counter-clockwise from straight ahead [deg]: -90 for x right, y forward; "
        "or 'street': the direction of the street, found from the scans (default: 0)",
        type=_number_or("street"),
    )
    group(
        "--extrinsic FILE",
        "T_vehicle_sensor, a 4 x 4 matrix as JSON or text: maps points of a scan into a vehicle frame with x "
        "forward, z up, and z = 0 on the road (default: tilt is found from the ground in the scans)",
    )
    add_ego_box(group)


def add_ego_box(group: Options) -> None:
    """Add ``--ego-box``; `edgeperc.cli.scans.with_mounting` reads it."""
    group(
        "--ego-box X X Y Y Z Z",
        "the vehicle or robot that carries the sensor: lowest and highest x, y and z about the sensor, along the "
        "scan's axes [m]; points inside are dropped, e.g. --ego-box -2.5 1.5 -1 1 -1.5 -0.2; 'edgeperc info' suggests "
        "it from several scans (default: the profile's, none for the built-in ones)",
        type=finite_number,
    )


def _number_or(word: str) -> Callable[[str], float | str]:
    return lambda text: text if text == word else finite_number(text)


def with_whole_options(given: Sequence[str]) -> list[str]:
    """Arguments in which ``--origin auto`` has the three values that argparse expects."""
    whole: list[str] = []
    for argument in given:
        whole += ["auto"] * 3 if argument == "auto" and whole[-1:] == ["--origin"] else [argument]
    return whole


def add_capture(group: Options) -> None:
    """Add the sensor, its mounting, and how scans are read; `edgeperc.cli.scans.reading_options` takes those."""
    add_sensor(group, of_capture=True)
    add_mounting(group)
    group(
        "--topic NAME",
        "what to read of several sensors: the topic of a bag, TOPIC@FRAME, the serial number of an Ouster, the "
        "address of a Velodyne (default: the only one)",
    )
    group(
        "--columns NAME...",
        "what .bin files, and .npy files of numbers, hold for each point, in order; after the paths: --columns x y z "
        "intensity ring (default: x y z remission, unless the values of a .bin show that there are more or fewer)",
    )
    group(
        "--remission-field NAME",
        "the field to take the remission from (default: the first of remission, intensity, i, reflectivity, "
        "reflectance; reflectivity for an Ouster)",
    )
    group(
        "--remission-range LOW HIGH",
        "lowest and highest raw value of the remission, such as 0 65535 (default: the sensor's)",
        type=finite_number,
    )
    group(
        "--origin X Y Z",
        "place of the sensor in the map [m], for scan files with coordinates of a map: it is subtracted, and "
        "--json and --ply give boxes and points in the map; or 'auto', for a level sensor: where its beams meet "
        "(default: 0 0 0)",
        type=_number_or("auto"),
    )


def file_options(arguments: argparse.Namespace) -> dict[str, Any]:
    """Options of `edgeperc.read_points` from those of `add_capture`."""
    origin = arguments.origin
    if origin is not None and "auto" in origin:
        if set(origin) != {"auto"}:
            arguments.usage_error(f"--origin {' '.join(map(str, origin))}: expected X Y Z, or auto")
        origin = "auto"
    return {"columns": arguments.columns, "remission_field": arguments.remission_field, "origin_m": origin}


_OF_RECORDINGS = ("--topic", "--accumulate")
_OF_SCAN_FILES = ("--columns", "--origin")
_OF_SCANS = (
    *("--sensor", "--mount-height", "--roll", "--pitch", "--turn", "--extrinsic", "--ego-box", "--remission-field"),
    *("--remission-range", "--on-mismatch", "--anyway", "--score-threshold", "--boxes-from", "--no-agreement"),
    *("--full-turn", "--adapt", *_OF_RECORDINGS, *_OF_SCAN_FILES),
)


def check_inputs(arguments: argparse.Namespace, kinds: Collection[str], example: object) -> None:
    """Check that each option of reading is for one of the inputs: it would change nothing, without a word.

    kinds : ``"recording"`` and ``"scan file"``; neither if there are no scans. Others end early.
    """
    given = {word.partition("=")[0] for word in shlex.split(arguments.typed)}
    if not kinds:
        for option in given.intersection(_OF_SCANS):
            arguments.usage_error(f"{option} is for scans, and {example} is none; leave it out")
    for kind, named in (("recording", _OF_RECORDINGS), ("scan file", _OF_SCAN_FILES)):
        for option in given.intersection(named) if kind not in kinds else ():
            (other,) = kinds
            arguments.usage_error(f"{option} is for {kind}s, and {example} is a {other}; leave it out")


def add_model(group: Options) -> None:
    """Add ``--model``, which may be repeated."""
    group(
        "--model MODEL",
        "a name from 'edgeperc models', one of its variants such as pointseg:int8, or the path of an .onnx file "
        f"with a card; repeat the option to run one model of each kind (default: {' and '.join(DEFAULT_MODELS)})",
        action="append",
    )
    group(
        "--weights",
        f"open: {', '.join(WEIGHTS['open'])}, which anyone may use commercially, in place of the most accurate "
        "models, whose weights have the terms of KITTI (default: %(default)s)",
        choices=(*WEIGHTS,),
        default="default",
    )


def chosen_models(arguments: argparse.Namespace) -> Sequence[str]:
    """The models of ``--model`` or of ``--weights``."""
    if arguments.model and arguments.weights != "default":
        arguments.usage_error(f"--model and --weights {arguments.weights} both name models; leave out one")
    return arguments.model or WEIGHTS[arguments.weights]


def add_provider(group: Options, *, provider: str = "auto") -> None:
    """Add ``--provider`` and ``--precision``."""
    group(
        "--provider PROVIDER",
        f"the onnxruntime execution provider: {', '.join(PROVIDERS)}; auto takes the fastest one measured "
        "on this computer or, without a measurement, the first of cuda, openvino and cpu that runs the model; with any "
        "other name, it is an error if that provider is not available (default: %(default)s)",
        default=provider,
    )
    group(
        "--precision",
        "number format of the networks' arithmetic; auto takes bf16 or int8 only if the model's card shows that "
        "its results agree with fp32 (default: %(default)s)",
        choices=PRECISIONS,
        default="auto",
    )


def add_networks(parser: argparse.ArgumentParser, title: str = "models", *, adapt: bool = True) -> None:
    """Add a group with the options of `add_model` and of a perceiver's networks."""
    group = options(parser, title)
    add_model(group)
    add_provider(group)
    group(
        "--threads N",
        "threads inside one network (default: the provider's choice, usually one for each core)",
        type=positive,
    )
    group(
        "--trusted",
        "open models whose graphs have unusual operators, subgraphs or sizes; only for files whose "
        "origin you know (default: refuse them)",
    )
    add_boxes(group)
    group(
        "--full-turn",
        "run the range-image model on all four quarters of the turn, so that every point around the vehicle gets "
        "a class; the network takes four times as long (default: only the quarter ahead)",
    )
    if adapt:
        group(
            "--adapt",
            "how to adapt scans of a sensor other than the training sensor: remission maps its remission to the "
            "training sensor's, interpolation fills the range image between its beams; no effect on an hdl-64e "
            "(default: %(default)s)",
            choices=("both", "remission", "interpolation", "none"),
            default="both",
        )


def add_boxes(group: Options) -> None:
    """Add ``--score-threshold``, ``--boxes-from`` and ``--no-agreement``."""
    group(
        "--score-threshold S",
        "return boxes from this score on, 0 to 1; published figures of detectors are mostly from 0.1 on "
        "(default: each model's)",
        type=share,
    )
    group(
        "--boxes-from",
        "network: boxes of the top-view model (vehicles ahead); clusters: boxes around clusters of labeled "
        "points (every class, where points have a class); both: network boxes, and cluster boxes where there are no "
        "network boxes (default: %(default)s)",
        choices=("both", "network", "clusters"),
        default="both",
    )
    group(
        "--no-agreement",
        "return the labels, boxes and cells of the networks as they are (default: correct them by one another, by "
        "the ground and by clusters)",
    )


def _parsed(kind: Callable[[str], Any], text: str) -> Any:
    try:
        return kind(text)
    except ValueError as exc:  # of which argparse would name this program's function
        raise argparse.ArgumentTypeError(f"{text!r} is no {'whole ' * (kind is int)}number") from exc


def count(text: str, least: int = 0) -> int:
    """Parse a count of at least 0."""
    value: int = _parsed(int, text)
    if value < least:
        raise argparse.ArgumentTypeError(f"{value} is too small; expected {least} or more")
    return value


def positive(text: str) -> int:
    """Parse a count of at least 1."""
    return count(text, 1)


def positive_number(text: str) -> float:
    """Parse a finite number above 0."""
    value = _parsed(float, text)
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{value} is out of range; expected a number above 0")
    return value


def finite_number(text: str) -> float:
    """Parse a finite number."""
    value = _parsed(float, text)
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{value} is not finite; expected a number")
    return value


def share(text: str) -> float:
    """Parse a number in 0..1."""
    value = finite_number(text)
    if not 0.0 <= value <= 1.0:
        raise argparse.ArgumentTypeError(f"{value:g} is not in 0..1")
    return value


def add_figures_file(group: Options) -> None:
    """Add ``--json FILE``, for the commands that print tables."""
    group(
        "--json FILE",
        "write all figures to this JSON file, with the command line that produced them (default: tables only)",
    )
