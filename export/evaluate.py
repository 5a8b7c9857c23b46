"""The papers' figures of shipped or fresh models, on real scans of drives that nothing was trained on.

Everything runs through `edgeperc.Perceiver`, as it would in a vehicle: what is judged is what a user gets.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from edgeperc import Perceiver
from edgeperc.metrics import BoxEvaluator, Confusion
from edgeperc.perception import Box

from .kitti import IGNORE, POINT_CLASSES, TOP_VIEW_CLASSES, Frame, KittiObjects, inside, road_frames
from .train import FEWEST, TOP_VIEW

__all__ = ["evaluate"]
