"""``edgeperc-export``: train networks, export them as verified models, and build top-view databases."""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import Field, fields, replace
from pathlib import Path
from typing import Any, TypeAlias

from edgeperc import __version__
from edgeperc.cli.arguments import Options, count, keywords, options, positive, positive_number
from edgeperc.cli.output import make_places, print_error, print_line
from edgeperc.cli.program import Parser, run_program
from edgeperc.errors import CardError, CardMismatchError, EdgepercError, MissingExtraError, ModelError, OptionError
from edgeperc.system.atomic import write_atomic
from edgeperc.types.choices import PLACES

from .database.cli import add_database_commands
from .recipe import MODELS, NETWORKS, PAPER, TASKS, Recipe

Command: TypeAlias = "Callable[..., argparse.ArgumentParser]"
KITTI = "KITTI object set: a folder of training/velodyne, label_2, calib and of frames.csv"
CAMVID = "folder of CamVid: train, trainannot, val, valannot and classes.json"
PROOF = "scan (or image) files on which torch and onnxruntime must agree, in addition to four simulated ones"

# Options that several commands have.
SHARED: Mapping[str, Mapping[str, Any]] = {
    "--kitti KITTI": {"type": Path, "help": KITTI},
    "--layouts LAYOUTS": {
        "type": Path,
        "help": "folder of KITTI's label_2, calib and frames.csv: half of the simulated scenes get their boxes",
    },
    "--semantickitti SEMANTICKITTI": {"type": Path, "help": "root of SemanticKITTI, to evaluate the drivable area"},
    "--simulated SIMULATED": {"type": Path, "help": "folder of scans written by edgeperc-export simulate"},
    "--camvid CAMVID": {"type": Path, "help": f"{CAMVID}; for networks of a camera"},
    "--fold FOLD": {
        "type": int,
        "help": "fold of the training drives (0, 1 or 2) to validate on instead of training on it",
    },
    "--scans FOLDER[:LAYOUT]": {
        "action": "append",
        "default": [],
        "help": "more real scans: FOLDER with a scans.json, or FOLDER:LAYOUT; may be repeated",
    },
    "--threads THREADS": {"type": positive, "help": "number of CPU threads (default: one for each core)"},
    "--workers WORKERS": {"type": count, "default": 1, "help": "processes that make training samples (default 1)"},
    "--compile": {"help": "run the network through torch.compile, which needs a C++ compiler and a minute to start"},
    "--model-version MODEL_VERSION": {"default": "1.0.0", "help": "version to write into the card (default 1.0.0)"},
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command: 0 success, 1 a model was refused or a scene left out, 2 wrong usage or unusable files, 130
    interrupted, 141 the program that reads the output closed it, 143 terminated.
    """
    given = list(sys.argv[1:] if argv is None else argv)
    return run_program("edgeperc-export", lambda: _run(given))


def _run(given: list[str]) -> int:
    args = build_parser().parse_args(given)
    try:
        return int(args.run(args) or 0)
    except ModuleNotFoundError as exc:
        raise MissingExtraError(exc.name or "a package", args.extra, "edgeperc-export") from exc
    except (EdgepercError, FloatingPointError, ValueError) as exc:
        print_error(exc, "edgeperc-export")
        return 1 if type(exc).__name__ in ("ParityError", "RefusedError") else 2


def build_parser() -> argparse.ArgumentParser:
    """The parser of all commands; ``run`` of the parsed arguments is the command's function."""
    parser = Parser(prog="edgeperc-export", description=__doc__)
    parser.add_argument("--version", action="version", version=f"edgeperc {__version__}")
    parser.set_defaults(extra="export")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def command(
        name: str, help: str, run: Callable[[argparse.Namespace], int | None], **defaults: Any
    ) -> argparse.ArgumentParser:
        made: argparse.ArgumentParser = commands.add_parser(name, help=help, description=f"{help}.")
        made.set_defaults(run=run, **defaults)
        return made

    before = _add_simulate, _add_train, _add_curve, _add_export, _add_verify, _add_card, _add_quantize, _add_agree
    for add in (*before, _add_make, _add_ablate, add_database_commands, _add_triton, _add_models):
        add(command)
    return parser


def _add_shared(add: Options, *shown: str) -> None:
    for option in shown:
        add(option, **SHARED[option])


def _model_file(text: str) -> Path:
    """The file of a model, by its path or by a name from 'edgeperc models', whose fp32 file is taken."""
    path = Path(text)
    if path.suffix or len(path.parts) > 1 or path.exists():
        return path
    from edgeperc.zoo import model_path

    try:
        return model_path(text)
    except EdgepercError as exc:
        raise argparse.ArgumentTypeError(str(exc)) from exc


# --- recipes ----------------------------------------------------------------------------------------------------------


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())


