"""Which drives are for what: the one list that training, ablations and figures go by.

Frames of one drive look alike, so whole drives are kept apart, never frames. Test drives are looked at for the final
figures alone: neither their scans nor their layouts (the boxes simulated scenes are built around) are trained on, and
nothing is chosen by them. Choices are made on the folds of the training drives: a model that has not seen a fold's
scans is judged on it, for every fold in turn.
"""

from __future__ import annotations

__all__ = ["FOLDS", "TEST_DRIVES", "VALIDATION_DRIVES", "fold_of", "in_split"]

# Three object drives with cars, vans, trucks, pedestrians and cyclists, and all of SemanticKITTI's sequence 00.
TEST_DRIVES = frozenset(
    {"2011_09_26_drive_0011", "2011_09_26_drive_0015", "2011_09_26_drive_0032", "2011_10_03_drive_0027"}
)

# Fold 0 is one long drive that holds most cyclists; the others mix short ones.
FOLDS = (
    frozenset({"2011_09_26_drive_0005"}),
    frozenset(
        {
            "2011_09_26_drive_0029",
            "2011_09_26_drive_0036",
            "2011_09_26_drive_0046",
            "2011_09_26_drive_0048",
            "2011_09_26_drive_0052",
            "2011_09_26_drive_0064",
            "2011_09_26_drive_0096",
            "2011_09_28_drive_0002",
        }
    ),
    frozenset(
        {
            "2011_09_26_drive_0013",
            "2011_09_26_drive_0014",
            "2011_09_26_drive_0022",
            "2011_09_26_drive_0023",
            "2011_09_26_drive_0059",
            "2011_09_26_drive_0070",
            "2011_09_29_drive_0026",
            "2011_10_03_drive_0047",
        }
    ),
)


# No shipped model was trained on their scans; only their boxes are among the layouts of simulated training scenes. They
# decide which network has a task's name, and which precision is good enough.
VALIDATION_DRIVES = frozenset(
    {
        "2011_09_26_drive_0001",
        "2011_09_26_drive_0020",
        "2011_09_26_drive_0027",
        "2011_09_26_drive_0039",
        "2011_09_26_drive_0060",
        "2011_09_26_drive_0087",
        "2011_09_26_drive_0095",
        "2011_09_28_drive_0001",
        "2011_09_28_drive_0016",
        "2011_09_28_drive_0043",
        "2011_09_28_drive_0141",
        "2011_09_28_drive_0185",
        "2011_09_29_drive_0071",
    }
)


def fold_of(drive: str) -> int | None:
    """The fold of a training drive, 0 to 2; None for any other."""
    return next((k for k, drives in enumerate(FOLDS) if drive in drives), None)


def in_split(drive: str, split: str, fold: int | None = None) -> bool:
    """Whether a drive belongs to ``"train"``, ``"validation"``, ``"test"`` or ``"all"``.

    With a ``fold``, validation is that fold and training the other two; without, all folds are trained on and
    validation is `VALIDATION_DRIVES`. A drive named nowhere, as of a user's own scans, may be trained on and may be judged: that no
    model is judged on what it was trained on is then up to the hashes in its card (`edgeperc.evaluate`).
    """
    if split not in ("train", "validation", "test", "all"):
        raise ValueError(f"split is {split!r}; expected train, validation, test or all")
    if fold is not None and fold not in range(len(FOLDS)):
        raise ValueError(f"fold is {fold}; expected 0 to {len(FOLDS) - 1}")
    own = fold_of(drive)
    if drive in VALIDATION_DRIVES:
        return split == "all" or (split == "validation" and fold is None)
    if own is None:
        return split in (("all", "test") if drive in TEST_DRIVES else ("all", "test", "train"))
    return split in ("all", "validation" if own == fold else "train")
