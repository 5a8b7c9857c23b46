"""Tracks from above, as an animation."""

from __future__ import annotations

import io
import math
import zlib
from collections.abc import Iterator, Sequence
from itertools import accumulate, islice, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import TrackingError
from ..ground.planes import find_ground, heights_above
from ..system.atomic import write_atomic
from ..system.clock import elapsed_s
from ..system.extras import require
from ..system.names import check_picture
from ..system.printable import many
from ..types.frame import ModelFrame
from ..types.mounting import MODEL_MOUNTING, Mounting
from ..types.perception import Box, Perception
from ..types.points import Bytes, Floats, Points
from .canvas import free_place
from .colors import CLASS_COLORS, FAINT, FRAME, GROUND, HIGH, INK, LOW, PANEL, SCENE_COLORS, color_of, rgb
from .content import drawable_boxes, drawable_points, in_model_frame, paint_points

if TYPE_CHECKING:
    from ..tracking.tracks import Track, Tracks

# Forward is to the right, left is up. Sizes in pixels, 10 per meter. Frames are drawn twice as large and reduced, which
# smooths the edges.
_PX_PER_M, _FINE = 10, 2
_BEHIND_M, _BESIDE_M = 22, 28
_WIDTH, _HEIGHT, _HEAD, _FOOT = 960, 560, 44, 38
# Values of a pixel of a flattened scan: 0 empty, 1 road, 2 to 4 a background point by height, from 5 a class.
_ROAD, _POINT, _CLASS = 1, 2, 5
_COLORED = (*SCENE_COLORS, *CLASS_COLORS)  # objects over the surroundings; others over both
_OTHER, _DRIVABLE = _CLASS + len(_COLORED), _CLASS + _COLORED.index("drivable")
_AHEAD_S = (0.0, 0.25, 0.5, 0.75, 1.0)
AT_ONCE = 50  # pictures in memory: 0.8 MB each, which are 2.3 GB of five minutes


def flatten_scan(points: Points, perception: Perception | None = None) -> bytes:
    """Reduce a scan to the image that `draw_tracks` shows under the tracks, about 20 kB.

    Parameters
    ----------
    points : (n, 4) float32
        x, y, z [m] in the sensor frame, remission.
    perception : Perception, optional
        Perception of these points, whose mounting turns them forward; without it, points have no class and no road is
        shown.

    Returns
    -------
    flat : bytes
        Compressed image, for ``under`` of `draw_tracks`.
    """
    image = np.zeros((_HEIGHT, _WIDTH), np.uint8)
    names, painted = ["background"], np.zeros(len(points), np.uint8)
    if perception is not None:
        perception, points = in_model_frame(perception, points)
        names, painted = paint_points(points, perception)
        if perception.top_view is not None:
            view = perception.top_view
            x = (np.arange(_WIDTH) + 0.5) / _PX_PER_M - _BEHIND_M
            y = _BESIDE_M - (np.arange(_HEIGHT) + 0.5) / _PX_PER_M
            row, col, inside = view.geometry.cells(*np.broadcast_arrays(x, y[:, None]))
            image[inside] = _ROAD * view.drivable[row[inside], col[inside]]
    seen = drawable_points(points)
    points, painted = points[seen], painted[seen]
    x, y = points[:, :2].astype(np.float64).T
    ground = find_ground(points) if perception is None else heights_above(perception.ground, points)
    level = np.clip(np.floor(ground.height_m / 1.2 + 0.75), 0, 2)
    of_class = {name: _CLASS + k for k, name in enumerate(_COLORED)}
    as_pixel = np.array([of_class.get(name.casefold(), _OTHER) for name in names], np.uint8)
    value = np.where(painted == 0, _POINT + level.astype(np.uint8), as_pixel[painted])
    col, row = np.floor((x + _BEHIND_M) * _PX_PER_M), np.floor((_BESIDE_M - y) * _PX_PER_M)
    # The road is shown as a surface; its points would only enlarge the file.
    inside = (col >= 0) & (col < _WIDTH) & (row >= 0) & (row < _HEIGHT) & (value != _DRIVABLE)
    shown = np.flatnonzero(inside)
    shown = shown[np.argsort(value[shown], kind="stable")]  # classes over the background
    image[row[shown].astype(np.intp), col[shown].astype(np.intp)] = value[shown]
    return zlib.compress(image.tobytes(), 1)


