"""The papers' tables on labeled scans: points (PointSeg 5.1), boxes and top view (SSADNet 3.3, appendix A), road.

Scans go through `edgeperc.Perceiver`, so the figures apply to the results that users get. Each scan is reduced to a
small `Record` of counts. Figures are computed from sums of records, and intervals from the same sums
over resampled drives.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from ..errors import PointsError
from ..mounting import Mounting
from ..perceiver import BoxesFrom
from ..simulation.samples import FIRST_SEED
from ..zoo import DEFAULT
from .datasets import KittiObjects, SemanticKitti
from .judge import Judge
from .mistakes import Mistakes
from .tables import Record, figures
from .truth import Truth

__all__ = ["evaluate"]

N_WORST = 20


def evaluate(
    datasets: Sequence[str | Path],
    models: Sequence[str | Path] = DEFAULT,
    *,
    split: str | None = None,
    fold: int | None = None,
    road_by: str | Path | None = None,
    provider: str = "cpu",
    precision: str = "auto",
    boxes_from: BoxesFrom = "network",
    mounted: Mounting | None = None,
    n_resamples: int = 1000,
    on_scan: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[dict[str, Any], list[Mistakes]]:
    """Compute the figures of models on labeled scans.

    Parameters
    ----------
    datasets : sequence of str or Path
        Roots of a KITTI object set or of SemanticKITTI, or ``"simulation:N"`` for N simulated scans (default 24).
    models, road_by, provider, precision, boxes_from, mounted
        As in `Judge`.
    split : str or None
        Drives of the real scans: ``"test"``, ``"train"``, ``"validation"`` or ``"all"`` (`splits.in_split`). None: the
        validation drives if there is a ``fold``, else the test drives.
    fold : int or None
        Fold of the training drives, 0 to 2 (`splits.in_split`).
    n_resamples : int
        Number of resamples of the drives for the intervals.
    on_scan : callable
        Called after each scan with the number of scans done and the number of all scans.

    Returns
    -------
    figures : dict
        ``"models"``, ``"providers"`` (as `Perceiver` has them), ``"split"``, ``"fold"``, and the `figures` of each kind
        of scans in the datasets: ``"real"``, ``"semantickitti"``, ``"simulated"``.
    mistakes : list of Mistakes
        The twenty scans with most mistakes, worst first: real scans if there are any, else simulated ones.

    Raises
    ------
    PointsError
        A dataset is of an unknown kind, or has no scans of the split.
    SplitError
        A model was trained on a scan, and ``split`` is not ``"train"``.
    """
    split = split or ("test" if fold is None else "validation")
    judge = Judge(
        models,
        provider=provider,
        precision=precision,
        road_by=road_by,
        training_scans=split == "train",
        boxes_from=boxes_from,
        mounted=mounted,
    )
    scans = [scan for dataset in datasets for scan in _scans(judge, dataset, split, fold)]
    records: dict[str, list[Record]] = {}
    worst: dict[str, list[Mistakes]] = {}
    for done, (block, read) in enumerate(scans, start=1):
        record, mistakes = judge.record(read())
        records.setdefault(block, []).append(record)
        if mistakes is not None:
            ranked = sorted([*worst.get(block, ()), mistakes], key=lambda each: -each.n_errors)
            worst[block] = ranked[:N_WORST]
        on_scan(done, len(scans))
    result: dict[str, Any] = {"models": {card.name: card.version for card in judge.perceive.cards}}
    result |= {"providers": dict(judge.perceive.providers), "split": split, "fold": fold}
    result |= {block: figures(of_block, n_resamples) for block, of_block in records.items()}
    return result, worst.get("real") or worst.get("simulated", [])


def _scans(judge: Judge, dataset: str | Path, split: str, fold: int | None) -> list[tuple[str, Callable[[], Truth]]]:
    """For each scan of a dataset: its block of figures, and a function that reads the scan."""
    kind, _, number = str(dataset).partition(":")
    if kind == "simulation":
        if not (number or "24").isdecimal() or number == "0":
            raise PointsError(f"got {dataset!r}; expected simulation, or simulation:N with a number of scans from 1")
        return [("simulated", partial(judge.simulated, FIRST_SEED + k)) for k in range(int(number or 24))]
    root = Path(dataset)
    if (root / "training" / "label_2").is_dir():
        objects = KittiObjects(root)
        names = objects.names(split, fold=fold)
        scans = [("real", _later(judge.kitti, objects.frame, name)) for name in names]
    elif any(root.glob("sequences/*/labels")):
        sequences = SemanticKitti(root)
        names = sequences.names(split, fold=fold)
        scans = [("semantickitti", _later(judge.semantickitti, sequences.frame, name)) for name in names]
    else:
        raise PointsError(
            f"{dataset} has no labeled scans; expected the root of a KITTI object set (training/label_2 below it), "
            "of SemanticKITTI (sequences/*/labels below it), or the word simulation"
        )
    if not scans:
        raise PointsError(f"{dataset} has no scans of the {split} drives (fold: {fold}); pass another split, or 'all'")
    return scans


def _later(judge: Callable[[Any], Truth], read: Callable[[str], Any], name: str) -> Callable[[], Truth]:
    return lambda: judge(read(name))
