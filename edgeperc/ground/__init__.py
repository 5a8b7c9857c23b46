"""What a scan shows of the ground: its planes, heights above it, observed cells, the mounting of the sensor."""

from .planes import Ground, find_ground

__all__ = ["Ground", "find_ground"]
