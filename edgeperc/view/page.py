"""The 3-D page of a scan or of a drive: one self-contained HTML file."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..system.atomic import open_atomic
from ..system.clock import step_between
from ..system.printable import many, printable
from ..types.frame import ModelFrame
from ..types.perception import Box, Perception, TopView, scan_of
from ..types.points import Bytes, Floats32, Points
from . import content
from .colors import HIGH, LOW, color_of

if TYPE_CHECKING:
    from ..tracking.tracks import Tracks

# Of a drive: a step of coordinates, the farthest one, the fewest points of a scan, and the steps in time.
_STEP_M, _FARTHEST_M = 0.01, 320.0
_FEWEST_POINTS, _MOST_POINTS = 3000, 64 * 3000
_SHORTEST_S, _LONGEST_S = 0.001, 1.0


def write_html(perception: Perception, points: ArrayLike, path: str | Path, *, title: str = "") -> None:
    """Write an interactive 3-D page for a browser. It needs no network.

    Parameters
    ----------
    perception : Perception
    points : (n, 4) or (n, 3) array_like, or a structured array
        The scan that was perceived: x, y, z [m] in the sensor frame, remission. Not drawn are points and boxes that are
        not finite or farther than 1 km.
    path : str or Path
        An existing file is replaced atomically.
    title : str
        The scan's name.

    Raises
    ------
    PointsError
        ``points`` is not the scan that was perceived.
    OSError
        The file cannot be written.
    """
    classes: dict[str, int] = {}
    scan, xyz, remission, label = _scan(perception, scan_of(perception, points), classes)
    scan |= {"xyz": _base64(xyz), "remission": _base64(remission), "label": _base64(label)}
    facts = f"{perception.n_points:,} points · {_escaped(content.timing_line(perception))}"
    facts += "".join(f"<br>{_escaped(line)}" for line in content.provider_lines(perception))
    text = _in_script(json.dumps(scan, allow_nan=False))
    _fill_page(path, title or "A scan", facts, perception.fitness, classes, [text], [0.0])


class DrivePage:
    """An interactive 3-D page that plays the scans of a drive: play and pause, a slider, speeds and single steps.

    A page begins with at most 192,000 points of each scan. If it grows beyond its limit, the points of every scan are
    halved, down to 3,000, at random with a preference for far points and for points on objects; then every second scan
    is left out, as often as needed. Points are rounded to 1 cm; those farther than 320 m along an axis are left out.

    Parameters
    ----------
    title : str
    max_bytes : int
        Limit of the page's size, and about that of the memory that it takes until it is written.

    Attributes
    ----------
    n_points : int
        Points that are kept of a scan, at most.
    every : int
        1 if all scans are kept, 2 for every second one, and so on.
    """

    def __init__(self, *, title: str = "", max_bytes: int = 48 * 2**20) -> None:
        self.n_points, self.every = _MOST_POINTS, 1
        self._title, self._max_bytes = title, max_bytes
        self._n = self._most = self.n_bytes = 0
        self._stamp_s, self._time_s = -math.inf, 0.0  # the latest scan's own time, and when the last one is played
        self._classes: dict[str, int] = {}
        self._scans: list[_Thin] = []
        self._fitness: dict[str, str] = {}  # one of each kind, whatever the numbers in it

    def __len__(self) -> int:
        """Number of scans that are kept."""
        return len(self._scans)

    def add(
        self, perception: Perception, points: ArrayLike, stamp_s: float, tracks: Tracks | None = None, *, name: str = ""
    ) -> None:
        """Add the next scan of the drive.

        Parameters
        ----------
        perception : Perception
        points : (n, 4) or (n, 3) array_like, or a structured array
            The scan that was perceived, as in `write_html`.
        stamp_s : float
            Its time [s]. A pause of more than a second is played as a second.
        tracks : Tracks, optional
            Those of the scan; their boxes, speeds and trails are shown.
        name : str
            The scan's name.

        Raises
        ------
        PointsError
            ``points`` is not the scan that was perceived.
        """
        given = scan_of(perception, points)
        step_s = np.clip(np.nan_to_num(np.subtract(stamp_s, self._stamp_s)), _SHORTEST_S, _LONGEST_S)
        self._time_s += float(step_s) if self._n else 0.0
        if step_between(self._stamp_s, stamp_s) != "late":
            self._stamp_s = stamp_s
        self._n += 1
        if (self._n - 1) % self.every:
            return
        for line in perception.fitness:
            self._fitness.setdefault(re.sub(r"[-+\d.]+", "", line), line)
        scan, xyz, remission, label = _scan(perception, given, self._classes, tracks)
        names = [*self._classes]
        near = (np.abs(xyz) < _FARTHEST_M).all(axis=1)
        xyz, remission, label = xyz[near], remission[near], label[near]
        self._most = max(self._most, len(xyz))
        chosen = _sample(xyz, label, names, self.n_points)
        scan |= {"name": printable(name), "scale": _STEP_M}
        text = _in_script(json.dumps(scan, allow_nan=False))
        cells = np.round(xyz[chosen] / _STEP_M).astype("<i2")
        self._scans.append(_Thin(text, self._time_s, cells, remission[chosen], label[chosen]))
        self.n_bytes += self._scans[-1].n_bytes
        while self.n_bytes > self._max_bytes and (self.n_points > _FEWEST_POINTS or len(self._scans) > 1):
            if self.n_points > _FEWEST_POINTS:
                self.n_points //= 2
                self._scans = [each.reduced(self.n_points) for each in self._scans]
            else:
                self.every *= 2
                self._scans = self._scans[::2]
            self.n_bytes = sum(each.n_bytes for each in self._scans)

    def write(self, path: str | Path) -> None:
        """Write the page.

        Parameters
        ----------
        path : str or Path
            An existing file is replaced atomically.

        Raises
        ------
        OSError
            The file cannot be written.
        """
        kept = f"every {self.every}. of {self._n:,}" if self.every > 1 else "all"
        thinned = f"thinned to {self.n_points:,} points" if self._most > self.n_points else "with all points"
        facts = f"{many(len(self._scans), 'scan')} ({kept}), {thinned}"
        texts = (scan.to_json() for scan in self._scans)
        times_s = [round(scan.time_s, 3) for scan in self._scans]
        _fill_page(path, self._title or "A drive", facts, self._fitness.values(), self._classes, texts, times_s)


@dataclass(frozen=True, eq=False)
class _Thin:
    """A scan of a drive, its points in the order in which they are kept."""

    text: str
    time_s: float
    xyz: NDArray[np.int16]
    remission: Bytes
    label: Bytes

    @property
    def n_bytes(self) -> int:
        """Size on the page."""
        return len(self.text) + 4 * (self.xyz.nbytes + 2 * len(self.xyz)) // 3 + 100

    def reduced(self, n: int) -> _Thin:
        """The first ``n`` points alone, as copies."""
        return replace(self, xyz=self.xyz[:n].copy(), remission=self.remission[:n].copy(), label=self.label[:n].copy())

    def to_json(self) -> str:
        parts: dict[str, NDArray[Any]] = {"xyz": self.xyz, "remission": self.remission, "label": self.label}
        return self.text[:-1] + "".join(f', "{key}": "{_base64(part)}"' for key, part in parts.items()) + "}"


def _sample(xyz: Points, label: Bytes, names: list[str], n: int) -> NDArray[np.intp]:
    """Indices of at most ``n`` points, drawn without replacement; the first k of them are such a sample of k points."""
    objects = np.array([name not in ("background", "drivable") for name in names])
    # A scan is denser near the sensor, by about the square of the distance.
    weights = np.clip(np.hypot(xyz[:, 0], xyz[:, 1]), 2.0, 40.0) * np.where(objects[label], 4.0, 1.0)
    # Weighted random sampling with a reservoir (Efraimidis and Spirakis 2006): the smallest exponential times.
    times = np.random.default_rng(0).exponential(size=len(xyz)) / weights
    chosen = np.argpartition(times, n)[:n] if len(times) > n else np.arange(len(times))
    return np.asarray(chosen[np.argsort(times[chosen], kind="stable")])


def _scan(
    perception: Perception, points: Points, classes: dict[str, int], tracks: Tracks | None = None
) -> tuple[dict[str, Any], Floats32, Bytes, Bytes]:
    """What the page shows of a scan, and its points: x, y, z, remission and class; new classes get the next numbers."""
    facts = content.class_facts(perception)
    boxes, texts = _boxes(perception, tracks)
    frame = ModelFrame(perception.mounting)
    perception, points = content.in_model_frame(replace(perception, boxes=tuple(boxes)), points)
    names, painted = content.paint_points(points, perception)
    seen = content.drawable_points(points)
    points, painted = points[seen], painted[seen]
    for name in (*names, *facts, *(box.label for box in perception.boxes)):
        classes.setdefault(name, len(classes))
    remission = np.where(np.isfinite(points[:, 3]), np.maximum(points[:, 3], 0.0), 0.0)
    remission /= max(1.0, float(remission.max(initial=0.0)))  # some sensors give it up to 255 or 65535
    scan: dict[str, Any] = {
        "ground": [round(value, 5) for value in content.ground_plane(perception, points)],
        "road": None if perception.top_view is None else _road(perception.top_view),
        "boxes": [
            {
                "name": printable(box.label),
                "corners": np.round(content.box_corners(box), 3).tolist(),
                "color": color_of(box.label),
                "text": text,
            }
            for box, text in zip(perception.boxes, texts, strict=True)
        ],
        "facts": {classes[name]: texts for name, texts in facts.items() if texts},
    }
    if tracks is not None:
        # A point p of the tracker's frame lies at pose @ (p, 1) in the frame of the models.
        R, t = frame.R @ tracks.T_world_sensor[:3, :3].T, tracks.T_world_sensor[:3, 3]
        scan["pose"] = np.column_stack([R, frame.t - R @ t]).round(5).tolist()
        scan["tracks"] = [[track.id, *(round(v, 2) for v in track.world_box.center)] for track in tracks]
    numbers = np.array([classes[name] for name in names], np.uint8)[painted]
    return scan, points[:, :3].astype("<f4"), (remission * 255.0).astype(np.uint8), numbers


def _boxes(perception: Perception, tracks: Tracks | None) -> tuple[list[Box], list[str]]:
    """Drawable boxes with their texts: those of tracks in place of the boxes that belong to them."""
    shown = {-1 - k: (box, content.box_text(box)) for k, box in enumerate(perception.boxes)}
    for k, track in enumerate(tracks or ()):
        assert tracks is not None
        source = int(tracks.sources[k])
        shown[-1 - source if source >= 0 else k] = track.box, content.track_text(track)
    pairs = [(box, text) for box, text in shown.values() if content.drawable_boxes([box])]
    return [box for box, _ in pairs], [text for _, text in pairs]


def _fill_page(
    path: str | Path,
    title: str,
    facts: str,
    warnings: Iterable[str],
    classes: Iterable[str],
    scans: Iterable[str],
    times_s: Sequence[float],
) -> None:
    """Write the page: ``facts`` as HTML, ``scans`` as JSON one after another, everything else as it came."""
    scene = {
        "classes": [{"name": printable(name), "color": color_of(name)} for name in classes],
        "low": LOW,
        "high": HIGH,
        "times": times_s,
    }
    template = resources.files(__package__).joinpath("page.html").read_text(encoding="utf-8")
    filled = {
        "@@POLICY@@": _policy(template),
        "@@TITLE@@": _escaped(title),
        "@@FACTS@@": facts,
        "@@FITNESS@@": "".join(f"<p class=warning>{_escaped(line)}</p>" for line in warnings),
    }
    before, _, after = template.partition("@@SCENE@@")
    # One pass, so that a title such as "@@FACTS@@" is not replaced.
    before = re.sub("|".join(filled), lambda match: filled[match.group()], before)
    with open_atomic(path) as file:
        file.write((before + _in_script(json.dumps(scene, allow_nan=False)[:-1])).encode())
        for k, scan in enumerate(scans):
            file.write(((", " if k else ', "scans": [') + scan).encode())
        file.write(f"]}}{after}".encode())


def _in_script(data: str) -> str:
    """JSON for a script element, which a class name with "</script>" or "<!--" must not end."""
    return data.replace("<", "\\u003c")


def _escaped(text: str) -> str:
    return html.escape(printable(text))


def _policy(template: str) -> str:
    """The content security policy: the page loads nothing, and runs no script but its own, named by its hash."""
    allowed = ["default-src 'none'", "base-uri 'none'", "form-action 'none'"]
    for element in ("script", "style"):
        (text,) = re.findall(f"<{element}>(.*?)</{element}>", template, flags=re.DOTALL)
        digest = hashlib.sha256(text.encode()).digest()
        allowed.append(f"{element}-src 'sha256-{base64.b64encode(digest).decode()}'")
    return "; ".join(allowed)


def _road(top_view: TopView) -> dict[str, Any]:
    return {
        "cell": top_view.cell_m,
        "x": top_view.x_range_m[1],
        "y": top_view.y_range_m[1],
        "strips": content.drivable_strips(top_view).tolist(),
    }


def _base64(array: NDArray[Any]) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode("ascii")
