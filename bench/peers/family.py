"""Compare networks of several sizes: accuracy on the validation drives, and time of the network alone in two engines.

This module is a command of its own: ``python -m edgeperc_bench.peers.family KITTI MODEL [MODEL ...]``. Each round runs
every model once in onnxruntime's CPU provider and in OpenVINO's API, in a new random order, on the input of a simulated
scan. The accuracy is that of the network without the rules of agreement: the mean IoU of cars, pedestrians and
cyclists, or the AP50 of vehicle boxes. ``--plot`` draws it over the time; stars are the shipped models.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from edgeperc.evaluation.evaluate import NETWORK_ALONE, evaluate
from edgeperc.inference.projection import make_projector, project
from edgeperc.simulation.samples import simulated_scan
from edgeperc.types.card import ModelCard
from edgeperc.types.views import RangeImageGeometry, TopViewGeometry
from edgeperc.zoo import listed

from ..plots import as_svg
from ..render import Section, text
from .engines import open_engine
from .rounds import measure, versions

ENGINES = {"onnxruntime": "fp32", "openvino": "bf16"}
"""Engine -> precision of what is not in int8."""


def accuracy(kitti: Path, path: Path) -> float:
    """Mean IoU of the points' classes without background, or AP50 of oriented vehicle boxes."""
    figures = evaluate([kitti], [path], NETWORK_ALONE, split="validation", n_resamples=1)[0]["real"]
    if ModelCard.read(path).view.kind == "range_image":
        return float(np.mean([row["iou"] for name, row in figures["points"]["all"].items() if name != "background"]))
    return float(figures["boxes"]["oriented"]["all"]["vehicle"]["ap"])


def times(paths: Sequence[Path], n_rounds: int, n_threads: int) -> dict[str, float]:
    """Median milliseconds by ``"ENGINE NUMBER"``."""
    calls = {}
    points = simulated_scan(0).points
    for k, path in enumerate(paths):
        card = ModelCard.read(path)
        assert isinstance(card.view, RangeImageGeometry | TopViewGeometry)
        image = project(make_projector(card.view, card.input), points).image
        for library, precision in ENGINES.items():
            engine = open_engine(library, precision, path, n_threads)
            engine.input[:] = image
            calls[f"{library} {k}"] = engine.run
    return {name: float(np.median(ms)) for name, ms in measure(calls, n_rounds).items()}


def draw(paths: Sequence[Path], figures: Sequence[float], ms: dict[str, float]) -> str:
    """Accuracy over time, as ``<svg>``: a panel for each task."""
    from matplotlib.figure import Figure

    shipped = {variant.path.read_bytes() for variant in listed()}
    kinds = sorted({ModelCard.read(path).view.kind for path in paths})
    figure = Figure(figsize=(5.2 * len(kinds), 4.0), layout="constrained")
    for axes, kind in zip(figure.subplots(1, len(kinds), squeeze=False)[0], kinds, strict=True):
        for library, color in zip(ENGINES, ("#0072b2", "#d55e00"), strict=True):
            for k, path in enumerate(paths):
                card = ModelCard.read(path)
                if card.view.kind != kind:
                    continue
                x, y = ms[f"{library} {k}"], 100.0 * figures[k]
                star = path.read_bytes() in shipped
                hollow = card.precision != "int8"
                face = "none" if hollow else color
                axes.plot(x, y, "*" if star else "o", color=color, markerfacecolor=face, markersize=12 if star else 6)
                if hollow and library == "onnxruntime":  # the slowest of a network's points
                    axes.annotate(path.stem, (x, y), xytext=(7, -3), textcoords="offset points", fontsize=8)
            axes.plot([], [], "o", color=color, label=library)
        axes.margins(x=0.25, y=0.1)
        axes.set(xlabel="ms, network alone; filled: int8", xlim=(0.0, None))
        axes.set_ylabel("mean IoU of points [%]" if kind == "range_image" else "AP50 of vehicle boxes [%]")
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    return as_svg(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kitti", type=Path, help="root of a KITTI object set")
    parser.add_argument("models", type=Path, nargs="+", help=".onnx files")
    parser.add_argument("--rounds", type=int, default=100, help="rounds (default: %(default)s)")
    parser.add_argument("--threads", type=int, default=2, help="threads of each engine (default: %(default)s)")
    parser.add_argument("--plot", type=Path, metavar="SVG", help="also draw accuracy over time")
    args = parser.parse_args()
    figures = [accuracy(args.kitti, path) for path in args.models]
    ms = times(args.models, args.rounds, args.threads)
    rows = [["model", "precision", "%", *(f"{library} ms" for library in ENGINES)]]
    for k, (path, figure) in enumerate(zip(args.models, figures, strict=True)):
        cells = [f"{100.0 * figure:.1f}", *(f"{ms[f'{library} {k}']:.2f}" for library in ENGINES)]
        rows.append([path.stem, ModelCard.read(path).precision, *cells])
    sentence = f"medians of {args.rounds} rounds; {args.threads} threads; {versions()}"
    print(text([Section("networks of several sizes", [sentence], rows)]))
    if args.plot:
        args.plot.write_text(draw(args.models, figures, ms), encoding="utf-8")


if __name__ == "__main__":
    main()