def draw_tracks(
    scans: Sequence[Tracks],
    path: str | Path | None = None,
    *,
    under: Sequence[bytes] = (),
    mountings: Sequence[Mounting] = (),
    title: str = "",
    tail_s: float = 2.0,
) -> bytes:
    """Draw an animation of tracks from above: boxes, ids, speeds, motion in the next second, and trails.

    Parameters
    ----------
    scans : sequence of Tracks
        In order, two or more. Each is shown until the stamp of the next, the last one for a second. A jump of
        their clock takes no time.
    path : str or Path, optional
        File to write as well; an existing file is replaced atomically.
    under : sequence of bytes
        `flatten_scan` of each scan, to show under the tracks. Empty: only the tracks.
    mountings : sequence of Mounting
        That of each scan (`Perception.mounting`), to draw the tracks as the vehicle sees them. Empty: x is forward.
    title : str
    tail_s : float
        Length of the trail behind a track [s].

    Returns
    -------
    gif : bytes
        960 by 642 pixels: 22 m behind the sensor to 74 m ahead, 28 m to each side.

    Raises
    ------
    MissingExtraError
        pillow is not installed.
    TrackingError
        There are fewer than two scans, or ``under`` or ``mountings`` are of another number of scans.
    OptionError
        ``path`` is named as a picture of another kind.
    OSError
        The file cannot be written.
    """
    require("PIL", "view", "Drawing an animation", package="pillow")
    check_picture(path, ".gif")
    if len(scans) < 2:
        raise TrackingError(
            f"got {many(len(scans), 'scan')} for an animation; expected two or more of a drive. "
            "A single scan is drawn by edgeperc.draw, or run --png"
        )
    for given, what in ((under, "flattened scans"), (mountings, "mountings")):
        if given and len(given) != len(scans):
            raise TrackingError(f"got {len(given)} {what} with tracks of {len(scans)}; expected one for each")
    times_s = [*accumulate((elapsed_s(a.stamp_s, b.stamp_s) for a, b in pairwise(scans)), initial=0.0)]
    lasted = [max(20, round(1e3 * (after - before))) for before, after in pairwise([*times_s, times_s[-1] + 1.0])]
    pictures = _pictures(scans, times_s, under, mountings, title or "Tracks", tail_s)
    stream = io.BytesIO()
    for begin in range(0, len(scans) - 1, AT_ONCE):
        end = begin + AT_ONCE if begin + AT_ONCE < len(scans) - 1 else len(scans)  # no part has a single picture
        part, first = io.BytesIO(), next(pictures)
        how: Any = {"duration": lasted[begin:end], "loop": 0, "optimize": False}
        first.save(part, "GIF", save_all=True, append_images=islice(pictures, end - begin - 1), **how)
        content = part.getvalue()[:-1]  # without the trailer
        stream.write(content[content.index(b"!\xf9\x04", 13 + 3 * 256) if begin else 0 :])
    stream.write(b";")
    if path is not None:
        write_atomic(path, stream.getvalue())
    return stream.getvalue()


