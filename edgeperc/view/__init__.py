"""Pictures, 3-D pages and label files of a perception.

The functions that draw need the extra ``view``; the others need numpy alone. All write to ``path`` and replace an
existing file atomically. Pictures are also returned as bytes; their ``path`` is optional.
"""

from .files import write_labels, write_ply
from .page import DrivePage, write_html
from .painted import draw_painted
from .picture import draw, draw_image
from .tracks import draw_tracks, flatten_scan

__all__ = [
    "DrivePage",
    "draw",
    "draw_image",
    "draw_painted",
    "draw_tracks",
    "flatten_scan",
    "write_html",
    "write_labels",
    "write_ply",
]
