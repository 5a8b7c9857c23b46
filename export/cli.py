"""``edgeperc-export``: train, export and prove new checkpoints."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path

from edgeperc import __version__
from edgeperc.errors import EdgepercError, MissingExtraError

from .database.cli import database_parser
from .recipe import MODELS

__all__ = ["main"]


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; 0 when done, 1 when a model was refused or a scene left out, 2 for wrong usage or bad files."""
    args = _parser().parse_args(argv)
    try:
        return int(args.run(args))
    except ModuleNotFoundError as exc:
        missing = MissingExtraError(exc.name or "a package", args.extra, "edgeperc-export")
        print(f"edgeperc-export: {missing}", file=sys.stderr)
        return 2
    except (EdgepercError, ValueError, OSError) as exc:
        print(f"edgeperc-export: {exc}", file=sys.stderr)
        return 1 if type(exc).__name__ in ("ParityError", "RefusedError") else 2


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="edgeperc-export", description=__doc__)
    parser.add_argument("--version", action="version", version=f"edgeperc {__version__}")
    parser.set_defaults(extra="export")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    simulate = commands.add_parser("simulate", help="make labelled scans to train on")
    simulate.add_argument("out", type=Path, help="folder for the scans")
    simulate.add_argument("-n", type=int, default=1000, help="how many (default 1000)")
    simulate.add_argument("--first", type=int, default=0, help="number, and seed, of the first")
    simulate.add_argument("--layouts", type=Path, help="folder of KITTI label_2, calib and frames.csv: real layouts")
    simulate.add_argument("--sensor", default="hdl-64e")
    simulate.set_defaults(run=_simulate)

    train = commands.add_parser("train", help="train a network, or go on where a stopped run left off")
    train.add_argument("network", choices=["kulseg", "lodnn", "pointseg", "squeezesegv2", "ssadnet"])
    train.add_argument("out", type=Path, help="folder for checkpoint.pt and log.jsonl")
    train.add_argument("--kitti", type=Path, help="root of a KITTI object set")
    train.add_argument("--simulated", type=Path, help="folder made by: edgeperc-export simulate")
    train.add_argument("--fold", type=int, help="fold of the training drives to leave out and stop by: 0, 1 or 2")
    train.add_argument("--recipe", choices=["ours", "paper"], default="ours", help="where the options below start from")
    train.add_argument("--start-from", type=Path, help="a checkpoint whose weights a new run starts from")
    train.add_argument("--teacher", type=Path, help="a checkpoint to learn from: see the recipe's distil")
    train.add_argument("--threads", type=int)
    train.add_argument("--compile", action="store_true", help="through torch.compile, which needs a C++ compiler")
    recipe = train.add_argument_group("recipe", "see edgeperc_export.recipe.Recipe")
    for option, of in _recipe_options().items():
        how = {"action": argparse.BooleanOptionalAction} if of is bool else {"type": of}
        recipe.add_argument(option, **how)
    train.set_defaults(run=_train)

    export = commands.add_parser("export", help="checkpoint -> .onnx with a card, or an error that says how far off")
    export.add_argument("checkpoint", type=Path)
    export.add_argument("out", type=Path, help="the .onnx to write")
    export.add_argument("--scans", type=Path, nargs="*", default=[], help="scans to compare torch and onnxruntime on")
    export.add_argument("--kitti", type=Path, help="also describe the training scans, for the fitness check")
    export.add_argument("--metrics", type=Path, help="JSON of edgeperc eval, to keep in the card")
    export.add_argument("--name", help="what the model is called (default: the network)")
    export.add_argument("--model-version", default="1.0.0")
    export.add_argument(
        "--licence", default="Apache-2.0", help="of the weights, where no real scan was trained on (default Apache-2.0)"
    )
    export.set_defaults(run=_export)

    verify = commands.add_parser("verify", help="hold an .onnx against its checkpoint")
    verify.add_argument("checkpoint", type=Path)
    verify.add_argument("model", type=Path)
    verify.add_argument("--scans", type=Path, nargs="*", default=[])
    verify.set_defaults(run=_verify)

    card = commands.add_parser("card", help="write a card into a network made elsewhere")
    card.add_argument("model", type=Path, help="the network")
    card.add_argument("card", type=Path, help="the card, as JSON; edgeperc info MODEL --json prints one to start from")
    card.add_argument("out", type=Path, help="the .onnx to write")
    card.set_defaults(run=_card)

    quantize = commands.add_parser("quantize", help="an eight-bit model, where it is faster here and answers as well")
    quantize.add_argument("model", type=Path, help="the .onnx, with its card")
    quantize.add_argument("out", type=Path, help="the .onnx to write")
    quantize.add_argument(
        "--scans", type=Path, nargs="*", default=[], help="scans, or folders of .bin, to calibrate on"
    )
    quantize.add_argument(
        "--kitti", type=Path, help="KITTI object root: calibrate on training drives, judge on test ones"
    )
    quantize.add_argument(
        "--simulated", type=int, default=64, metavar="N", help="scans to simulate for calibration (default 64)"
    )
    quantize.add_argument("--semantickitti", type=Path, help="root of SemanticKITTI, to judge the road by")
    quantize.add_argument(
        "--seven-bits", action="store_true", default=None, help="for any computer, x86 without VNNI among them"
    )
    quantize.add_argument(
        "--judged", type=int, default=48, help="simulated scans both models are judged by (default 48)"
    )
    quantize.add_argument("--exclude", nargs="*", default=[], metavar="NODE", help="nodes of the graph to leave alone")
    quantize.add_argument("--threads", type=int, help="to time both models with")
    quantize.set_defaults(run=_quantize)

    make = commands.add_parser("make", help="a shipped model from nothing: simulate, train, export, judge")
    shipped = sorted(name for name in MODELS if not name.endswith("-start"))
    make.add_argument("name", choices=shipped)
    make.add_argument("out", type=Path, help="folder for scans, checkpoints and the model")
    make.add_argument("--kitti", type=Path, help="root of a KITTI object set")
    make.add_argument("--layouts", type=Path, help="folder of KITTI label_2, calib and frames.csv")
    make.add_argument("--semantickitti", type=Path, help="root of SemanticKITTI, to judge the road by")
    make.add_argument("--fold", type=int, help="fold of the training drives to leave out and stop by: 0, 1 or 2")
    make.add_argument("--steps", type=int, help="another number than the shipped model's, as for folds")
    make.add_argument("--threads", type=int)
    make.add_argument("--compile", action="store_true", help="through torch.compile, which needs a C++ compiler")
    make.add_argument("--model-version", default="1.0.0")
    make.set_defaults(run=_make)

    ablate = commands.add_parser("ablate", help="what each part of the training is worth, on a fold left out")
    ablate.add_argument("network", choices=["ssadnet", "pointseg", "lodnn"])
    ablate.add_argument("out", type=Path, help="folder for the runs and ablation.json")
    ablate.add_argument("--kitti", type=Path, required=True)
    ablate.add_argument("--simulated", type=Path, required=True)
    ablate.add_argument("--start-from", type=Path, help="checkpoint of the -sim model (lodnn: none)")
    ablate.add_argument("--fold", type=int, default=0)
    ablate.add_argument("--steps", type=int, default=150)
    ablate.add_argument("--variant", action="append", default=[], help="one of them; again for more (default: all)")
    ablate.add_argument("--threads", type=int)
    ablate.add_argument("--plot", type=Path, metavar="PNG", help="draw what was found (lodnn)")
    ablate.set_defaults(run=_ablate)

    database = commands.add_parser(
        "database", help="scans as top-view images, labels and maps: make, draw roads, export"
    )
    database_parser(database)

    models = commands.add_parser("models", help="write MODELS.md from the cards of a folder's models")
    models.add_argument("folder", type=Path)
    models.set_defaults(run=_models)
    return parser


