"""The sources of the object network's training samples: KITTI by folds, simulated scans, and sets of other sensors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path

import numpy as np

from edgeperc.datasets.kitti import KittiObjects, scan_hash
from edgeperc.datasets.scan_folder import ScanFolder
from edgeperc.datasets.splits import FOLDS, fold_of

from ..data.augment import Augmentation, ObjectBank, augmented
from ..data.beams import drawn_sensor
from ..data.scan_sets import check_trains, read_scan_set
from ..data.scans import LabeledScan
from ..data.simulate import simulated_files
from .object_samples import DriveScan, build_samples, digest_of_files

VALIDATION = "validation"
SIMULATED = "simulated"
PASTED, SPARSE = "pasted", "sparse"
"""Suffixes of a source: the scans of another one with objects of its scans pasted in; such as sparse sensors take."""
BEAMS = 0.1  # share of the variants that another sensor takes
N_VARIANTS = 4  # of each scan
ODDS = {"car": 0.35, "van": 0.15, "truck": 0.05, "pedestrian": 0.25, "cyclist": 0.2}
PASTING = Augmentation(n_pasted=6.0, odds=ODDS, n_negatives=2.0, weather=0.05, tilt_deg=0.25)


def write_samples(
    out: Path,
    kitti: Path | None = None,
    simulated: Path | None = None,
    scan_sets: Sequence[ScanFolder] = (),
    n_workers: int = 0,
    *,
    detector: bool = True,
    thinned: bool = False,
) -> dict[str, dict[str, str]]:
    """Write the samples of all scans, each fold of KITTI's training drives and its validation drives a source of its
    own; those in ``out`` of the same scans are kept. Returns the sources, with the hashes of the real scans of each.
    Test drives are not read. ``thinned``: also of scans as sparse sensors take them. Raises ValueError for sets that
    cannot be told apart by their names.
    """
    _check_names(scan_sets)
    hashes: dict[str, dict[str, str]] = {}
    build = partial(build_samples, out, detector=detector, n_workers=n_workers)

    def write(name: str, labeled: Sequence[DriveScan], own: dict[str, str]) -> None:
        made_of, hashes[name] = build(name, labeled, real=True), own
        for kind in (PASTED, SPARSE)[: 1 + thinned] if name != VALIDATION else ():
            build(f"{name}-{kind}", variants(labeled, sparse=kind == SPARSE), real=True, made_of=made_of)
            hashes[f"{name}-{kind}"] = {}

    if kitti is not None:
        objects = KittiObjects(kitti)
        objects.tell_left_out()
        train = objects.names("train")
        groups = {f"kitti-{k}": [n for n in train if fold_of(objects.drives[n]) == k] for k in range(len(FOLDS))}
        groups |= {"kitti-other": [n for n in train if fold_of(objects.drives[n]) is None]}
        groups |= {VALIDATION: objects.names("validation")}
        for name, scans in groups.items():
            if frames := [objects.frame(scan) for scan in scans]:
                labeled = [(frame.drive, partial(LabeledScan.from_frame, frame)) for frame in frames]
                write(name, labeled, {frame.name: scan_hash(frame.points) for frame in frames})
    for folder in scan_sets:
        check_trains(folder, "train")
        of_set, _, own = read_scan_set(folder, "train")
        drives = [folder.drives[name.partition("/")[2]] for name in own]
        write(
            folder.layout.name,
            [(drive, partial(replace, scan)) for drive, scan in zip(drives, of_set, strict=True)],
            own,
        )
    if simulated is not None:
        files = simulated_files(simulated)
        drawn = [(file.stem, partial(LabeledScan.load, file)) for file in files]
        build(SIMULATED, drawn, real=False, made_of=digest_of_files(files))
        hashes[SIMULATED] = {}
    return hashes


def _check_names(scan_sets: Sequence[ScanFolder]) -> None:
    """Raise ValueError if a set has the name of another source, whose samples would be taken for its own."""
    of_sets = [folder.layout.name for folder in scan_sets]
    names = [VALIDATION, SIMULATED, *(f"kitti-{k}" for k in (*range(len(FOLDS)), "other")), *of_sets]
    names += [f"{name}-{kind}" for name in names for kind in (PASTED, SPARSE)]
    if twice := next((folder for folder in scan_sets if names.count(folder.layout.name) > 1), None):
        raise ValueError(
            f"{twice.root}: another source of samples is called {twice.layout.name!r}, too; change the name in its "
            "description"
        )


def varied(source: str) -> str:
    """The source whose scans another one varies, or itself."""
    name, _, kind = source.rpartition("-")
    return name if kind in (PASTED, SPARSE) else source


def variants(scans: Sequence[DriveScan], *, sparse: bool = False) -> list[DriveScan]:
    """The scans of drives, with objects of these scans alone pasted in: leaving them out leaves those out."""
    bank = _Bank([scan for _, scan in scans])
    return [(drive, partial(_pasted, scan, bank, sparse, k)) for drive, scan in scans for k in range(N_VARIANTS)]


class _Bank:
    """The objects of scans, cut out when they are needed; another process gets these alone."""

    def __init__(self, scans: Sequence[Callable[[], LabeledScan]]) -> None:
        self._scans = scans

    @cached_property
    def objects(self) -> ObjectBank:
        return ObjectBank.of(scan() for scan in self._scans)

    def __getstate__(self) -> dict[str, object]:
        return {"objects": self.objects}


def _pasted(make: Callable[[], LabeledScan], bank: _Bank, sparse: bool, seed: int) -> LabeledScan:
    """A scan with objects of a bank among its own, or that as a sparse sensor takes it."""
    scan = make()
    rng = np.random.default_rng((seed, len(scan.points)))
    sensor = drawn_sensor(rng, sparse=sparse) if sparse or rng.random() < BEAMS else None
    return augmented(scan, rng, replace(PASTING, sparse=sparse), bank.objects, sensor)
