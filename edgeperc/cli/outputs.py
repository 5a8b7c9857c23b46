"""Where a run writes: the files of each scan, none of which may replace a scan or another one's."""

from __future__ import annotations

import argparse
import os
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

from ..system.names import SCAN_SUFFIXES, stem_of
from ..system.remote import Remote
from .scans import is_recording
from .sinks import wanted_sinks


def check_outputs(
    arguments: argparse.Namespace,
    kinds: Sequence[str],
    images: Mapping[Path, Path | None],
    scans: Sequence[Path],
    targets: Sequence[Path],
) -> None:
    """Check that no file is a scan, or would be one of its folder for the next run, and none is written twice."""
    from ..readers.captures import CAPTURE_SUFFIXES
    from ..readers.images import IMAGE_SUFFIXES

    read = [source for source in (*scans, *images.values()) if source is not None]
    sources = {_real(source) for source in read}
    listed = {_real(source.parent) for source in read if source not in (*arguments.paths, *arguments.scan)}
    suffixes = (*SCAN_SUFFIXES, *CAPTURE_SUFFIXES, *(IMAGE_SUFFIXES if images else ()))
    outputs: list[tuple[str, Path]] = []
    # Files are opened for it, so only where their scans have files of their own.
    has_own = not images and bool(kinds or arguments.static is not None or arguments.labels_for is not None)
    captures = {scan for scan in scans if has_own and is_recording(scan)}
    for scan, target in zip(scans, targets, strict=True):
        first = target / "000000" if scan in captures else target
        outputs += [("--out", file) for file in files_of(arguments, first, kinds, bool(images)).values()]
    for (_, file), n in Counter(outputs).items():
        if n > 1:  # of a.png and a_scan.png
            arguments.usage_error(f"the pictures of two images would both be {file}; rename one of the images")
    outputs += [("--gif", arguments.out / "tracks.gif")] if arguments.gif else []
    for name in wanted_sinks(arguments):
        value = getattr(arguments, name)
        outputs += [(f"--{name}", value)] if isinstance(value, Path) else []
    written_of = [scan for scan in (images.values() if images else scans) if scan is not None]
    if arguments.static is not None:
        from ..sinks.static import file_name

        names = _names(arguments, "--static", {scan: file_name(_shown(scan, captures)) for scan in written_of})
        outputs += [("--static", arguments.static / name) for name in names]
    if arguments.labels_for is not None:
        from ..sinks.prelabels import calibration_of

        _names(arguments, "--labels-for", {scan: stem_of(_shown(scan, captures))[0] for scan in written_of})
        for scan in written_of if arguments.calib is not None else ():
            if scan not in captures:
                calibration_of(arguments.calib, scan.name)
    if arguments.labels_for == "cvat":
        outputs.append(("--labels-for", arguments.out / "annotations.zip"))
    written: dict[str, str] = {}
    for option, file in outputs:
        if _real(file) in sources and option != "--static":  # which replaces none
            arguments.usage_error(
                f"{file} is one of the {'images' if images else 'scans'} and would be overwritten; choose another --out"
            )
        if file.suffix.lower() in suffixes and _real(file.parent) in listed and _real(file) not in sources:
            arguments.usage_error(
                f"{option}: {file} would be read with the {'images' if images else 'scans'} of its folder by the next "
                "run; choose another folder"
            )
        other = written.setdefault(_real(file), option)
        if other != option:
            arguments.usage_error(f"{other} and {option} both write {file}; choose another name for one of them")


def _shown(scan: Path, captures: Collection[Path]) -> str:
    """Name of a scan; those of a capture have numbers, and this is the first."""
    return "000000" if scan in captures else scan.name


def _names(arguments: argparse.Namespace, option: str, names: Mapping[Path, str]) -> Sequence[str]:
    """The names of files that scans have, which differ: half of the run would be refused otherwise."""
    scans: dict[str, Path] = {}
    for scan, name in names.items():
        if (other := scans.setdefault(name, scan)) is not scan:
            arguments.usage_error(
                f"{option}: the files of {other} and of {scan} would both be called {name}; run each drive by itself, "
                "with a folder of its own"
            )
    return [*scans]


def _real(path: Path) -> str:
    return str(path) if isinstance(path, Remote) else os.path.realpath(path)


def files_of(arguments: argparse.Namespace, target: Path, kinds: Sequence[str], of_image: bool) -> dict[str, Path]:
    """The files to write by kind; ``"image"`` is the picture of an image, ``"both"`` that of an image and its scan."""
    files = {kind: target.with_name(f"{target.name}.{'label' if kind == 'labels' else kind}") for kind in kinds}
    if of_image and "png" in files:
        files["image"] = files.pop("png")
        if arguments.scan:
            files["png"] = target.with_name(f"{target.name}_scan.png")
        if arguments.calib is not None:
            files["both"] = target.with_name(f"{target.name}_both.png")
    return files