TYPES = {"bool": bool, "float": float, "int": int, "str": str, "tuple[str, ...]": _names}


def _recipe_fields() -> dict[str, Field[Any]]:
    """Option -> field, for every field of a recipe except the network."""
    return {f"--{field.name.replace('_', '-')}": field for field in fields(Recipe) if field.metadata}


def _add_recipe_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of a recipe. Options that have an effect on the same networks are in one group."""
    groups: dict[tuple[str, ...], argparse._ArgumentGroup] = {}
    for option, field in _recipe_fields().items():
        networks = field.metadata["networks"]
        if networks not in groups:
            groups[networks] = parser.add_argument_group(f"recipe: {_title(networks)}")
        settings: dict[str, Any] = {"type": TYPES[str(field.type)], "choices": field.metadata["choices"] or None}
        if field.type == "bool":
            settings = {"action": argparse.BooleanOptionalAction}
        default = field.default if field.default != () else "empty"
        groups[networks].add_argument(option, help=f"{field.metadata['help']} (default: {default})", **settings)


def _title(networks: tuple[str, ...]) -> str:
    if networks == NETWORKS:
        return "all networks"
    tasks = [task for task, of in TASKS.items() if set(of) & set(networks)]
    return f"{' and '.join(tasks)} ({', '.join(networks)})"


def recipe_of(args: argparse.Namespace) -> Recipe:
    """The recipe of a ``train`` command; ValueError for options without effect."""
    if args.recipe == "paper" and args.network not in PAPER:
        raise ValueError(f"--recipe paper is for {', '.join(PAPER)}; got {args.network}")
    given = {}
    for option, field in _recipe_fields().items():
        value, networks = getattr(args, field.name), field.metadata["networks"]
        if value is None:
            continue
        if args.network not in networks:
            raise ValueError(f"{option} has no effect on {args.network}, only on {', '.join(networks)}; leave it out")
        if args.edge and not field.metadata["edge"]:
            raise ValueError(
                f"{option} has no effect on a network for small computers; leave out the option, or --edge"
            )
        given[field.name] = value
    return replace(PAPER[args.network] if args.recipe == "paper" else Recipe(args.network), **given)


# --- commands ---------------------------------------------------------------------------------------------------------


def _add_simulate(command: Command) -> None:
    add = options(command("simulate", "write simulated, labeled scans to train on", _simulate))
    add("out", "folder for the scans; existing scans in it are kept", type=Path)
    add("-n N", "number of scans (default 1000)", type=positive, default=1000)
    add("--first FIRST", "number of the first scan, and its seed (default 0)", type=count, default=0)
    _add_shared(add, "--layouts LAYOUTS")
    add("--sensor SENSOR", "sensor to simulate (default hdl-64e)", default="hdl-64e")
    add("--where WHERE", "kind of place (default street); only streets have layouts", choices=PLACES, default="street")
    add("--workers WORKERS", "number of processes that simulate (default: this one)", type=count, default=0)


def _simulate(args: argparse.Namespace) -> None:
    from .data.simulate import simulate

    how = keywords(args, "first", "sensor", "where", layouts_root="layouts", n_workers="workers")
    simulate(args.out, args.n, **how)


def _add_train(command: Command) -> None:
    train = command("train", "train a network, or resume a stopped training run", _train)
    add = options(train)
    add("network", "network to train", choices=NETWORKS)
    add("out", "folder for checkpoint.pt, log.jsonl and log.csv; a checkpoint in it is resumed", type=Path)
    _add_shared(add, "--kitti KITTI", "--scans FOLDER[:LAYOUT]")
    _add_shared(add, "--simulated SIMULATED", "--camvid CAMVID", "--fold FOLD")
    add(
        "--recipe",
        f"source of the options not given below: the defaults shown, or the network's paper ({', '.join(PAPER)})",
        choices=("ours", "paper"),
        default="ours",
    )
    add(
        "--start-from START_FROM",
        "checkpoint.pt, fp32 model.onnx, or name of a model such as pointseg, whose weights the run starts from",
        type=_model_file,
    )
    add(
        "--teacher TEACHER",
        "checkpoint.pt, model.onnx or name of the network to distil from; with --distil 0, checkpoint.pt of one "
        "that labels the unlabeled points",
        type=_model_file,
    )
    _add_shared(add, "--threads THREADS", "--workers WORKERS")
    add(
        "--checkpoint-every STEPS",
        "steps between checkpoints, and between lines of log.jsonl (default 100)",
        type=positive,
        default=100,
    )
    add("--tensorboard", "also write the log for TensorBoard; see it with: tensorboard --logdir OUT")
    _add_shared(add, "--compile")
    _add_recipe_options(train)


def _train(args: argparse.Namespace) -> None:
    recipe = recipe_of(args)
    from edgeperc.datasets.scan_folder import ScanFolder

    from .training.train import Data, Run, train

    scan_sets = [ScanFolder.parse(text) for text in args.scans]
    data = Data(args.kitti, args.simulated, args.camvid, scan_sets, fold=args.fold)
    run = Run(
        args.start_from, args.teacher, args.threads, args.workers, args.compile, args.checkpoint_every, args.tensorboard
    )
    print_line(str(train(recipe, args.out, data, run)))


def _add_curve(command: Command) -> None:
    add = options(command("curve", "show the validation figures of training runs over the samples seen", _curve))
    add("runs OUT...", "folder of a training run, with its log.jsonl", type=Path)
    add("--lines LINES", "at most this many lines for each run (default 12)", type=positive, default=12)


def _curve(args: argparse.Namespace) -> None:
    from .training.log import curve_table

    for run in args.runs:
        for line in curve_table(run, args.lines):
            print_line(line)


def _add_export(command: Command) -> None:
    add = options(command("export", "write a checkpoint as an .onnx model with a card", _export))
    add("checkpoint", "checkpoint.pt of a training run", type=Path)
    add("out", ".onnx file to write; not written if torch and onnxruntime disagree", type=Path)
    add("--scans SCANS", PROOF, type=Path, nargs="*", default=[])
    add(
        "--kitti KITTI",
        f"{KITTI}; of a checkpoint that does not describe its real scans, the card describes these, for the check "
        "of inputs",
        type=Path,
    )
    add("--metrics METRICS", "JSON file of edgeperc eval --json, to write into the card", type=Path)
    add("--name NAME", "name of the model (default: the network's)")
    _add_shared(add, "--model-version MODEL_VERSION")
    add(
        "--licence LICENCE",
        "license of weights trained on simulation alone (default Apache-2.0); others have the terms of their sets",
        default="Apache-2.0",
    )


def _export(args: argparse.Namespace) -> None:
    from .data.simulate import parity_samples
    from .release.to_onnx import export
    from .training.checkpoint import read_checkpoint

    try:
        metrics = dict(json.loads(_json_text(args.metrics))) if args.metrics else None
    except (TypeError, ValueError) as exc:
        raise OptionError(f"{args.metrics} has no figures, as edgeperc eval --json writes them: {exc}") from exc
    make_places(args.out)
    card = export(
        args.checkpoint,
        args.out,
        scans=parity_samples(read_checkpoint(args.checkpoint)["recipe"].task, args.scans),
        metrics=metrics,
        **keywords(args, "kitti", "name", "licence", version="model_version"),
    )
    print_line(f"{args.out}: {card.name} {card.version}, parity {json.dumps(dict(card.parity))}")


def _add_verify(command: Command) -> None:
    add = options(command("verify", "compare an .onnx model with its checkpoint", _verify))
    add("checkpoint", "checkpoint.pt that the model was exported from", type=Path)
    add("model", ".onnx file, or name of a model", type=_model_file)
    add("--scans SCANS", PROOF, type=Path, nargs="*", default=[])


def _verify(args: argparse.Namespace) -> None:
    from edgeperc.types.card import ModelCard

    from .cards import card_of
    from .data.simulate import parity_samples
    from .release.to_onnx import load, verify

    network, recipe, _ = load(args.checkpoint)
    own, given = card_of(recipe, version="0"), ModelCard.read(args.model)
    if (own.view, own.input, own.outputs, own.classes) != (given.view, given.input, given.outputs, given.classes):
        raise CardMismatchError(
            f"{args.model} is of another network or other options than {args.checkpoint}, {recipe.network}; expected "
            "the model that was exported from it"
        )
    print_line(json.dumps(verify(network, args.model, parity_samples(recipe.task, args.scans))))


def _add_card(command: Command) -> None:
    does = "add a card to an .onnx network made elsewhere, so that edgeperc can run it"
    add = options(command("card", does, _card))
    add("model", ".onnx file of the network", type=Path)
    add("card", "JSON file of the card; edgeperc info MODEL --json prints one to edit", type=Path)
    add("out", ".onnx file to write", type=Path)


def _json_text(path: Path) -> str:
    """A file's text in the encoding that JSON was written in: that of a redirection on Windows is UTF-16."""
    content = path.read_bytes()
    return content.decode(json.detect_encoding(content))