def _pictures(
    scans: Sequence[Tracks],
    times_s: Sequence[float],
    under: Sequence[bytes],
    mountings: Sequence[Mounting],
    title: str,
    tail_s: float,
) -> Iterator[Any]:
    """The pictures of `draw_tracks`, all with one palette."""
    from PIL import Image, ImageDraw, ImageFont

    fonts = {size: ImageFont.load_default(_FINE * size) for size in (13, 14, 17)}
    palette, labels = _palette(Image), {label for scan in scans for label in scan.labels}
    trails: dict[int, list[tuple[float, float, float, float]]] = {}
    for k, (tracks, time_s) in enumerate(zip(scans, times_s, strict=True)):
        flat = zlib.decompress(under[k]) if under else bytes(_HEIGHT * _WIDTH)
        layer = _layer_colors()[np.frombuffer(flat, np.uint8).reshape(_HEIGHT, _WIDTH)]
        picture = Image.new("RGB", (_FINE * _WIDTH, _FINE * (_HEAD + _HEIGHT + _FOOT)), GROUND)
        fine = Image.fromarray(layer).resize((_FINE * _WIDTH, _FINE * _HEIGHT), Image.Resampling.NEAREST)
        picture.paste(fine, (0, _FINE * _HEAD))
        pen = ImageDraw.Draw(picture)
        _draw_rings(pen, fonts[13])
        here = {track.id for track in tracks}
        begin_s = time_s - tail_s
        trails = {name: trail for name, trail in trails.items() if name in here or trail[-1][3] > begin_s}
        for track in tracks:
            trail = [*trails.get(track.id, ()), (*track.world_box.center, time_s)]
            trails[track.id] = [place for place in trail if place[3] > begin_s]
        R, t = tracks.T_world_sensor[:3, :3], tracks.T_world_sensor[:3, 3]
        frame = ModelFrame(mountings[k] if mountings else MODEL_MOUNTING)
        drawn = [track for track in tracks if drawable_boxes([track.box])]
        for track in drawn:
            trail = (np.array(trails[track.id])[:, :3] - t) @ R @ frame.R.T + frame.t
            _draw_track(pen, track, trail, frame.move_boxes([track.predicted(s) for s in _AHEAD_S]))
        _write_names(pen, drawn, frame, fonts[14])
        facts = f"{time_s:.1f} s · {many(len(tracks), 'track')}"
        _write_frame(pen, title, facts, labels, fonts, tail_s)
        yield picture.reduce(_FINE).quantize(palette=palette, dither=Image.Dither.NONE)


def _layer_colors() -> Bytes:
    """Color of each value of a flattened scan, (values, 3) uint8."""
    panel, low, high, drivable = rgb([PANEL, LOW, HIGH, CLASS_COLORS["drivable"]])
    points = [panel + share * (color - panel) for color, share in ((low, 0.5), (low, 0.95), (high, 0.6))]
    classes = [panel + 0.85 * (color - panel) for color in rgb([color_of(name) for name in (*_COLORED, "")])]
    colors = [panel, panel + 0.55 * (drivable - panel), *points, *classes]
    return np.asarray((255.0 * np.array(colors)).round(), np.uint8)


def _palette(Image: Any) -> Any:
    """Make an image with the palette of all frames: all drawn colors, and their blends with the backgrounds."""
    layer, front = _layer_colors() / 255.0, rgb([INK, FAINT, *CLASS_COLORS.values(), color_of("")])
    ground = np.concatenate([rgb([PANEL, GROUND, FRAME]), layer[[_ROAD]]])
    edges = [back + share * (front - back) for back in ground for share in (0.35, 0.7)]
    colors = np.unique((255.0 * np.concatenate([ground, front, layer, *edges])).round().astype(np.uint8), axis=0)
    picture = Image.new("P", (1, 1))
    picture.putpalette(colors.tobytes() + bytes(768 - colors.size))
    return picture


def _pixels(places: Floats) -> list[tuple[float, float]]:
    """x, y [m] in the frame of the models -> pixels of the picture before it is reduced."""
    places = places[:, :2].clip(-1e3, 1e3)
    return [
        (_FINE * _PX_PER_M * (x + _BEHIND_M), _FINE * (_HEAD + _PX_PER_M * (_BESIDE_M - y))) for x, y in places.tolist()
    ]


def _draw_rings(pen: Any, font: Any) -> None:
    ((across, down),) = _pixels(np.zeros((1, 2)))
    for ring_m in (20, 40, 60):
        reach = ring_m * _PX_PER_M * _FINE
        # Header and footer are drawn over the rest of the circle.
        pen.arc([across - reach, down - reach, across + reach, down + reach], -90, 90, FRAME, width=_FINE)
        y = min(24.0, 0.8 * ring_m)  # next to the road, where there are few labels
        (place,) = _pixels(np.array([[math.sqrt(ring_m**2 - y**2), y]]))
        pen.text(place, f" {ring_m} m", fill=FAINT, font=font)
    pen.polygon(_pixels(np.array([[2.2, 0.0], [-1.4, 0.9], [-1.4, -0.9]])), fill=INK)


