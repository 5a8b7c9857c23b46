"""What a name from outside may be. Files, topics, messages and pages are made from names that passed here."""

from __future__ import annotations

import re
import reprlib
from collections.abc import Iterable
from pathlib import PurePath, PureWindowsPath

from ..errors import OptionError
from .fields import OPTIONS

MAX_NAME = 200
SCAN_SUFFIXES = (".pcd.bin", ".bin", ".npy", ".npz", ".pcd", ".ply")
_PICTURES = {
    f".{kind}" for kind in ("avi", "bmp", "gif", "jpeg", "jpg", "mp4", "pdf", "png", "svg", "tif", "tiff", "webp")
}
_MAX_COMPARED = 60
_NAME = re.compile(r"[A-Za-z0-9_]([A-Za-z0-9._+-]*[A-Za-z0-9_+-])?")
# Digits but those behind a decimal point: 1700.5 comes after 1700.25.
_WHOLE = re.compile(r"(?<![0-9])(?<![0-9]\.)([0-9]+)")
_DEVICES = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.IGNORECASE)  # Windows opens them, whatever the suffix


def nearest(name: str, known: Iterable[str]) -> str:
    """``" (did you mean hdl-64e?)"`` if a known name is close to a mistyped one, otherwise nothing."""
    import difflib  # 2 ms, for errors only

    match = difflib.get_close_matches(name[:_MAX_COMPARED], [*known], 1)
    return f" (did you mean {match[0]}?)" if match else ""


def stem_of(name: str) -> tuple[str, str]:
    """Name of a scan without folder and suffix, and its suffix in lower case, none for a capture's or an image's."""
    last = PurePath(name).name
    suffix = next((ending for ending in SCAN_SUFFIXES if last.lower().endswith(ending)), "")
    return (last[: -len(suffix)] if suffix else PurePath(last).stem), suffix


def by_number(path: PurePath | str) -> tuple[list[str | int], str]:
    """Key that sorts the files of a folder as people number them: 10.bin after 9.bin."""
    parts = _WHOLE.split(str(path))  # texts and numbers by turns: numbers stand at odd places
    return [int(part) if k % 2 else part for k, part in enumerate(parts)], str(path)


def check_text(field: str, text: str, error: type[Exception]) -> None:
    """Refuse a name that is only shown, if it is not one line that a terminal and a page can show."""
    if not isinstance(text, str) or not 0 < len(text) <= MAX_NAME or not text.isprintable() or not text.strip():
        raise error(f"{field} {reprlib.repr(text)}; expected 1 to {MAX_NAME} printable characters")


def check_file(field: str, name: str, error: type[Exception]) -> None:
    """Refuse the name of somebody's file, if it is a path or a device. It may hold what a page must escape."""
    if name in ("", ".", "..") or PureWindowsPath(name).name != name or "\0" in name or _DEVICES.fullmatch(name):
        raise error(f"{field} {reprlib.repr(name)}; expected a plain file name")


def check_name(field: str, name: str, error: type[Exception]) -> None:
    """Refuse a name that files are made from, if it is not that of one file, in its folder, on every system."""
    check_text(field, name, error)
    if not _NAME.fullmatch(name) or ".." in name or _DEVICES.fullmatch(name):
        raise error(
            f"{field} {reprlib.repr(name)}; expected a plain file name: letters a-z, digits, '_', '.', '+' and '-', "
            "the first a letter, digit or '_', without '..', and none that Windows reserves, such as nul"
        )


def check_picture(path: PurePath | str | None, suffix: str) -> None:
    """Refuse what is no path, or is named as another kind of picture or film. Raises OptionError."""
    if path is not None and OPTIONS.path("path", path).suffix.lower() in _PICTURES - {suffix}:
        raise OptionError(f"{path} would hold a picture in {suffix}; expected a name that ends so")