def _card(args: argparse.Namespace) -> None:
    import onnx
    from google.protobuf.message import DecodeError  # type: ignore[import-untyped]

    from edgeperc.types.card import ModelCard

    from .release.to_onnx import with_golden, write_card

    try:
        model = onnx.load(args.model, "protobuf")  # whatever its suffix
    except DecodeError as exc:
        raise ModelError(f"{args.model} is not an ONNX model: {exc}") from exc
    except onnx.checker.ValidationError as exc:  # of weights outside, which PyTorch writes beside a graph
        raise ModelError(
            f"{args.model} keeps weights in another file, which cannot be read: {exc}. Keep both files in one folder, "
            "or export the network with external_data=False"
        ) from exc
    try:
        card = ModelCard.from_json(_json_text(args.card), exact=True)
    except (CardError, UnicodeDecodeError) as exc:
        raise CardError(f"{args.card}: {exc}") from exc
    known = with_golden(model, card)
    try:
        write_card(model, known if card.golden is None else card, args.out, trusted=True)  # it ran for its record
    except CardMismatchError as exc:
        if card.golden is None:
            raise
        raise CardMismatchError(
            f"{args.card}: the golden record is of another network ({exc}). Set golden and fitness to null, and empty "
            "training, metrics, parity and precisions, or what was measured of that network would be said of this one"
        ) from exc
    print_line(f"{args.out}: {card.name} {card.version}")


