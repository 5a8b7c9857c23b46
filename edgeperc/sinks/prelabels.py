"""Boxes of a run as pre-labels for annotation tools: labelCloud, CVAT, KITTI's format, SUSTechPOINTS."""

from __future__ import annotations

import json
import math
import warnings
import zipfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..camera.calibration import level_heading, read_kitti_calibration, warn_off_center
from ..errors import CalibrationError, EdgepercError, OptionError
from ..records import PerceivedScan
from ..system.atomic import part_of, write_atomic
from ..system.fields import OPTIONS
from ..system.names import stem_of
from ..system.printable import many
from ..types.choices import VEHICLES
from ..types.geometry import wrapped
from ..types.perception import Box, Perception
from ..types.points import Floats
from ..view.content import edges_ahead
from .run_file import RunFile, ScanFiles, warn_of

if TYPE_CHECKING:
    from ..tracking.tracks import Track, Tracks

__all__ = ["KINDS", "PrelabelSink", "cvat_cuboid"]

KINDS = ("labelcloud", "cvat", "kitti", "sustechpoints")
"""The tools and formats."""

_CLASSES = (*VEHICLES, "pedestrian", "cyclist")
_COLORS = ("#4363d8", "#42d4f4", "#f58231", "#e6194b", "#3cb44b", "#911eb4", "#f032e6", "#bfef45", "#9a6324", "#808000")
_FORM = "centroid_rel"  # of labelCloud: angles in radians
_SUSTECH_CLASSES = {"cyclist": "BicycleRider"}  # the others have their own names, with a capital

