"""Sinks: each writes the answers of a whole run to one file or one receiver, scan after scan.

A sink imports its optional package when it is made, so that a missing extra is reported before the first scan.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from ..tracking.tracks import Tracks
    from ..types.perception import Perception
    from ..types.sensor import SensorProfile

__all__ = ["PerceivedScan", "Sink"]


@dataclass(frozen=True, eq=False)
class PerceivedScan:
    """A scan with its answer.

    Attributes
    ----------
    name : str
        The scan's file, or its capture and number.
    stamp_s : float
        Time of the scan [s]; without a time stamp, its number in the run divided by the rate.
    points : (n, 3 or more) floating
        x, y, z [m] in the sensor's frame; then remission, if the scan has it.
    perception : Perception
    tracks : Tracks or None
        None without a tracker; empty for a late or doubled scan (`Tracks.is_late`).
    sensor : SensorProfile
    health : str or None
        ``"OK"``, ``"LATE"`` or ``"STALE"`` of a live answer; None for a scan that was read from a file.
    """

    name: str
    stamp_s: float
    points: NDArray[np.floating]
    perception: Perception
    tracks: Tracks | None
    sensor: SensorProfile
    health: str | None = None

    @property
    def tracked(self) -> Tracks | None:
        """The tracks; None without a tracker, and for a late or doubled scan, of which only the boxes are known."""
        return None if self.tracks is None or self.tracks.is_late else self.tracks


class Sink(Protocol):
    """Writes perceived scans."""

    def write(self, scan: PerceivedScan) -> None:
        """Write one scan.

        Raises
        ------
        EdgepercError or OSError
            The scan could not be written; the next one may be.
        """

    def close(self) -> None:
        """Finish the file; nothing is written afterwards. Called after an error, too."""