def _draw_track(pen: Any, track: Track, trail: Floats, ahead: Sequence[Box]) -> None:
    """Draw the box, the trail, and an arrow to where it is in a second; ``ahead`` are the boxes of `_AHEAD_S`."""
    color = color_of(track.label)
    if len(trail) > 1:
        pen.line(_pixels(trail), fill=color, width=_FINE + 1, joint="curve")
    pen.polygon(_pixels(ahead[0].corners()), outline=color, width=(1 if track.coasting else 2) * _FINE)
    speed = math.hypot(*track.velocity)
    if speed > 0.5:
        way = np.array([box.center[:2] for box in ahead])
        along = (way[-1] - way[-2]) / math.hypot(*(way[-1] - way[-2]))
        tip, neck, side = way[-1], way[-1] - along * min(1.2, speed), 0.6 * np.array([-along[1], along[0]])
        pen.line(_pixels(np.array([*way[:-1], neck])), fill=INK, width=2 * _FINE, joint="curve")
        pen.polygon(_pixels(np.array([tip, neck + side, neck - side])), fill=INK)


def _write_names(pen: Any, tracks: Sequence[Track], frame: ModelFrame, font: Any) -> None:
    """Write ids and speeds; no text covers a box or another text."""
    areas = [np.array(_pixels(box.corners())) for box in frame.move_boxes([track.box for track in tracks])]
    panel = (0.0, float(_FINE * _HEAD), float(_FINE * _WIDTH), float(_FINE * (_HEAD + _HEIGHT)))
    taken = [(*area.min(axis=0).tolist(), *area.max(axis=0).tolist()) for area in areas]
    for track, area in zip(tracks, list(taken), strict=True):
        if area[2] < panel[0] or area[0] > panel[2] or area[3] < panel[1] or area[1] > panel[3]:
            continue
        speed = math.hypot(*track.world_velocity)
        text = f"{track.id}" + (f" · {3.6 * speed:.0f} km/h" if speed > 0.5 else "")
        left, top, right, bottom = pen.textbbox((0, 0), text, font=font, anchor="mm")
        half = np.array([(right - left) / 2.0 + 6.0, (bottom - top) / 2.0 + 6.0])
        place = free_place(area, half, np.array(taken), panel)
        if place is not None:
            middle, _ = place
            taken.append((*(middle - half).tolist(), *(middle + half).tolist()))
            pen.rectangle(taken[-1], fill=PANEL)
            pen.text(tuple(middle.tolist()), text, fill=color_of(track.label), font=font, anchor="mm")


def _write_frame(pen: Any, title: str, facts: str, labels: set[str], fonts: dict[int, Any], tail_s: float) -> None:
    """Write header and footer: title, time, classes and a legend."""
    width, head, foot = _FINE * _WIDTH, _FINE * _HEAD, _FINE * (_HEAD + _HEIGHT)
    pen.rectangle([0, 0, width, head], fill=GROUND)
    pen.rectangle([0, foot, width, foot + _FINE * _FOOT], fill=GROUND)
    middle = head // 2
    # A longer text does not fit, and would take minutes to measure.
    texts = (title, *(label for label in CLASS_COLORS if label in labels), *sorted(labels - {*CLASS_COLORS}))
    title, *classes = ("".join(c if c.isprintable() and ord(c) < 256 else "?" for c in t[: width // 8]) for t in texts)
    facts_left = width - 32 - pen.textlength(facts, font=fonts[17])
    while len(title) > 1 and pen.textlength(title, font=fonts[17]) > facts_left - 64:
        title = f"{title[:-4]}..."
    pen.text((32, middle), title, fill=INK, font=fonts[17], anchor="lm")
    pen.text((width - 32, middle), facts, fill=FAINT, font=fonts[17], anchor="rm")
    x, middle = 32.0, foot + _FINE * _FOOT // 2
    for label in classes:
        pen.rectangle([x, middle - 10, x + 20, middle + 10], fill=color_of(label))
        pen.text((x + 30, middle), label, fill=INK, font=fonts[14], anchor="lm")
        x += 30 + pen.textlength(label, font=fonts[14]) + 36
    meaning = f"line: last {tail_s:g} s · arrow: next second · thin box: not detected now"
    room = width - 64 - pen.textlength(meaning, font=fonts[13])
    pen.rectangle([room, foot, width, foot + _FINE * _FOOT], fill=GROUND)  # over classes for which there is no room
    pen.text((width - 32, middle), meaning, fill=FAINT, font=fonts[13], anchor="rm")
