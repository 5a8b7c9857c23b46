"""Multi-object tracking: boxes of successive scans -> tracks with identity and velocity (IMM-UKF-JPDA, KUL-Seg 6).

`tracker` runs the steps of the method. `imm` mixes three motion models, `ukf` predicts and updates each of them with
sigma points, `jpda` associates detections with tracks, `lives` begins and ends tracks, and `egomotion` estimates the
sensor's motion if no poses are passed. `tracks` holds the results and the parameters of each class; `smoothing`
improves the results of a whole recording. `edgeperc.evaluation.tracking` evaluates the tracks.
"""

from .smoothing import smooth_tracks
from .tracker import Tracker
from .tracks import ClassParameters, Track, Tracks

__all__ = ["ClassParameters", "Track", "Tracker", "Tracks", "smooth_tracks"]