def _add_quantize(command: Command) -> None:
    does = "make an int8 model, if it is faster on this computer and as accurate"
    add = options(command("quantize", does, _quantize))
    add("model", ".onnx file, or name, of the fp32 model", type=_model_file)
    add("out", ".onnx file to write", type=Path)
    add(
        "--scans SCANS",
        "scans to calibrate on: labeled sets of any sensor, FOLDER[:LAYOUT], of which those for training are taken as "
        "train sees them; or files, or folders of files, with points in the frame of the models and remission in 0..1",
        nargs="*",
        default=[],
    )
    add(
        "--kitti KITTI",
        f"{KITTI}; calibrates on training drives, unless the terms of the weights are not KITTI's; compares on "
        "validation drives",
        type=Path,
    )
    add("--simulated N", "simulated scans to calibrate on (default 64)", type=count, default=64)
    _add_shared(add, "--semantickitti SEMANTICKITTI")
    add("--camvid CAMVID", f"{CAMVID}; for a camera's model: calibrates on training images, not on scans", type=Path)
    add(
        "--eight-bits",
        "use 8-bit weights, which x86 without VNNI saturates, so precision auto takes fp32 there (default: 7 bits)",
    )
    add("--evaluate-on N", "simulated scans to evaluate both models on (default 48)", type=positive, default=48)
    add("--exclude NODE", "graph nodes to keep in fp32", nargs="*", default=[])
    add("--threads THREADS", "number of CPU threads for timing (default: onnxruntime's choice)", type=positive)


def _quantize(args: argparse.Namespace) -> None:
    from edgeperc.datasets.scan_folder import ScanFolder
    from edgeperc.preprocess.fitness import FitnessProfile
    from edgeperc.types.card import ModelCard

    from .release.quantize import LabeledSets, calibration_images, calibration_scans, quantize

    card = ModelCard.read(args.model)
    make_places(args.out)  # before minutes of work
    of_objects = card.view.kind == "objects"
    how = {"seven_bits": not args.eight_bits, "n_threads": args.threads}
    if card.view.kind == "camera":
        if args.camvid is None:
            raise OptionError(f"{args.model} is of a camera; give --camvid to calibrate and evaluate it on")
        calibration = calibration_images(args.camvid)
    else:
        sets = [t for t in args.scans if (Path(t) / "scans.json").is_file() or (":" in t and not Path(t).exists())]
        calibration = calibration_scans(
            [Path(text) for text in args.scans if text not in sets],
            [ScanFolder.parse(text) for text in sets],
            kitti=args.kitti if "KITTI" in card.training.get("licence", "KITTI") else None,
            n_simulated=args.simulated,
            fitness=None if card.fitness is None else FitnessProfile.from_dict(card.fitness),
            sparse=card.training.get("recipe", {}).get("sparse", False),
        )
    if of_objects:
        from .release.object_int8 import quantize_objects

        card = quantize_objects(args.model, args.out, calibration, kitti=args.kitti, **how)
        print_line(f"{args.out}: {card.name} {card.version}: {card.parity['speed']}")
        return
    labeled = LabeledSets(args.kitti, args.semantickitti, args.camvid, args.evaluate_on)
    card = quantize(args.model, args.out, calibration, labeled, exclude=args.exclude, **how)
    print_line(
        f"{args.out}: {card.name} {card.version}, kept in fp32: {', '.join(card.training['quantized']['left_alone'])}"
    )
    print_line(json.dumps(dict(card.parity)))
    print_line(
        "a file runs as it is, by its path; what it loses on your scans is said, and written into its card, by: "
        f"edgeperc-export agree {shlex.join([str(args.model), str(args.out)])} --labeled FOLDER"
    )


