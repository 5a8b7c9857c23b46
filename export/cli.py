"""``edgeperc-export``: train, export and prove new checkpoints."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

from edgeperc import __version__
from edgeperc.errors import EdgepercError, MissingExtraError


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; 0 when done, 1 when a model was refused, 2 for wrong usage or unusable files."""
    args = _parser().parse_args(argv)
    try:
        return int(args.run(args))
    except ModuleNotFoundError as exc:
        missing = MissingExtraError(exc.name or "a package", "export", "edgeperc-export")
        print(f"edgeperc-export: {missing}", file=sys.stderr)
        return 2
    except (EdgepercError, ValueError, OSError) as exc:
        print(f"edgeperc-export: {exc}", file=sys.stderr)
        return 1 if type(exc).__name__ == "ParityError" else 2


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="edgeperc-export", description=__doc__)
    parser.add_argument("--version", action="version", version=f"edgeperc {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    simulate = commands.add_parser("simulate", help="make labelled scans to train on")
    simulate.add_argument("out", type=Path, help="folder for the scans")
    simulate.add_argument("-n", type=int, default=1000, help="how many (default 1000)")
    simulate.add_argument("--first", type=int, default=0, help="number, and seed, of the first")
    simulate.add_argument("--layouts", type=Path, help="folder of KITTI label_2, calib and frames.csv: real layouts")
    simulate.add_argument("--sensor", default="hdl-64e")
    simulate.set_defaults(run=_simulate)

    train = commands.add_parser("train", help="train a network, or go on where a stopped run left off")
    train.add_argument("network", choices=["ssadnet", "pointseg"])
    train.add_argument("out", type=Path, help="folder for checkpoint.pt and log.jsonl")
    train.add_argument("--kitti", type=Path, help="root of a KITTI object set")
    train.add_argument("--simulated", type=Path, help="folder made by: edgeperc-export simulate")
    train.add_argument("--head", choices=["dense", "slots"], help="SSADNet's boxes (default dense)")
    train.add_argument("--steps", type=int)
    train.add_argument("--batch", type=int)
    train.add_argument("--learning-rate", type=float)
    train.add_argument("--simulated-share", type=float)
    train.add_argument("--context-width", type=int)
    train.add_argument("--seed", type=int)
    train.add_argument("--start-from", type=Path, help="a checkpoint whose weights a new run starts from")
    train.add_argument("--threads", type=int)
    train.set_defaults(run=_train)

    export = commands.add_parser("export", help="checkpoint -> .onnx with a card, or an error that says how far off")
    export.add_argument("checkpoint", type=Path)
    export.add_argument("out", type=Path, help="the .onnx to write")
    export.add_argument("--scans", type=Path, nargs="*", default=[], help="scans to compare torch and onnxruntime on")
    export.add_argument("--kitti", type=Path, help="also describe the training scans, for the fitness check")
    export.add_argument("--metrics", type=Path, help="JSON of edgeperc-export evaluate, to keep in the card")
    export.add_argument("--model-version", default="1.0.0")
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

    evaluate = commands.add_parser("evaluate", help="the papers' figures on drives nobody trained on")
    evaluate.add_argument("models", nargs="+", help="shipped names or .onnx files")
    evaluate.add_argument("--kitti", type=Path, help="root of a KITTI object set: points and boxes")
    evaluate.add_argument("--semantickitti", type=Path, help="root of SemanticKITTI: road")
    evaluate.add_argument("--split", choices=["validation", "train"], default="validation")
    evaluate.add_argument("--provider", default="cpu")
    evaluate.add_argument("--json", type=Path, help="also write the figures here")
    evaluate.set_defaults(run=_evaluate)

    models = commands.add_parser("models", help="write MODELS.md from the cards of a folder's models")
    models.add_argument("folder", type=Path)
    models.set_defaults(run=_models)
    return parser


def _models(args: argparse.Namespace) -> int:
    from .models_page import models_page

    (args.folder / "MODELS.md").write_text(models_page(args.folder))
    return 0


def _simulate(args: argparse.Namespace) -> int:
    from .dataset import simulate

    simulate(args.out, args.n, first=args.first, layouts_root=args.layouts, sensor=args.sensor)
    return 0


def _train(args: argparse.Namespace) -> int:
    from .train import Recipe, train

    given = {f.name: getattr(args, f.name, None) for f in fields(Recipe)}
    recipe = Recipe(**{name: value for name, value in given.items() if value is not None})
    checkpoint = train(
        recipe,
        args.out,
        kitti=args.kitti,
        simulated=args.simulated,
        start_from=args.start_from,
        n_threads=args.threads,
    )
    print(checkpoint)
    return 0


def _export(args: argparse.Namespace) -> int:
    from .dataset import fitness_of, parity_scans
    from .to_onnx import export

    metrics = json.loads(args.metrics.read_text()) if args.metrics else None
    card = export(
        args.checkpoint,
        args.out,
        scans=parity_scans(args.scans),
        fitness=fitness_of(args.kitti),
        version=args.model_version,
        metrics=metrics,
    )
    print(f"{args.out}: {card.name} {card.version}, parity {json.dumps(dict(card.parity))}")
    return 0


def _verify(args: argparse.Namespace) -> int:
    from .dataset import parity_scans
    from .to_onnx import load, verify

    print(json.dumps(verify(load(args.checkpoint)[0], args.model, parity_scans(args.scans))))
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


def _evaluate(args: argparse.Namespace) -> int:
    from .evaluate import evaluate, table

    figures = evaluate(
        args.models,
        kitti=args.kitti,
        semantickitti=args.semantickitti,
        split=args.split,
        provider=args.provider,
    )
    print(table(figures))
    if args.json:
        args.json.write_text(json.dumps(figures, indent=1, sort_keys=True) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