def _make(args: argparse.Namespace) -> int:
    from .make import make

    path = make(
        args.name,
        args.out,
        kitti=args.kitti,
        layouts=args.layouts,
        semantickitti=args.semantickitti,
        fold=args.fold,
        steps=args.steps,
        n_threads=args.threads,
        compiled=args.compile,
        version=args.model_version,
    )
    print(path)
    return 0


def _ablate(args: argparse.Namespace) -> int:
    from .ablation import ablate, plot

    if args.network != "lodnn" and args.start_from is None:
        raise ValueError(f"{args.network} starts from its -sim model; give --start-from")
    rows = ablate(
        args.network,
        args.out,
        kitti=args.kitti,
        simulated=args.simulated,
        start_from=args.start_from,
        fold=args.fold,
        steps=args.steps,
        variants=args.variant,
        n_threads=args.threads,
    )
    for row in rows:
        print(f"{row['network']}, fold {row['fold']}, {row['steps']} steps, {row['variant']}: {row['figures']}")
    if args.plot is not None:
        plot(rows, args.plot)
    return 0


def _models(args: argparse.Namespace) -> int:
    from .models_page import models_page

    (args.folder / "MODELS.md").write_text(models_page(args.folder))
    return 0


def _simulate(args: argparse.Namespace) -> int:
    from .simulate import simulate

    simulate(args.out, args.n, first=args.first, layouts_root=args.layouts, sensor=args.sensor)
    return 0


