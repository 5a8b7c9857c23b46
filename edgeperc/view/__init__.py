"""Pictures, 3-D pages and label files of what was perceived.

`draw`, `draw_mistakes` and `draw_tracks` need the extra ``view``; the others need numpy alone. Each takes ``path`` and
replaces an existing file whole; the pictures are returned as bytes too, and ``path`` may be left out.
"""

from __future__ import annotations

from .files import write_labels, write_ply
from .mistakes import draw_mistakes
from .page import write_html
from .picture import draw
from .tracks import draw_tracks, flatten_scan

__all__ = ["draw", "draw_mistakes", "draw_tracks", "flatten_scan", "write_html", "write_labels", "write_ply"]
