"""Tracks from above, as an animation."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..atomic import write_whole
from ..errors import MissingExtraError
from .colors import FAINT, INK, PANEL, color_of

if TYPE_CHECKING:
    from ..tracking.tracks import Tracks

__all__ = ["draw_tracks"]


def draw_tracks(
    scans: Sequence[Tracks],
    path: str | Path | None = None,
    *,
    title: str = "",
    tail_s: float = 2.0,
    range_m: tuple[float, float] = (70.0, 30.0),
) -> bytes:
    """Draw tracks from above, scan by scan: footprints, where each goes in the next second, and where it was.

    Parameters
    ----------
    scans : sequence of Tracks
        In order; one of them a picture, shown for as long as it lasted.
    path : str or Path, optional
        Where to write the animation as well; an existing file is replaced whole.
    title : str
    tail_s : float
        How long a track's way behind it is shown [s].
    range_m : tuple of 2 float
        How far ahead, and how far to each side, is shown [m]; behind, as far as there are tracks, 10 to 40 m.

    Returns
    -------
    gif : bytes
        Empty where there is no scan.

    Raises
    ------
    MissingExtraError
        pillow is not installed.
    OSError
        The file cannot be written.
    """
    try:
        from PIL import Image, ImageDraw
    except ImportError as exc:
        raise MissingExtraError("pillow", "view", "Drawing an animation") from exc
    px_per_m = 8.0
    # A detector that looks all around has tracks behind; of others nothing is to be seen there.
    behind_m = min(max([10.0, *(5.0 - float(tracks.boxes[:, 0].min()) for tracks in scans if len(tracks))]), 40.0)
    size = round(2.0 * range_m[1] * px_per_m), round((range_m[0] + behind_m) * px_per_m)

    def pixels(places: NDArray[np.float64]) -> list[tuple[float, float]]:
        """x, y in the sensor's frame -> pixels: ahead is up, left is left."""
        return [((range_m[1] - y) * px_per_m, (range_m[0] - x) * px_per_m) for x, y in places[:, :2].tolist()]

    pictures: list[Any] = []
    ways: dict[int, list[tuple[float, float, float, float]]] = {}
    for tracks in scans:
        picture = Image.new("RGB", size, PANEL)
        pen = ImageDraw.Draw(picture)
        (middle,) = pixels(np.zeros((1, 2)))
        for ring_m in (20.0, 40.0, 60.0):
            reach = ring_m * px_per_m
            pen.ellipse([middle[0] - reach, middle[1] - reach, middle[0] + reach, middle[1] + reach], outline="#2a343f")
            pen.text((middle[0] + 3.0, middle[1] - reach), f"{ring_m:.0f} m", fill=FAINT)
        pen.polygon(pixels(np.array([[1.5, 0.0], [-1.5, 0.9], [-1.5, -0.9]])), outline=FAINT)
        R, t = tracks.T_world_sensor[:3, :3], tracks.T_world_sensor[:3, 3]
        here = {track.id for track in tracks}
        ways = {name: way for name, way in ways.items() if name in here or way[-1][3] > tracks.stamp_s - tail_s}
        for track in tracks:
            ways.setdefault(track.id, []).append((*track.world_box.center, tracks.stamp_s))
            way = ways[track.id] = [place for place in ways[track.id] if place[3] > tracks.stamp_s - tail_s]
            colour = color_of(track.label)
            if len(way) > 1:
                pen.line(pixels((np.array(way)[:, :3] - t) @ R), fill=colour)
            pen.polygon(pixels(track.box.corners()), outline=colour, width=1 if track.coasting else 2)
            ahead = np.array([track.box.center[:2], np.array(track.box.center[:2]) + track.velocity])
            pen.line(pixels(ahead), fill=INK)
        for track in tracks:  # names last, on a ground of their own, or neighbours' could not be told apart
            x, y = pixels(np.array([track.box.center]))[0]
            speed = math.hypot(*track.velocity)
            name = f"#{track.id}" + (f" {3.6 * speed:.0f} km/h" if speed > 1.0 else "")
            pen.rectangle(pen.textbbox((x + 10.0, y - 6.0), name), fill=PANEL)
            pen.text((x + 10.0, y - 6.0), name, fill=INK)
        told = f"{title}  {tracks.stamp_s:.1f} s  {len(tracks)} track{'s' * (len(tracks) != 1)}"
        pen.text((10.0, 8.0), told.strip(), fill=INK)
        for line, label in enumerate(sorted({*tracks.labels})):
            pen.text((10.0, 24.0 + 14.0 * line), label, fill=color_of(label))
        pictures.append(picture.quantize(64))
    if not pictures:
        return b""
    stamps = [tracks.stamp_s for tracks in scans]
    lasted = [round(1e3 * (b - a)) for a, b in zip(stamps, [*stamps[1:], stamps[-1] + 1.0], strict=True)]
    stream = io.BytesIO()
    pictures[0].save(
        stream, "GIF", save_all=True, append_images=pictures[1:], duration=[max(20, ms) for ms in lasted], loop=0
    )
    if path is not None:
        write_whole(path, stream.getvalue())
    return stream.getvalue()
