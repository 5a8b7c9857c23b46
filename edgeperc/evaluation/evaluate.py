"""The papers' tables on labeled scans: points (PointSeg 5.1), boxes and top view (SSADNet 3.3, appendix A), road.

Scans go through `edgeperc.Perceiver`, so the figures apply to the results that users get. Each scan is reduced to a
small `Record` of counts. Figures are computed from sums of records, and intervals from the same sums
over resampled drives.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any, Literal

from ..datasets.kitti import KittiObjects, SemanticKitti
from ..datasets.layout import known_layouts
from ..datasets.scan_folder import ScanFolder
from ..datasets.splits import names_of
from ..errors import OptionError, PointsError
from ..perceiver import Learned, Perceiver
from ..system.pool import MOST_FIRST, taken
from ..system.ray_cluster import ENGINES
from ..types.mounting import Mounting
from ..zoo import DEFAULT
from .judge import BY_DEFAULT, NETWORK_ALONE, Judge, Perceiving, check_scans
from .mistakes import Mistakes
from .tables import Record, figures
from .truth import Truth, check_different, seeds_of

__all__ = ["NETWORK_ALONE", "Perceiving", "evaluate"]

N_WORST = 20
KINDS, OF_FOLDER = ("real", "semantickitti", "simulated"), "folder "

_Figures = tuple[Record, Mistakes | None]
_Scan = tuple[str, str | None, Callable[[], _Figures]]
"""Block of figures; the drive, if the mounting is found from its scans in their order; the evaluation."""


def evaluate(
    datasets: Sequence[str | Path],
    models: Sequence[str | Path] = DEFAULT,
    perceiving: Perceiving = BY_DEFAULT,
    *,
    split: str | None = None,
    fold: int | None = None,
    road_by: str | Path | None = None,
    mounted: Mounting | None = None,
    n_resamples: int = 1000,
    engine: Literal["local", "ray"] = "local",
    workers: int | None = None,
    on_scan: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[dict[str, Any], list[Mistakes]]:
    """Compute the figures of models on labeled scans.

    Parameters
    ----------
    datasets : sequence of str or Path
        Roots of a KITTI object set or of SemanticKITTI, ``"simulation:N"`` for N simulated scans (default 24), or
        labeled scans of any sensor: a folder with ``scans.json``, or ``"FOLDER:LAYOUT"``
        (`scan_folder.ScanFolder.parse`). Those are perceived with the profile of their sensor, all round; the mounting
        is found from the scans.
    models, road_by, mounted
        As in `Judge`.
    perceiving : Perceiving
        How the scans are perceived.
    split : str or None
        Drives of the real scans: ``"test"``, ``"train"``, ``"validation"`` or ``"all"`` (`splits.in_split`), or
        ``"held-back"``: validation and test drives. None: the validation drives if there is a ``fold``, else the test
        drives.
    fold : int or None
        Fold of the training drives, 0 to 2 (`splits.in_split`).
    n_resamples : int
        Number of resamples of the drives for the intervals.
    engine : {"local", "ray"}
        This computer, or processes with one thread each on a Ray cluster (`ray_cluster.map_on_ray`); the figures are
        the same.
    workers : int or None
        Number of worker processes. None: this process alone; of ``"ray"``, one for each CPU.
    on_scan : callable
        Called after each scan with the number of scans done and the number of all scans.

    Returns
    -------
    figures : dict
        ``"models"``, ``"providers"`` (as `Perceiver` has them), ``"split"``, ``"fold"``, and the `figures` of each kind
        of scans in the datasets: ``"real"``, ``"semantickitti"``, ``"simulated"``; and in ``"folders"`` those of
        labeled scans of other sensors, by the name of the set.
    mistakes : list of Mistakes
        The twenty scans with most mistakes, worst first: real scans if there are any, else simulated ones.

    Raises
    ------
    PointsError
        A dataset is of an unknown kind, has no scans of the split, or is given twice.
    OptionError
        ``mounted`` with scans of another sensor.
    SplitError
        A model was trained on a scan, and ``split`` is not ``"train"``.
    """
    check_different(datasets)
    of_kitti = [*map(KittiObjects, filter(_is_kitti, map(Path, datasets)))]
    for objects in of_kitti:
        if not objects.has_table:
            _tell_no_drives(objects.root, "none is held back. docs/concepts/measure.md shows how to write it")
        objects.tell_left_out()
    split = split or ("test" if fold is None else "validation")
    job = _Job(tuple(datasets), tuple(models), perceiving, split, fold, road_by, mounted)
    folders = job.folders()
    for folder in folders.values():
        by_table = (folder.layout.drives, folder.layout.files) == ("table", "plain")
        if by_table and not (folder.root / "frames.csv").exists() and len(folder.drives) > 1:
            advice = "write it, or give drives in the description: one, or scan if these are no neighbors"
            _tell_no_drives(folder.root, f"scans of one drive may be in two splits; {advice}")
    perceive, scans = job.scans(folders)
    for folder in folders.values():
        check_scans(folder, folder.layout.sensor, _names(folder, split, fold))
    for objects in of_kitti:
        check_scans(objects, None, _names(objects, split, fold))
    records: dict[str, list[Record]] = {}
    worst: dict[str, list[Mistakes]] = {}
    evaluated: Iterator[_Figures] = (evaluate() for _, _, evaluate in scans)
    if engine == "ray" or (workers or 1) > 1:
        evaluated = _side_by_side(job, perceive, scans, engine, workers)
    for done, ((block, _, _), (record, mistakes)) in enumerate(zip(scans, evaluated, strict=True), start=1):
        records.setdefault(block, []).append(record)
        if mistakes is not None:
            ranked = sorted([*worst.get(block, ()), mistakes], key=lambda each: -each.n_errors)
            worst[block] = ranked[:N_WORST]
        on_scan(done, len(scans))
    result: dict[str, Any] = {"models": {card.name: card.version for card in perceive.cards}}
    result |= {"providers": dict(perceive.providers), "split": split, "fold": fold}
    blocks = {block: figures(of_block, n_resamples) for block, of_block in records.items()}
    result |= {block: blocks.pop(block) for block in KINDS if block in blocks}
    if blocks:
        result["folders"] = {block.removeprefix(OF_FOLDER): of_block for block, of_block in blocks.items()}
    in_order = ("real", *(block for block in worst if block.startswith(OF_FOLDER)), "simulated")
    return result, next((worst[block] for block in in_order if block in worst), [])


def _tell_no_drives(root: Path, more: str) -> None:
    text = f"{root} has no frames.csv, so each scan counts as a drive: intervals are too narrow, and {more}"
    warnings.warn(text, stacklevel=3)


@dataclass(frozen=True)
class _Job:
    """What is evaluated; worker processes get it and find the same scans."""

    datasets: tuple[str | Path, ...]
    models: tuple[str | Path, ...]
    perceiving: Perceiving
    split: str
    fold: int | None
    road_by: str | Path | None
    mounted: Mounting | None

    def folders(self) -> dict[str, ScanFolder]:
        """The data sets that are labeled scans of any sensor."""
        return {str(dataset): folder for dataset in self.datasets if (folder := _folder(dataset)) is not None}

    def scans(self, folders: Mapping[str, ScanFolder], n_threads: int | None = None) -> tuple[Perceiver, list[_Scan]]:
        """The perceiver of the last data set, and the scans of all."""
        split, fold = self.split, self.fold
        judge_of = partial(Judge, self.models, self.perceiving, training_scans=split == "train", n_threads=n_threads)
        if folders and (self.mounted is not None or self.road_by is not None):
            raise OptionError(f"{next(iter(folders))} is of another sensor; mounted and road_by are for KITTI's scans")
        _check_names([*folders.values()])
        judges: list[Judge] = []
        scans: list[_Scan] = []
        for folder in folders.values():
            judges.append(judge_of(sensor=folder.layout.sensor))
            scans += _scans(judges[-1], folder.root, folder, split, fold)
        if len(folders) < len(self.datasets):
            judges.append(judge_of(road_by=self.road_by, mounted=self.mounted))
            others = (dataset for dataset in self.datasets if str(dataset) not in folders)
            scans += [scan for other in others for scan in _scans(judges[-1], other, None, split, fold)]
        return judges[-1].perceive, scans


class _Evaluator:
    """Evaluates scans in a worker process; those without a drive each from the same state of the perceiver."""

    def __init__(self, job: _Job, learned: Learned) -> None:
        self._perceive, self._scans = job.scans(job.folders(), n_threads=1)
        self._learned = learned

    def __call__(self, numbers: Sequence[int]) -> list[_Figures]:
        results = []
        for _, drive, evaluate in (self._scans[number] for number in numbers):
            if drive is None:
                self._perceive.start_from(self._learned)
            results.append(evaluate())
        return results


def _side_by_side(
    job: _Job, perceive: Perceiver, scans: Sequence[_Scan], engine: str, workers: int | None
) -> Iterator[_Figures]:
    """Evaluate each scan, or each drive whose scans need their order, in a worker process."""
    # The perceiver learns from the first scans, so they are evaluated here.
    first: dict[int, _Figures] = {}
    for k in [k for k, (_, drive, _) in enumerate(scans) if drive is None][:MOST_FIRST]:
        if perceive.learned.is_settled:
            break
        first[k] = scans[k][2]()
    # Consecutive scans of one drive stay together; the others are apart.
    rest = (k for k in range(len(scans)) if k not in first)
    groups = [[*group] for _, group in groupby(rest, lambda k: (scans[k][0], scans[k][1] or k))]
    answers = ENGINES[engine](_Evaluator, (job, perceive.learned), groups, workers=workers)
    done = 0
    for numbers, answer in zip(groups, answers, strict=True):
        results = taken(answer, f"scan {numbers[0] + 1} of {len(scans)}")
        while done < numbers[0]:
            yield first[done]
            done += 1
        yield from results
        done += len(numbers)
    yield from (first[k] for k in range(done, len(scans)))


def _is_kitti(root: Path) -> bool:
    return (root / "training" / "label_2").is_dir() and not (root / "scans.json").is_file()


def _folder(dataset: str | Path) -> ScanFolder | None:
    """The labeled scans of any sensor of a dataset; None if it is of another kind."""
    root, (kind, colon, _) = Path(dataset), str(dataset).partition(":")
    is_described = (root / "scans.json").is_file()
    if kind == "simulation" or (not is_described and (_is_kitti(root) or any(root.glob("sequences/*/labels")))):
        return None
    if not colon and not is_described:
        raise PointsError(
            f"{dataset} has no labeled scans; expected the root of a KITTI object set (training/label_2 below it), of "
            "SemanticKITTI (sequences/*/labels below it), a folder with scans.json (docs/howto/train.md), "
            f"FOLDER:LAYOUT with a layout of {', '.join(known_layouts())}, or the word simulation"
        )
    return ScanFolder.parse(dataset)


def _check_names(folders: Sequence[ScanFolder]) -> None:
    """Raise `PointsError` for drives of two folders that would count as one."""
    of_drive: dict[tuple[str, str], ScanFolder] = {}
    for folder in folders:
        for drive in sorted({*folder.drives.values()}):
            other = of_drive.setdefault((folder.layout.name, drive), folder)
            if other is not folder:
                raise PointsError(
                    f"{other.root} and {folder.root} are both called {folder.layout.name!r}, and both have a drive "
                    f"{drive!r:.60}; change the name in a description, or evaluate them one by one"
                )


def _names(scans: ScanFolder | KittiObjects | SemanticKitti, split: str, fold: int | None) -> list[str]:
    names = names_of(scans, split, fold)
    files = [] if isinstance(scans, ScanFolder) else [(name, file) for name in names for file in scans.files(name)]
    if lacking := {name: file for name, file in files if not file.exists()}:  # now, not after hours
        raise PointsError(
            f"{scans.root}: of {len(names):,} labeled scans {len(lacking):,} lack a file, such as "
            f"{next(iter(lacking.values()))}; add it, or take away the labels of these scans"
        )
    return names


def _scans(judge: Judge, dataset: str | Path, folder: ScanFolder | None, split: str, fold: int | None) -> list[_Scan]:
    """The scans of a data set, which may be a ``folder``."""
    if str(dataset).partition(":")[0] == "simulation":
        seeds = seeds_of(str(dataset))
        return [("simulated", None, partial(lambda seed: judge.record(judge.simulated(seed)), seed)) for seed in seeds]
    scans: Any
    truth_of: Callable[[Any], Truth] | None = None
    if folder is not None:
        block, scans = f"{OF_FOLDER}{folder.layout.name}", folder
    elif _is_kitti(Path(dataset)):
        block, scans, truth_of = "real", KittiObjects(dataset), judge.kitti
    else:
        block, scans, truth_of = "semantickitti", SemanticKitti(dataset), judge.semantickitti

    def record(name: str) -> _Figures:
        frame = scans.frame(name)
        return judge.compare(*judge.perceive_frame(frame)) if truth_of is None else judge.record(truth_of(frame))

    drives = {} if folder is None else folder.drives
    return [(block, drives.get(name), partial(record, name)) for name in _names(scans, split, fold)]