# The camera that KITTI's format needs, where no calibration is given: at the sensor, looking ahead, with the lens of
# KITTI's left color camera.
_NOMINAL_P2 = np.array([[721.5377, 0.0, 609.5593, 0.0], [0.0, 721.5377, 172.854, 0.0], [0.0, 0.0, 1.0, 0.0]])
_NOMINAL_TR = np.array([[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
_IMAGE_SIZE = (1242, 375)
_NEAREST_M = 0.1  # what is nearer to the camera plane has no place in the image

Named = tuple[Box, "int | None"]
"""A box and the id of its track."""


class _Item(NamedTuple):
    """What labels need of a scan."""

    name: str
    perception: Perception  # without what holds points, cells or pixels
    image_size: tuple[int, int] | None  # width and height [px] of an image that was perceived with it


class PrelabelSink:
    """Writes the boxes of each scan as a tool's own labels.

    With tracks, these are the tracks with their ids, smoothed when the drive is over (`edgeperc.smooth_tracks`), from
    the first to the last scan that an object was detected in; nothing is written of a drive that does not end. Those of
    a live source are written at once, where they were detected. Without tracks, and of late scans, these are the boxes
    of the perception. Boxes are where ``scan.points`` are, of a straightened scan not where its file has them: in the
    frame of the scan, or in its map, if its place there is known (``origin_m``); KITTI's are in the frame of the
    camera, where ``calib/NAME.txt`` puts these points. A scan without boxes gets an empty file. Labels that are there
    and differ stay: perhaps the truth.

    - ``"labelcloud"``: ``labels/NAME.json`` (labelCloud's ``centroid_rel``) and ``labels/_classes.json``
    - ``"cvat"``: ``annotations.zip`` for a 3-D task of CVAT, format "Datumaro 3D 1.0". With tracks, each object is one
      track; it ends where it is not detected
    - ``"kitti"``: ``label_2/NAME.txt``, KITTI's object labels in the rectified camera frame, and ``calib/NAME.txt``.
      The image is the perceived one, else of KITTI's 1242 x 375 pixels; the 2-D box of an object outside it is
      0 0 0 0. Occlusion is 3: unknown
    - ``"sustechpoints"``: ``label/NAME.json``

    Parameters
    ----------
    folder : str or Path
        Made if needed.
    kind : str
        One of `KINDS`.
    calib : str or Path, optional
        Calibration of ``"kitti"``: a file of `read_kitti_calibration` or the folder of a raw drive's day for all scans,
        or a folder with ``NAME.txt`` for each. Default: a nominal camera in the place of the sensor that looks ahead,
        so that the boxes come back exactly, but fit no image.

    Raises
    ------
    OptionError
        ``kind`` is unknown, ``calib`` is given for another format than KITTI's, or ``labels/_classes.json`` is
        there with another format.
    OSError
        The folder cannot be made.
    """

    def __init__(self, folder: str | Path, kind: str, *, calib: str | Path | None = None) -> None:
        if kind not in KINDS:
            raise OptionError(f"no labels are known for {kind!r}; expected one of {', '.join(KINDS)}")
        if calib is not None and kind != "kitti":
            raise OptionError(f"labels for {kind} need no calibration; leave it out, or choose kitti")
        self._folder, self._kind = OPTIONS.path("folder", folder), kind
        self._writer: Callable[[str, _Item, Sequence[Named]], None] = getattr(self, f"_{kind}")
        self._calib = None if calib is None else Path(calib)
        self._files = ScanFiles()
        self._drive: list[tuple[_Item, Tracks]] = []  # of the scans whose tracks go on
        self._errors: list[EdgepercError | OSError] = []
        self._stack = ExitStack()
        self._folder.mkdir(parents=True, exist_ok=True)
        settings = self._folder / "labels/_classes.json"
        self._classes = _known_classes(settings) if kind == "labelcloud" and settings.exists() else {}
        for name in _CLASSES:
            self._number(name)
        if kind == "cvat":
            self._before: Mapping[int, Box] = {}
            self._n_items = 0
            self._file = RunFile(self._folder / "annotations.zip")
            archive = self._stack.enter_context(zipfile.ZipFile(self._file, "w", zipfile.ZIP_DEFLATED))
            self._document = self._stack.enter_context(archive.open("annotations/default.json", "w", force_zip64=True))
            self._document.write(b'{"info": {}, "items": [')

    def write(self, scan: PerceivedScan) -> None:
        """Write the labels of one scan, or of the drive that ended before it. Raises OptionError if another scan has
        its name, CalibrationError, OSError; `close`, those of a drive.
        """
        image = scan.perception.image
        size = None if image is None else (image.labels.shape[1], image.labels.shape[0])
        light = replace(scan.perception, points=None, top_view=None, image=None, ground=None)
        item = _Item(scan.name, light, size)
        if scan.tracks is None or scan.health is not None:
            tracked = None if scan.tracked is None else [track for track in scan.tracked if not track.coasting]
            self._write_boxes(item, tracked)
            return
        self._drive.append((item, scan.tracks))
        # Of one session alone, the last scan may have a wrong stamp: the next one then goes on with the session before.
        if self._drive[0][1].session not in [tracks.session for _, tracks in self._drive[-2:]]:
            former, self._drive = self._drive[:-2], self._drive[-2:]
            self._write_drive(former)

    def _write_drive(self, drive: Sequence[tuple[_Item, Tracks]]) -> None:
        """Write the labels of a drive that is over. `close` raises its errors, which are not of the scan that comes."""
        from ..tracking.smoothing import smooth_tracks  # it loads numba

        for (item, _), tracks in zip(drive, smooth_tracks(tracks for _, tracks in drive), strict=True):
            try:
                self._write_boxes(item, None if tracks.is_late else tracks)
            except (EdgepercError, OSError) as exc:
                self._errors.append(exc)

    def _write_boxes(self, item: _Item, tracks: Sequence[Track] | None) -> None:
        boxes: list[Named] = [(box, None) for box in item.perception.boxes]
        if tracks is not None:
            boxes = [(track.box, track.id) for track in tracks]
        if item.perception.origin_m is not None and self._kind != "kitti":
            placed = item.perception.in_map(box for box, _ in boxes)
            boxes = [(box, number) for box, (_, number) in zip(placed, boxes, strict=True)]
        for box, _ in boxes:
            self._number(box.label)
        self._writer(stem_of(item.name)[0], item, boxes)

    def close(self, whole: bool = True) -> None:
        """Finish the labels of the last drive, and the files that are of all scans; see `Sink.close`."""
        drive, self._drive = self._drive, []
        try:
            if drive and whole:
                self._write_drive(drive)
            elif drive:
                text = f"a drive stopped after {many(len(drive), 'scan')}: labels come when it is over"
                warnings.warn(f"{self._folder}: {text}", RuntimeWarning, stacklevel=2)
            if self._errors:
                first, n_more = self._errors[0], len(self._errors) - 1
                raise type(first)(f"{first}; and {n_more} more" if n_more else str(first)) from first
        finally:
            self._finish(whole)

    def _finish(self, whole: bool) -> None:
        if self._kind == "labelcloud":
            classes = [*self._classes.values()]
            document = {"classes": classes, "default": classes[0]["id"], "type": "object_detection", "format": _FORM}
            name = Path("labels/_classes.json")
            (self._folder / "labels").mkdir(exist_ok=True)
            write_atomic(self._folder / (name if whole else part_of(name)), _json(document))
            if not whole:
                warn_of(self._folder / part_of(name), self._folder / name)
        elif self._kind == "cvat" and not self._document.closed:
            labels = [{"name": name, "parent": "", "attributes": []} for name in self._classes]
            categories = {"label": {"labels": labels, "attributes": ["occluded"]}}
            self._document.write(f'], "categories": {json.dumps(categories)}}}'.encode())
            self._stack.close()
            self._file.close(whole)

    def _number(self, name: str) -> int:
        """The number of a class, which is new if nobody has named it."""
        if name not in self._classes:
            new = 1 + max((each["id"] for each in self._classes.values()), default=-1)
            self._classes[name] = {"name": name, "id": new, "color": _COLORS[new % len(_COLORS)]}
        return int(self._classes[name]["id"])

    def _labelcloud(self, name: str, scan: _Item, boxes: Sequence[Named]) -> None:
        source = Path(scan.name)
        objects = [
            {
                "name": box.label,
                "centroid": _named("xyz", box.center),
                "dimensions": _named(("length", "width", "height"), box.size),
                "rotations": _named("xyz", (0.0, 0.0, wrapped(box.yaw))),
            }
            for box, _ in boxes
        ]
        document = {"folder": source.parent.name, "filename": source.name, "path": scan.name, "objects": objects}
        self._write(f"labels/{name}.json", scan.name, _json(document))

    def _sustechpoints(self, name: str, scan: _Item, boxes: Sequence[Named]) -> None:
        document = [
            {
                "obj_id": "" if number is None else str(number),
                "obj_type": _SUSTECH_CLASSES.get(box.label, _capital(box.label)),
                "psr": {part: _named("xyz", values) for part, values in cvat_cuboid(box).items()},
            }
            for box, number in boxes
        ]
        self._write(f"label/{name}.json", scan.name, _json(document))

    def _cvat(self, name: str, scan: _Item, boxes: Sequence[Named]) -> None:
        self._files.checked(self._folder / name, scan.name)
        now = {number: box for box, number in boxes if number is not None}
        # CVAT keeps a track to the end of the task, unless a box says that it is outside.
        gone = [(box, number, True) for number, box in self._before.items() if number not in now]
        annotations = []
        for k, (box, number, outside) in enumerate([*((box, number, False) for box, number in boxes), *gone]):
            attributes: dict[str, Any] = {"occluded": False}
            if number is not None:
                attributes |= {"track_id": number, "keyframe": True, "outside": outside}
            named = {"attributes": attributes, "group": 0, "label_id": self._number(box.label)}
            annotations.append({"id": k, "type": "cuboid_3d", **named, **cvat_cuboid(box)})
        item = {"id": name, "annotations": annotations, "attr": {"frame": self._n_items}}
        self._document.write((", " if self._n_items else "").encode() + json.dumps(item).encode())
        self._n_items += 1
        self._before = now
        self._file.check()

    def _kitti(self, name: str, scan: _Item, boxes: Sequence[Named]) -> None:
        T_cam_sensor, P2, text, size = _NOMINAL_TR, _NOMINAL_P2, "", _IMAGE_SIZE
        if self._calib is not None:
            path = calibration_of(self._calib, scan.name)
            T_cam_sensor, P2 = read_kitti_calibration(path)
            size = scan.image_size or size
            warn_off_center(P2, *size, "2-D boxes are cut to it. Pass the scans as --scan of their images")
            text = path.read_text("utf-8") if path.is_file() else ""
        origin, T_cam_file = scan.perception.origin_m, T_cam_sensor.copy()
        T_cam_file[:3, 3] -= T_cam_sensor[:3, :3] @ (origin or (0.0, 0.0, 0.0))
        if origin or not ("R0_rect" in text and "Tr_velo_to_cam" in text):  # readers of objects know no other names
            rows = {f"P{k}": P2 for k in range(4)} | {"R0_rect": np.eye(3), "Tr_velo_to_cam": T_cam_file[:3]}
            rows["Tr_imu_to_velo"] = np.eye(4)[:3]
            form = f"{{:.{12 if origin else 6}e}}".format  # a map has millions of meters
            text = "".join(f"{key}: {' '.join(map(form, row.flat))}\n" for key, row in rows.items())
        lines = [_kitti_line(box, T_cam_sensor, P2, size) for box, _ in boxes]
        self._write(f"calib/{name}.txt", scan.name, text.encode())  # first: labels are nothing without their camera
        self._write(f"label_2/{name}.txt", scan.name, "".join(lines).encode())

    def _write(self, name: str, scan: str, content: bytes) -> None:
        target = self._folder / name
        target.parent.mkdir(exist_ok=True)
        self._files.write(target, scan, content)


def _json(document: Any) -> bytes:
    return (json.dumps(document, indent=1, allow_nan=False) + "\n").encode()


def _known_classes(path: Path) -> dict[str, dict[str, Any]]:
    """The classes of labels that are there, by name, if they have the form of those to write. Raises OptionError."""
    try:
        document = json.loads(path.read_text("utf-8-sig"))
        form = document["format"]
        classes = {each["name"]: {**each, "id": int(each["id"])} for each in document["classes"]}
    except (KeyError, OverflowError, RecursionError, TypeError, ValueError) as exc:
        raise OptionError(f"{path} holds no classes of labelCloud ({exc!r:.99}); choose another folder") from exc
    if form != _FORM:
        raise OptionError(f"{path} has format {form!r:.40}, and {_FORM} would be written; choose another folder")
    return classes


def calibration_of(calib: Path, scan: str) -> Path:
    """KITTI's calibration of a scan: a file or a raw drive's folder for all, or a folder with one for each. Raises
    CalibrationError.
    """
    if not calib.is_dir() or (calib / "calib_cam_to_cam.txt").exists():
        return calib
    own = calib / f"{stem_of(scan)[0]}.txt"
    if not own.exists():
        raise CalibrationError(
            f"{own}, the calibration of {scan}, is missing; add it, pass one file for all scans, or leave this scan out"
        )
    return own


def cvat_cuboid(box: Box) -> dict[str, list[float]]:
    """Center, angles about x, y, z and size of a box as CVAT has them: 9 numbers, in this order."""
    return {
        "position": _rounded(box.center),
        "rotation": [0.0, 0.0, *_rounded([wrapped(box.yaw)])],
        "scale": _rounded(box.size),
    }


def _kitti_line(box: Box, T_cam_sensor: Floats, P2: Floats, size: tuple[int, int]) -> str:
    R, t = T_cam_sensor[:3, :3], T_cam_sensor[:3, 3]
    length, width, height = box.size
    center = R @ np.array(box.center) + t
    ahead = level_heading(R, box.yaw)
    turn = math.atan2(-ahead[2], ahead[0])
    x, y, z = center[0], center[1] + height / 2.0, center[2]  # the middle of the bottom face; y points down
    around = ((0.5, 0.5), (0.5, -0.5), (-0.5, -0.5), (-0.5, 0.5))
    signs = np.array([[i, j, k] for j in (-0.5, 0.5) for i, k in around])  # in the order of `box_corners`
    cos, sin = math.cos(turn), math.sin(turn)
    corners = signs * [length, height, width] @ np.array([[cos, 0.0, -sin], [0.0, 1.0, 0.0], [sin, 0.0, cos]]) + center
    image = corners @ P2[:, :3].T + P2[:, 3]
    ends = edges_ahead(image, _NEAREST_M).reshape(-1, 3)
    rectangle, cut = np.zeros(4), 1.0
    if len(ends):
        pixels = ends[:, :2] / ends[:, 2:]
        whole = np.array([*pixels.min(axis=0), *pixels.max(axis=0)])
        seen = np.clip(whole, 0.0, np.tile(np.array(size) - 1.0, 2))
        if (seen[2:] > seen[:2]).all():
            rectangle = seen
            cut = 1.0 - float(np.prod(seen[2:] - seen[:2]) / np.prod(whole[2:] - whole[:2]))
    alpha, solid = wrapped(turn - math.atan2(x, z)), (height, width, length, x, y, z)
    texts = [f"{cut:.2f} 3 {alpha:.4f}", *(f"{v:.2f}" for v in rectangle), *(f"{v:.4f}" for v in solid)]
    return f"{_capital(box.label)} {' '.join(texts)} {turn:.5f}\n"


def _capital(label: str) -> str:
    """KITTI's way to write a class: without blanks, with a capital; a class of blanks alone is unknown."""
    text = "_".join(label.split()) or "unknown"
    return text[:1].upper() + text[1:]


def _rounded(values: Sequence[float]) -> list[float]:
    return [round(float(value), 5) for value in values]


def _named(names: Sequence[str], values: Sequence[float]) -> dict[str, float]:
    return dict(zip(names, _rounded(values), strict=True))
