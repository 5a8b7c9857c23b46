"""The drives for training, validation and testing.

Frames of one drive look similar, so whole drives are assigned to a split. Test drives are only used for the final
figures. No model is trained on their scans or on their layouts (the boxes that simulated scenes are built around), and
no decision is based on them. Training recipes are compared by cross-validation on the folds of the training drives.
Shipped models are compared on the validation drives.
"""

from __future__ import annotations

from ..errors import OptionError

# Three object drives with cars, vans, trucks, pedestrians and cyclists, and all of SemanticKITTI's sequence 00.
TEST_DRIVES = frozenset(
    {"2011_09_26_drive_0011", "2011_09_26_drive_0015", "2011_09_26_drive_0032", "2011_10_03_drive_0027"}
)

# Fold 0 is one long drive with most of the cyclists; the others are many short drives.
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


# No shipped model was trained on these scans, but simulated training scenes use their layouts. These drives decide
# which network is shipped for a task, and which precisions are accurate enough.
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
    """The fold of a training drive, 0 to 2; None for any other drive."""
    return next((k for k, drives in enumerate(FOLDS) if drive in drives), None)


def in_split(drive: str, split: str, fold: int | None = None) -> bool:
    """Whether a drive is of "train", "validation", "test" or "all". With a ``fold`` that one is for validation, else
    `VALIDATION_DRIVES`. A user's own drive is for training and testing: cards hold hashes. Raises OptionError.
    """
    if split not in ("train", "validation", "test", "all"):
        raise OptionError(f"split is {split!r}; expected train, validation, test or all")
    if fold is not None and fold not in range(len(FOLDS)):
        raise OptionError(f"fold is {fold!r:.80}; expected 0 to {len(FOLDS) - 1}")
    drive_fold = fold_of(drive)
    if drive in VALIDATION_DRIVES:
        return split == "all" or (split == "validation" and fold is None)
    if drive_fold is None:
        return split in (("all", "test") if drive in TEST_DRIVES else ("all", "test", "train"))
    return split in ("all", "validation" if drive_fold == fold else "train")
