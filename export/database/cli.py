"""``edgeperc-export database-build``, ``database-label``, ``database-coco`` and ``database-check``."""

from __future__ import annotations

import argparse
import contextlib
import webbrowser
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

from edgeperc.cli.arguments import keywords, options
from edgeperc.cli.output import print_error, print_line

DATABASE = "folder of a database made by edgeperc-export database-build"


def add_database_commands(command: Callable[..., argparse.ArgumentParser]) -> None:
    """Add the four commands by what adds one."""
    command = partial(command, extra="database")
    does = "make a top-view database of a KITTI object set, or resume a stopped build"
    add = options(command("database-build", does, _build))
    add("kitti", "KITTI object set: a folder of training/velodyne, label_2 and calib", type=Path)
    add("out", "folder for the database; finished scenes in it are kept", type=Path)
    add("--polygons POLYGONS...", "COCO files of hand-drawn roads", type=Path, default=[])
    add(
        "--road-by NAME|PATH|train",
        "source of the roads that are not drawn by hand: a shipped model (default lodnn), an .onnx file with a "
        "card, or train, which trains a LoDNN for each fold on the drawn roads of the other folds",
        default="lodnn",
    )
    add(
        "--road-recipe",
        "network for --road-by train: LoDNN-I as published, or that of the model lodnn, which takes a thirtieth "
        "of the time (default paper)",
        choices=("paper", "small"),
        default="paper",
    )
    add("--road-steps ROAD_STEPS", "training steps of each fold for --road-by train (default: the recipe's)", type=int)
    add("--provider PROVIDER", "execution provider of the road model (default cpu)", default="cpu")
    add("--sensor SENSOR", "sensor of the scans (default hdl-64e)", default="hdl-64e")
    add("--test-drive DRIVE", "drive to keep for testing; may be repeated", action="append", default=[])
    add(
        "--variations N",
        "turned and mirrored copies of each training scene with a drawn road (default 8)",
        type=int,
        default=8,
    )
    add(
        "--engine",
        "where scenes are made: processes on this computer, or a Ray cluster (default local)",
        choices=["local", "ray"],
        default="local",
    )
    add("--workers N", "scenes made in parallel (default: one for each core)", type=int)

    add = options(command("database-label", "draw roads over a database's images, in a browser", _label))
    add("out", DATABASE, type=Path)
    add("--polygons POLYGONS", "COCO file to read and write (default OUT/road.coco.json)", type=Path)
    add("--kitti KITTI", "KITTI object set whose training/image_2 holds camera pictures to show", type=Path)
    add("--port PORT", "port of the page; 0: any free port (default 8117)", type=int, default=8117)
    add("--no-browser", "print the page's address and open no browser")

    add = options(command("database-coco", "write a database's vehicles and roads as a COCO file", _coco))
    add("out", DATABASE, type=Path)
    add("file", "COCO file to write", type=Path)

    add = options(command("database-check", "compare every file of a database with its hash", _check))
    add("out", DATABASE, type=Path)


def _build(args: argparse.Namespace) -> int:
    from .build import build
    from .scenes import Plan

    if args.variations < 0 or (args.workers is not None and args.workers < 1):
        raise ValueError(f"--variations {args.variations} --workers {args.workers}; expected 0 or more, 1 or more")
    recipe = None
    if args.road_by == "train":
        args.extra = "export"  # from here on, the package that may be missing is torch
        from ..recipe import MODELS, PAPER

        # The model lodnn also uses simulated scans, pasted objects and a teacher, which do not exist here.
        small = replace(MODELS["lodnn"].recipe, simulated_share=0.0, n_pasted=0.0, distil=0.0)
        recipe = {"paper": PAPER["lodnn"], "small": small}[args.road_recipe]
        if args.road_steps is not None:
            recipe = replace(recipe, steps=args.road_steps)
    plan = Plan(args.kitti, args.out, args.road_by, args.sensor, args.provider, args.variations)
    how = keywords(args, "polygons", "engine", "workers", test_drives="test_drive")
    report = build(plan, recipe=recipe, **how)
    for line in report.notes:
        print_error(line, "edgeperc-export")
    for name, reason in report.skipped.items():
        print_error(f"left out {name}: {reason}", "edgeperc-export")
    for split, scores in report.scores.items():
        figures = ", ".join(f"{name} {value:.2%}" for name, value in scores.items() if value is not None)
        print_line(f"{args.out}: road model against the drawn roads of {split} scenes: {figures}")
    print_line(
        f"{args.out}: {report.scenes} scenes, {report.made} made, {report.kept} kept, {len(report.skipped)} left out"
    )
    return 1 if report.skipped else 0


def _label(args: argparse.Namespace) -> None:
    from .label_page import LabelServer

    polygons = args.polygons or args.out / "road.coco.json"
    with LabelServer(args.out, polygons, kitti=args.kitti, port=args.port) as server:
        print_line(f"{server.url} writes to {polygons}; stop with Ctrl+C")
        if not args.no_browser:
            webbrowser.open(server.url)
        with contextlib.suppress(KeyboardInterrupt):
            server.serve_forever()


def _coco(args: argparse.Namespace) -> None:
    from edgeperc.system.atomic import open_atomic

    from .coco import write_database_coco
    from .files import TopViewDatabase

    with open_atomic(args.file, "w") as file:
        n = write_database_coco(TopViewDatabase(args.out), file)
    print_line(f"{args.file}: {n} annotations")


def _check(args: argparse.Namespace) -> int:
    from .files import TopViewDatabase

    database = TopViewDatabase(args.out)
    damaged = database.damaged()
    for path in damaged:
        print_error(f"{path} is missing or damaged; delete it and run database-build again", "edgeperc-export")
    print_line(f"{args.out}: {len(database)} scenes, {len(damaged)} files missing or damaged")
    return 1 if damaged else 0