def _add_agree(command: Command) -> None:
    does = "compare bf16 and int8 with fp32, and write the agreement into the cards of these files, which auto reads"
    add = options(command("agree", does, _agree))
    add("models MODEL...", "a network's name, or its files, one of them in fp32")
    _add_shared(add, "--kitti KITTI", "--semantickitti SEMANTICKITTI", "--camvid CAMVID")
    labeled = "labeled scans of any sensor: FOLDER with a scans.json, or FOLDER:LAYOUT; may be repeated"
    add("--labeled FOLDER[:LAYOUT]", labeled, action="append", default=[])
    add("--split SPLIT", "drives of the scans, or images (default: validation)", default="validation")
    add("--scans N", "at most N scans of each set (default: all)", type=positive)


def _agree(args: argparse.Namespace) -> None:
    from edgeperc.datasets.scan_folder import ScanFolder

    from .release.agree import agree, summary

    how = keywords(args, "kitti", "semantickitti", "camvid", "split", n_scans="scans")
    measured = agree(args.models, labeled=[ScanFolder.parse(text) for text in args.labeled], **how)
    for line in (*summary(measured), "written into the cards of these files, which precision auto reads"):
        print_line(line)
    if "bf16" not in measured:
        print_line("bf16 was not measured; it needs a processor with bf16 and openvino: pip install 'edgeperc[peers]'")


def _add_make(command: Command) -> None:
    add = options(command("make", "make a shipped model from scratch: simulate, train, export, evaluate", _make))
    shipped = sorted(name for name in MODELS if not name.endswith("-start"))
    add("name", "model to make; the models that it starts from or is distilled from are made first", choices=shipped)
    add("out", "folder for scans, checkpoints and models; finished ones in it are kept", type=Path)
    _add_shared(add, "--kitti KITTI", "--layouts LAYOUTS", "--semantickitti SEMANTICKITTI")
    _add_shared(add, "--camvid CAMVID", "--fold FOLD", "--scans FOLDER[:LAYOUT]")
    steps = "training steps of this model alone (default: as many as for the shipped one, as those made first have)"
    add("--steps STEPS", steps, type=positive)
    _add_shared(add, "--threads THREADS", "--workers WORKERS", "--compile", "--model-version MODEL_VERSION")


def _make(args: argparse.Namespace) -> None:
    from edgeperc.datasets.scan_folder import ScanFolder

    from .make import make
    from .training.train import Data, Run

    scan_sets = [ScanFolder.parse(text) for text in args.scans]
    path = make(
        args.name,
        args.out,
        Data(args.kitti, camvid=args.camvid, scan_sets=scan_sets, fold=args.fold),
        Run(n_threads=args.threads, n_workers=args.workers, compiled=args.compile),
        **keywords(args, "layouts", "semantickitti", "steps", version="model_version"),
    )
    print_line(str(path))


