"""``edgeperc-export database``: build, label, check."""

from __future__ import annotations

import argparse
import contextlib
import sys
import webbrowser
from dataclasses import replace
from pathlib import Path

__all__ = ["database_parser"]


def database_parser(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(extra="database")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    build = commands.add_parser("build", help="make a database of a KITTI object set, or go on where a build stopped")
    build.add_argument("kitti", type=Path, help="root of a KITTI object set")
    build.add_argument("out", type=Path, help="folder for the database")
    build.add_argument("--polygons", type=Path, nargs="+", default=[], help="COCO files of roads drawn by hand")
    build.add_argument(
        "--road-by",
        default="lodnn",
        metavar="NAME|PATH|train",
        help="what finds the other roads: a shipped model (default lodnn), an .onnx with a card, or train: a "
        "LoDNN for every fold, taught by the roads drawn in the other folds",
    )
    build.add_argument(
        "--road-recipe",
        choices=("paper", "small"),
        default="paper",
        help="of --road-by train: LoDNN-I as published, or the network of the model lodnn, in a thirtieth of the time",
    )
    build.add_argument("--road-steps", type=int, help="steps a fold of --road-by train (default: the recipe's)")
    build.add_argument("--provider", default="cpu", help="what runs it, as in edgeperc run (default cpu)")
    build.add_argument("--sensor", default="hdl-64e")
    build.add_argument("--test-drive", action="append", default=[], help="a drive to set apart; again for more")
    build.add_argument("--variations", type=int, default=8, help="of each drawn training scene (default 8)")
    build.add_argument("--engine", choices=["local", "ray"], default="local")
    build.add_argument("--workers", type=int, help="scenes made side by side (default: one a core)")
    build.set_defaults(run=_database_build)

    label = commands.add_parser("label", help="draw roads in a browser, over the images of a database")
    label.add_argument("out", type=Path, help="the database")
    label.add_argument("--polygons", type=Path, help="COCO file to go on with and write (default OUT/road.coco.json)")
    label.add_argument("--kitti", type=Path, help="root of the KITTI object set, for training/image_2's pictures")
    label.add_argument("--port", type=int, default=8117, help="0 takes any free one (default 8117)")
    label.add_argument("--no-browser", action="store_true", help="say the address and open nothing")
    label.set_defaults(run=_database_label)

    coco = commands.add_parser("coco", help="write a database's vehicles and roads as a COCO file")
    coco.add_argument("out", type=Path, help="the database")
    coco.add_argument("file", type=Path, help="the COCO file to write")
    coco.set_defaults(run=_database_coco)

    check = commands.add_parser("check", help="hold every file of a database against its hash")
    check.add_argument("out", type=Path, help="the database")
    check.set_defaults(run=_database_check)


def _database_build(args: argparse.Namespace) -> int:
    from .build import build
    from .scenes import Plan

    if args.variations < 0 or (args.workers is not None and args.workers < 1):
        raise ValueError(f"--variations {args.variations} --workers {args.workers}; expected 0 or more, 1 or more")
    recipe = None
    if args.road_by == "train":
        args.extra = "export"  # what is missing now is torch
        from ..recipe import MODELS, PAPER

        # What lodnn also learnt from, other scans, their objects and a teacher, is not there.
        small = replace(MODELS["lodnn"].recipe, simulated_share=0.0, n_pasted=0.0, distil=0.0)
        recipe = {"paper": PAPER["lodnn"], "small": small}[args.road_recipe]
        if args.road_steps is not None:
            recipe = replace(recipe, steps=args.road_steps)
    plan = Plan(args.kitti, args.out, args.road_by, args.sensor, args.provider, args.variations)
    report = build(
        plan,
        polygons=args.polygons,
        test_drives=args.test_drive,
        recipe=recipe,
        engine=args.engine,
        workers=args.workers,
    )
    for line in report.notes:
        print(f"edgeperc-export: {line}", file=sys.stderr)
    for name, reason in report.skipped.items():
        print(f"edgeperc-export: left out {name}: {reason}", file=sys.stderr)
    for split, scores in report.scores.items():
        figures = ", ".join(f"{name} {value:.2%}" for name, value in scores.items() if value is not None)
        print(f"{args.out}: the road model against the roads drawn in {split} scenes: {figures}")
    print(f"{args.out}: {report.scenes} scenes, {report.made} made, {report.kept} kept, {len(report.skipped)} left out")
    return 1 if report.skipped else 0


def _database_label(args: argparse.Namespace) -> int:
    from .label_page import LabelServer

    polygons = args.polygons or args.out / "road.coco.json"
    with LabelServer(args.out, polygons, kitti=args.kitti, port=args.port) as server:
        print(f"{server.url} draws into {polygons}; stop with Ctrl+C", flush=True)
        if not args.no_browser:
            webbrowser.open(server.url)
        with contextlib.suppress(KeyboardInterrupt):
            server.serve_forever()
    return 0


def _database_coco(args: argparse.Namespace) -> int:
    from .coco import write_database_coco
    from .files import TopViewDatabase

    aside = args.file.with_name(f".{args.file.name}.part")
    with aside.open("w") as file:
        n = write_database_coco(TopViewDatabase(args.out), file)
    aside.replace(args.file)
    print(f"{args.file}: {n} annotations")
    return 0


def _database_check(args: argparse.Namespace) -> int:
    from .files import TopViewDatabase

    database = TopViewDatabase(args.out)
    damaged = database.damaged()
    for path in damaged:
        print(f"edgeperc-export: {path} is missing or damaged; delete it and build again", file=sys.stderr)
    print(f"{args.out}: {len(database)} scenes, {len(damaged)} files missing or damaged")
    return 1 if damaged else 0
