"""From boxes, scan by scan, to objects with identity and speed: IMM-UKF-JPDA (KUL-Seg, section 6).

`Tracker` joins the stages: `imm` mixes three motions, `ukf` predicts and updates each by sigma points, `jpda` says
which detection is of which track, `egomotion` finds the sensor's own motion where nobody gives it. `metrics` and
`kitti` judge what comes out.
"""

from __future__ import annotations

from .tracker import Tracker
from .tracks import ClassParameters, Track, Tracks

__all__ = ["ClassParameters", "Track", "Tracker", "Tracks"]