def _add_ablate(command: Command) -> None:
    does = "measure the effect of each part of the training on a fold, or compare networks on CamVid"
    ablate = command("ablate", does, _ablate)
    add = options(ablate)
    add(
        "network",
        "network whose variants are trained, or camvid: eleven networks under one budget",
        choices=["ssadnet", "pointseg", "lodnn", "camvid"],
    )
    add("out", "folder for the runs and their figures; finished runs in it are kept", type=Path)
    scans = options(ablate, "variants of a network")
    _add_shared(scans, "--kitti KITTI", "--simulated SIMULATED")
    scans(
        "--start-from START_FROM",
        "checkpoint.pt, .onnx file or name of NETWORK-sim; lodnn starts from random weights",
        type=_model_file,
    )
    scans("--fold FOLD", "fold of the training drives to evaluate on (default 0)", type=int, default=0)
    scans("--steps STEPS", "training steps of each run (default 150)", type=positive, default=150)
    scans("--plot PNG", "also draw the results (lodnn only)", type=Path)
    images = options(ablate, "networks on CamVid")
    _add_shared(images, "--camvid CAMVID")
    images("--size WxH", "size of the images (default 120x90)", type=_size, default=(120, 90))
    images("--epochs EPOCHS", "how often each image is trained on (default 10)", type=positive, default=10)
    images("--batch BATCH", "images in each step (default 8)", type=positive, default=8)
    images("--learning-rate LEARNING_RATE", "learning rate (default 3e-4)", type=positive_number)
    images("--no-plots", "write the table alone, without matplotlib")
    _add_shared(images, "--compile")
    add("--variant VARIANT", "run this variant, or network, only; may be repeated", action="append", default=[])
    _add_shared(add, "--threads THREADS")


def _ablate(args: argparse.Namespace) -> None:
    if args.network == "camvid":
        _ablate_camvid(args)
        return
    from .training.ablation import ablate, plot
    from .training.train import Data, Run

    if args.kitti is None or args.simulated is None:
        raise ValueError(f"{args.network} is trained on real and simulated scans; give --kitti and --simulated")
    if args.plot is not None and args.network != "lodnn":
        raise ValueError(f"--plot draws variants of lodnn, not of {args.network}; leave it out")
    if args.network != "lodnn" and args.start_from is None:
        raise ValueError(f"{args.network} starts from its -sim model; give --start-from")
    rows = ablate(
        args.network,
        args.out,
        Data(args.kitti, args.simulated, fold=args.fold),
        Run(args.start_from, n_threads=args.threads),
        steps=args.steps,
        variants=args.variant,
    )
    for row in rows:
        print_line(f"{row['network']}, fold {row['fold']}, {row['steps']} steps, {row['variant']}: {row['figures']}")
    if args.plot is not None:
        plot(rows, args.plot)


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise argparse.ArgumentTypeError(f"{text!r}; expected WIDTHxHEIGHT, for instance 240x180")
    return positive(width), positive(height)


def _ablate_camvid(args: argparse.Namespace) -> None:
    from .training.camvid import ablate_camvid, plot_camvid, show_camvid, table

    if args.camvid is None:
        raise ValueError("no images to train on; give --camvid")
    width, height = args.size
    how = keywords(args, "epochs", "batch", "learning_rate", networks="variant", compiled="compile")
    rows = ablate_camvid(args.camvid, args.out, width=width, height=height, n_threads=args.threads, **how)
    write_atomic(args.out / "camvid.md", table(rows).encode())
    for line in table(rows).splitlines():
        print_line(line)
    if not args.no_plots:
        plot_camvid(rows, args.out)
        show_camvid(args.out / "camvid.npz", args.out / "predictions.png")
        show_camvid(args.out / "camvid.npz", args.out / "segmentations.png", args.camvid)


def _add_triton(command: Command) -> None:
    add = options(command("triton", "write a model repository for NVIDIA's Triton Inference Server", _triton))
    add("out", "folder of the repository; models of the same names are replaced", type=Path)
    add(
        "--model MODEL",
        "name or file of a network of scans; may be repeated (default: ssadnet, pointseg and objects)",
        action="append",
    )
    add("--sensor SENSOR", "sensor of the scans (default hdl-64e)", default="hdl-64e")


def _triton(args: argparse.Namespace) -> None:
    from edgeperc.zoo import DEFAULT

    from .release.triton import write_repository

    for folder in write_repository(args.out, args.model or DEFAULT, sensor=args.sensor):
        print_line(str(folder))


def _add_models(command: Command) -> None:
    add = options(command("models", "write MODELS.md from the cards of a folder's models, and SHA256SUMS", _models))
    add("folder", "folder of .onnx models", type=Path)


def _models(args: argparse.Namespace) -> None:
    from .release.models_page import models_page, sums_of

    write_atomic(args.folder / "MODELS.md", models_page(args.folder).encode())
    write_atomic(args.folder / "SHA256SUMS", sums_of(args.folder).encode())


if __name__ == "__main__":
    sys.exit(main())
