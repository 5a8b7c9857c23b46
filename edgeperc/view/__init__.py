"""Pictures, 3-D pages and label files of what was perceived (pictures need the extra ``view``)."""

from __future__ import annotations

from .files import write_labels, write_ply
from .mistakes import draw_mistakes
from .page import write_html
from .picture import draw
from .tracks import draw_tracks

__all__ = ["draw", "draw_mistakes", "draw_tracks", "write_html", "write_labels", "write_ply"]
