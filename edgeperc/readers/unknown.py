"""Formats that are not read: what a file is, and what to do with it."""

from __future__ import annotations

from pathlib import Path

_ARCHIVE = "an archive; unpack it first"
_FILM = "a film; edgeperc reads images (.jpg, .png), for a camera model"
_TABLE = "read it with pandas, and pass a data frame of its columns x, y, z and intensity"
_OF_SET = "docs/howto/train.md has lines that make .bin files of its scans"

# First bytes, and what to say of them.
_KNOWN: dict[bytes | tuple[bytes, ...], str] = {
    b"version https://git-lfs": "a pointer of Git LFS; the file itself is not there yet. Run: git lfs pull",
    b"LASF": "a LAS or LAZ file; convert it, e.g.: pdal translate FILE scan.pcd, or read it with laspy",
    b"ARROW1": f"a Feather (Arrow) table; of Argoverse 2, {_OF_SET}; of others, {_TABLE}",
    b"PAR1": f"a Parquet table; of Waymo, edgeperc eval ROOT:waymo reads it, and {_OF_SET}; of others, {_TABLE}",
    b"ASTM-E57": "an E57 file; convert it with CloudCompare or pdal, to .pcd or .ply",
    b"\x89HDF": "an HDF5 file; read it with h5py, and pass x, y, z and intensity as an array of shape (n, 4)",
    b"MATLAB": "a MATLAB file; save the points as .npy or .pcd",
    (b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05"): "a pickle, which is never unpickled; save the points as .npy",
    b"DRACO": "a Draco file; decode it to .ply",
    (b"\x1f\x8b", b"BZh", b"\xfd7zXZ", b"7z\xbc\xaf", b"\x28\xb5\x2f\xfd", b"Rar!"): _ARCHIVE,
    b"\xff\xfe": "text in UTF-16, if text at all; save it as UTF-8",
    b"\x1a\x45\xdf\xa3": _FILM,
    b"RIFF": "a film or an image (RIFF); edgeperc reads .jpg and .png, for a camera model",
    (b"\x89PNG", b"\xff\xd8\xff"): "an image; pass it with a camera model: --model camseg",
    (b"II*\0", b"MM\0*", b"GIF8"): "a TIFF or GIF image; convert it to .png, for a camera model",
    b"%PDF": "a PDF document",
    b"\x7fELF": "a program",
}


def advice_for(head: bytes, name: str = "") -> str | None:
    """What a file of another format is, and what to do; None if its first bytes are not known."""
    if head.startswith(b"\x1f\x8b") and name.lower().endswith(".pkl.gz"):
        return (
            f"a pickle in gzip; of PandaSet, edgeperc eval ROOT:pandaset reads it, and {_OF_SET}; others are never "
            "unpickled: save the points as .npy"
        )
    if head[4:8] == b"ftyp":
        return _FILM
    if head[257:262] == b"ustar":
        return _ARCHIVE
    if head[:256].lstrip().lower().startswith((b"<!doctype", b"<html", b"<?xml")):
        return "a web page or XML; a download may have failed"
    if head.lstrip()[:1] in (b"{", b"["):
        return "JSON; save the points as .npy or .pcd"
    return next((advice for first, advice in _KNOWN.items() if head.startswith(first)), None)


def missing(path: Path, what: str, expected: str) -> str:
    """What to say of a path at which nothing is."""
    if path.is_symlink():
        return (
            f"a link to {path.readlink()}, which is not there: fetch its file (git annex get, dvc pull), or mount its "
            "disk"
        )
    if str(path) == "-":
        return "standard input is not read; write it into a file, and pass that"
    return f"there is no such {what}; expected {expected}"