def _recipe_options() -> dict[str, type]:
    """Command line options of a recipe and their types, without loading torch for --help."""
    return {
        "--head": str, "--steps": int, "--batch": int, "--optimizer": str, "--learning-rate": float,
        "--weight-decay": float, "--cooldown": float, "--halve-after": int, "--simulated-share": float,
        "--augment": bool, "--n-pasted": float, "--swap": float, "--turn-to-rare": float, "--weather": float,
        "--class-weights": bool, "--focal-gamma": float, "--lovasz-weight": float, "--deep-supervision": float,
        "--ema": float, "--context-width": int, "--batch-norm": bool, "--dropout": float, "--distil": float,
        "--seen-twice": bool, "--paste-cars": float, "--turn-anywhere": float, "--head-only": bool, "--edge": bool,
        "--drawn-roads": bool,
        "--seed": int,
    }  # fmt: skip


def _train(args: argparse.Namespace) -> int:
    from .recipe import PAPER, Recipe
    from .train import train

    if args.recipe == "paper" and args.network not in PAPER:
        raise ValueError(f"no recipe of a paper's is kept for {args.network}; expected {' or '.join(PAPER)}")
    given = {f.name: getattr(args, f.name, None) for f in fields(Recipe)}
    start = PAPER[args.network] if args.recipe == "paper" else Recipe(args.network)
    checkpoint = train(
        replace(start, **{name: value for name, value in given.items() if value is not None}),
        args.out,
        kitti=args.kitti,
        simulated=args.simulated,
        fold=args.fold,
        start_from=args.start_from,
        teacher=args.teacher,
        n_threads=args.threads,
        compiled=args.compile,
    )
    print(checkpoint)
    return 0


def _export(args: argparse.Namespace) -> int:
    from .simulate import fitness_of, parity_scans
    from .to_onnx import export

    metrics = json.loads(args.metrics.read_text()) if args.metrics else None
    card = export(
        args.checkpoint,
        args.out,
        scans=parity_scans(args.scans),
        fitness=fitness_of(args.kitti),
        name=args.name,
        version=args.model_version,
        metrics=metrics,
        licence=args.licence,
    )
    print(f"{args.out}: {card.name} {card.version}, parity {json.dumps(dict(card.parity))}")
    return 0


def _verify(args: argparse.Namespace) -> int:
    from .simulate import parity_scans
    from .to_onnx import load, verify

    print(json.dumps(verify(load(args.checkpoint)[0], args.model, parity_scans(args.scans))))
    return 0


def _quantize(args: argparse.Namespace) -> int:
    from .quantize import calibration_scans, quantize

    scans, hashes = calibration_scans(args.scans, kitti=args.kitti, n_simulated=args.simulated)
    card = quantize(
        args.model,
        args.out,
        scans=scans,
        hashes=hashes,
        kitti=args.kitti,
        semantickitti=args.semantickitti,
        exclude=args.exclude,
        seven_bits=args.seven_bits,
        n_judged=args.judged,
        n_threads=args.threads,
    )
    print(f"{args.out}: {card.name} {card.version}, left alone: {', '.join(card.training['quantized']['left_alone'])}")
    print(json.dumps(dict(card.parity)))
    return 0


def _card(args: argparse.Namespace) -> int:
    import onnx

    from edgeperc.card import ModelCard

    from .to_onnx import with_golden, write_card

    model = onnx.load(args.model)
    card = with_golden(model, ModelCard.from_json(args.card.read_text()))
    write_card(model, card, args.out)
    print(f"{args.out}: {card.name} {card.version}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
