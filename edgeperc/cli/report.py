"""What ``edgeperc run`` prints of each scan: a line or a JSON object; an error also on stderr."""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from ..errors import MissingExtraError
from ..system.printable import many
from ..system.remote import Remote
from .output import in_options, one_line, print_error, print_result

if TYPE_CHECKING:
    from ..live import Answer
    from ..tracking.tracks import Tracks
    from ..types.perception import Perception


class Outcome(NamedTuple):
    """Of a scan or image: the answer or an error, and its tracks."""

    source: Path | Remote
    answer: Perception | Answer | Exception
    tracks: Tracks | None = None


class Report:
    """Prints the result of each scan, and counts scans and failures."""

    def __init__(self, arguments: argparse.Namespace, images: Mapping[Path, Path | None]) -> None:
        self.n = self.n_failed = 0
        self._images = images
        self._json = arguments.json
        self._reported: dict[str, Path | Remote] = {}

    def add(self, outcome: Outcome) -> None:
        """Print one scan's line or JSON object; print an error on stderr as well."""
        source, answer, _ = outcome
        if isinstance(answer, MissingExtraError):
            raise answer
        error = str(answer).removeprefix(f"{source}: ") if isinstance(answer, Exception) else None
        self.show(source, self.text(outcome), error)

    def show(self, source: Path | Remote, text: str, error: str | None) -> None:
        """Count a scan, and print its `text` and its error."""
        self.n += 1
        if text:
            try:
                print_result(text)
            except BrokenPipeError:  # nobody reads any more
                raise
            except OSError as exc:
                error = error or f"its result cannot be printed: {exc}"
        if error is not None:
            self.n_failed += 1
            said = in_options(error)
            alike = said.replace(source.name.partition(".")[0], "")  # whatever the scan and the numbers
            first = self._reported.setdefault(re.sub(r"[-+\d.]+", "", alike), source)
            print_error(f"{source}: {said}" if first is source else f"{source}: the same as {first}")

    def text(self, outcome: Outcome) -> str:
        """One scan's line or JSON object; of a failed scan without ``--json``, nothing."""
        from ..types.perception import Perception

        source, found, tracks = outcome
        if isinstance(found, Exception):
            return json.dumps({**self._names(source), "error": one_line(found)}) if self._json else ""
        answer, perception = (None, found) if isinstance(found, Perception) else (found, found.perception)
        timing: dict[str, Any] | None = None
        if answer is not None:
            timing = {"age_ms": round(1e3 * answer.age_s, 3), "health": answer.health}
            timing |= {"scans": answer.n_scans, "dropped": answer.n_dropped}
        if self._json:
            from ..records import scan_record

            stamp_s = perception.stamp_s
            names, record = self._names(source), scan_record(perception, tracks)
            if record["image"] is not None:
                record["image"] = {**names.pop("image"), **record["image"]}
            return json.dumps({**names, "stamp_s": stamp_s, "live": timing, **record}, allow_nan=False)
        parts = [str(source)]
        if timing is not None:
            parts.append("  ".join(f"{key} {value}" for key, value in timing.items()))
        parts.append(_summary(perception))
        if tracks is not None:
            parts.append(f"tracks: {'none, a late scan' if tracks.is_late else many(len(tracks), 'object')}")
        return "  ".join(parts)

    def _names(self, source: Path | Remote) -> dict[str, Any]:
        """The files of a record: the scan, or the image and its scan."""
        if isinstance(source, Remote) or source not in self._images:
            return {"scan": str(source)}
        scan = self._images[source]
        return {"scan": None if scan is None else str(scan), "image": {"file": str(source)}}


def _summary(perception: Perception) -> str:
    parts = []
    if perception.image is not None:
        height, width = perception.image.labels.shape
        shares = ((name, n / (width * height)) for name, n in perception.image.counts().items())
        parts.append(f"{width} x {height} pixels: {', '.join(f'{name} {100.0 * s:.1f} %' for name, s in shares if s)}")
    if perception.image is not None and not perception.n_points:
        return "  ".join([*parts, f"{sum(perception.stage_ms.values()):.1f} ms"])
    parts += [f"{perception.n_points:,} points", f"{sum(perception.stage_ms.values()):.1f} ms"]
    if perception.top_view is not None:
        parts.append(f"drivable {perception.top_view.drivable_area_m2:.1f} m2")
        from ..road.ahead import free_ahead  # after the first scan: it loads numba

        ahead = free_ahead(perception.top_view, perception.boxes)
        if ahead.end is not None:
            parts.append(f"free to {ahead.free_m:.1f} m ({ahead.end})")
    labels = [box.label for box in perception.boxes]
    boxes = ", ".join(f"{labels.count(label)} {label}" for label in dict.fromkeys(labels))
    parts.append(f"boxes: {boxes or 'none'}")
    if perception.points is not None:
        counts = perception.points.counts()
        labeled = ", ".join(f"{name} {counts[name]:,}" for name in perception.points.classes[1:])
        parts.append(f"points: {labeled} of {perception.points.n_in_view:,} in view")
    return "  ".join(parts)
