"""Arrays that might be scans: plausible ones, and about thirty ways to make them hostile."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .running import Case

Points = NDArray[Any]

EXTREMES = np.array(
    [0.0, -0.0, 1e-45, 1e-38, 1e-20, 1e-7, 0.1, 1.0, 45.999996, 46.0, 1e3, 1e4, 1e5, 1e7, 2.0**24, 2.0**31, 2.0**63,
     1e19, 1e20, 1e30, 1.8e38, 3.4028235e38], np.float32
)  # fmt: skip


def base_scan(case: Case) -> Points:
    """(n, 4) float32: rings of a spinning LiDAR on a road with boxes, or points anywhere."""
    rng = case.rng
    n = int(2000 ** rng.random()) - 1 if rng.random() < 0.95 else int(rng.integers(0, 20_000))
    way = rng.integers(4)
    scan = np.empty((n, 4), np.float32)
    scan[:, 3] = rng.random(n)
    if way == 0:
        scan[:, :3] = rng.uniform(-50.0, 50.0, (n, 3))
        return scan
    if way == 1:
        scan[:, :3] = rng.normal(0.0, 10.0 ** rng.uniform(-3, 3), (n, 3))
        return scan
    azimuth = np.linspace(np.pi, -np.pi, n, endpoint=False) if rng.random() < 0.5 else rng.uniform(-1.0, 1.0, n)
    elevation = np.radians(rng.choice(np.linspace(2.0, -24.0, 16), n))
    ranges = np.minimum(-1.73 / np.minimum(np.sin(elevation), -1e-3), rng.uniform(1.0, 80.0))
    scan[:, 0] = ranges * np.cos(elevation) * np.cos(azimuth)
    scan[:, 1] = ranges * np.cos(elevation) * np.sin(azimuth)
    scan[:, 2] = ranges * np.sin(elevation)
    for _ in range(int(rng.integers(0, 4))):  # objects
        k = int(rng.integers(0, 200))
        at = rng.uniform((3.0, -15.0, -1.7), (40.0, 15.0, -0.5))
        box = rng.uniform(-0.5, 0.5, (k, 4)) * (*rng.uniform(0.3, 6.0, 3), 0.0)
        box[:, :3] += at
        scan = np.concatenate([scan, box.astype(np.float32)])
    return scan


def hostile_scan(case: Case) -> Any:
    """A scan with up to three mutations."""
    scan: Any = base_scan(case)
    for _ in range(int(case.rng.choice([0, 1, 1, 1, 2, 2, 3]))):
        mutate = case.pick(MUTATIONS)
        if type(scan) is not np.ndarray or scan.dtype.kind not in "fiu" or scan.ndim != 2 or scan.shape[1] < 3:
            break  # to a subclass or a list, nothing more is done
        with np.errstate(all="ignore"):
            scan = mutate(scan.astype(np.float32) if mutate in IN_FLOAT32 else scan, case)
    return scan


def _rows(scan: Points, case: Case) -> NDArray[np.int64]:
    """Some rows, a few or many."""
    n = len(scan)
    return case.rng.integers(0, n, int(n ** case.rng.random())) if n else np.zeros(0, np.int64)


def other_shape(scan: Points, case: Case) -> Points:
    n = len(scan)
    ways: list[Callable[[], Points]] = [
        lambda: scan[:, :3], lambda: scan.T, lambda: scan.ravel(), lambda: scan[..., None], lambda: scan[None],
        lambda: np.c_[scan, scan], lambda: np.c_[scan[:, :3], scan[:, :2]], lambda: scan[:0], lambda: scan[:1],
        lambda: scan[:, :2], lambda: scan[:, :0], lambda: np.empty(0, np.float32), lambda: np.float32(1.0),
        lambda: scan.reshape(1, n, scan.shape[1]), lambda: np.empty((0, 3), np.float32), lambda: scan[:4].T,
    ]  # fmt: skip
    return case.pick(ways)()


def other_dtype(scan: Points, case: Case) -> Points:
    kinds = [
        "f2", "f8", "f4", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", ">f4", ">f8", ">i2", "?", "c8", "O", "U8",
        "M8[s]", "g", "S4", "V4",
    ]  # fmt: skip
    kind = case.pick(kinds)
    try:
        return scan.astype(kind)
    except (TypeError, ValueError):
        return scan.astype("O")


def structured(scan: Points, case: Case) -> Points:
    rng = case.rng
    names = ["x", "y", "z", case.pick(["intensity", "remission", "i", "reflectivity", "scalar_Intensity", "t", ""])]
    formats: list[Any] = [case.pick(["<f4", ">f4", "f8", "i2", "u2", "i4", "f2"]) for _ in names]
    if rng.random() < 0.2:
        names[int(rng.integers(4))] = case.pick(["X", "scalar_x", "w", "z "])
    if rng.random() < 0.2:
        formats[int(rng.integers(4))] = case.pick(["O", "U3", ("f4", (3,)), "c8", "?", "M8[s]", [("x", "f4")]])
    if len({*names}) < 4:
        names = [f"{name}{k}" for k, name in enumerate(names)]
    dtype = np.dtype(list(zip(names, formats, strict=True)), align=bool(rng.integers(2)))
    made = np.zeros(len(scan), dtype)
    for k, name in enumerate(names):
        try:
            made[name] = scan[:, min(k, scan.shape[1] - 1)]
        except (TypeError, ValueError):
            continue
    if rng.random() < 0.3 and len(made) % 2 == 0:
        made = made.reshape(2, -1)
    return made


def strided(scan: Points, case: Case) -> Points:
    ways: list[Callable[[], Points]] = [
        lambda: np.asfortranarray(scan), lambda: scan[::-1], lambda: scan[::2], lambda: scan[:, ::-1],
        lambda: np.repeat(scan, 2, axis=1)[:, ::2], lambda: np.broadcast_to(scan[:1], (len(scan), scan.shape[1])),
        lambda: np.broadcast_to(scan[:1], (min(200_000, 97 * len(scan)), scan.shape[1])) if len(scan) else scan,
        lambda: np.lib.stride_tricks.as_strided(scan, (len(scan), scan.shape[1]), (0, 0)),
    ]  # fmt: skip
    return case.pick(ways)()


def not_finite(scan: Points, case: Case) -> Points:
    if scan.dtype.kind != "f":
        return scan
    scan = scan.copy()
    if case.chance(0.2):
        scan[:] = case.pick([np.nan, np.inf, -np.inf])
    scan[_rows(scan, case), int(case.rng.integers(scan.shape[1]))] = case.pick([np.nan, np.inf, -np.inf])
    return scan


def nan_bits(scan: Points, case: Case) -> Points:
    """Any bits: signalling NaN, denormal numbers."""
    return np.frombuffer(case.rng.bytes(16 * len(scan)), np.float32).reshape(-1, 4)


def extreme_coordinates(scan: Points, case: Case) -> Points:
    rows, signs = _rows(scan, case), case.rng.choice([-1.0, 1.0], 1)
    scan[rows, int(case.rng.integers(scan.shape[1]))] = (case.rng.choice(EXTREMES, len(rows)) * signs).astype(
        np.float32
    )
    return scan


def only_extremes(scan: Points, case: Case) -> Points:
    shape = (len(scan), 4)
    return (case.rng.choice(EXTREMES, shape) * case.rng.choice([-1.0, 1.0], shape)).astype(np.float32)


def identical(scan: Points, case: Case) -> Points:
    scan = scan.copy()
    scan[:] = scan[:1]
    return scan


def many_duplicates(scan: Points, case: Case) -> Points:
    return np.repeat(scan[: max(1, len(scan) // 50)], int(case.rng.integers(1, 200)), axis=0)


def one_column(scan: Points, case: Case) -> Points:
    """Points above one another, or a constant coordinate."""
    for k in case.rng.choice(3, int(case.rng.integers(1, 4)), replace=False):
        scan[:, k] = case.pick([0.0, 10.0, -1.73])
    return scan


def lattice(scan: Points, case: Case) -> Points:
    step = np.float32(case.pick([0.05, 0.1, 0.4, 1.0, 10.0]))
    scan[:, :3] = np.round(scan[:, :3] / step) * step
    return scan


def full_lattice(scan: Points, case: Case) -> Points:
    edge = int(case.rng.integers(2, 14))
    step = case.pick([0.1, 0.3, 0.5, 1.0])
    grid = np.stack(np.meshgrid(*[np.arange(edge) * step] * 3), axis=-1).reshape(-1, 3)
    return np.c_[grid + case.rng.uniform(-5, 5, 3), np.full(len(grid), 0.5)].astype(np.float32)


def millimeters(scan: Points, case: Case) -> Points:
    scan[:, :3] *= np.float32(case.pick([1000.0, 100.0, 0.001, 1e-6, 3.28]))
    return scan


def z_is_row(scan: Points, case: Case) -> Points:
    scan[:, 2] = np.arange(len(scan)) % int(case.pick([16, 64, 1 << 30]))
    return scan


def z_is_16_bits(scan: Points, case: Case) -> Points:
    scan[:, 2] = case.rng.integers(0, 65536, len(scan))
    return scan


def swapped_axes(scan: Points, case: Case) -> Points:
    order = case.rng.permutation(3)
    scan[:, :3] = scan[:, :3][:, order] * case.pick([1, -1])
    return scan


def huge(scan: Points, case: Case) -> Points:
    """Up to 200,000 points, seldom."""
    if case.rng.random() < 0.97:
        return scan
    n = int(case.rng.integers(20_000, 200_000))
    scan = np.resize(scan, (n, scan.shape[1])).astype(np.float32)
    if case.chance(0.7):
        scan[:, :3] += case.rng.normal(0.0, 3.0, (n, 3)).astype(np.float32)
    return scan


def remissions(scan: Points, case: Case) -> Points:
    if scan.shape[1] < 4:
        return scan
    scan = scan.astype(np.float32)
    n = len(scan)
    low, high = case.pick([(0, 255), (0, 65535), (-1, 0), (-1e38, 1e38), (0, 1e-38), (0, 0), (1e30, 1e38)])
    scan[:, 3] = case.rng.uniform(low, high, n)
    if case.chance(0.3):
        scan[_rows(scan, case), 3] = case.pick([np.nan, np.inf, -np.inf, -3.4e38])
    if case.chance(0.3):
        scan[:, 3] = np.floor(scan[:, 3])
    return scan


def read_only(scan: Points, case: Case) -> Points:
    scan = scan.copy()
    scan.flags.writeable = False
    return scan


def byte_swapped(scan: Points, case: Case) -> Points:
    swapped = scan.astype(scan.dtype.newbyteorder())
    return swapped.view(scan.dtype) if case.chance(0.3) else swapped


def memory_mapped(scan: Points, case: Case) -> Points:
    path = case.folder / "scan.bin"
    scan.tofile(path)
    if not scan.size:
        return scan
    return np.memmap(path, scan.dtype, case.pick(["r", "c", "r+"]), shape=scan.shape)


class Subclass(np.ndarray):  # type: ignore[type-arg]
    """Breaks what it can."""

    def __array_finalize__(self, obj: Any) -> None:
        self.info = getattr(obj, "info", None)

    def __len__(self) -> int:
        return 7

    def copy(self, order: Any = "C") -> Any:
        raise ZeroDivisionError


def subclass(scan: Points, case: Case) -> Points:
    kinds: list[Any] = [Subclass, np.recarray, np.matrix] if hasattr(np, "matrix") else [Subclass, np.recarray]
    return scan.view(case.pick(kinds))


def masked(scan: Points, case: Case) -> Points:
    return np.ma.masked_greater(scan, 1.0)


class Arrayish:
    """What `numpy.asarray` may get from an object."""

    def __init__(self, way: int, scan: Points) -> None:
        self.way, self.scan = way, scan

    def __array__(self, dtype: Any = None, copy: Any = None) -> Any:
        if self.way == 0:
            raise ZeroDivisionError
        return self.scan if self.way == 1 else [1, 2, 3] if self.way == 2 else self.scan.astype("O")


def objects(scan: Points, case: Case) -> Any:
    few = scan[:50].tolist()
    ways: list[Callable[[], Any]] = [
        lambda: few, lambda: tuple(map(tuple, few)), lambda: [*few, [1.0]], lambda: [[None] * 4] * 3, lambda: None,
        lambda: "scan", lambda: b"scan", lambda: {"x": [1.0]}, lambda: iter(few), lambda: {1.0, 2.0}, lambda: [],
        lambda: [[]], lambda: [[[]]], lambda: 5, lambda: float("nan"), lambda: [["1", "2", "3", "4"]], lambda: object(),
        lambda: [[10**400, 0, 0, 0]], lambda: [[1 + 2j] * 4], lambda: memoryview(b"1234567890123456"),
        lambda: Arrayish(0, scan), lambda: Arrayish(1, scan), lambda: Arrayish(2, scan), lambda: Arrayish(3, scan),
        lambda: range(4), lambda: [True, False, True, False], lambda: np.array(few, "O"), lambda: [scan, scan],
    ]  # fmt: skip
    return case.pick(ways)()


def unaligned(scan: Points, case: Case) -> Points:
    raw = np.zeros(scan.nbytes + 1, np.uint8)
    made = raw[1:].view(scan.dtype).reshape(scan.shape) if scan.nbytes else scan
    if scan.nbytes:
        made[:] = scan
    return made


def origin(scan: Points, case: Case) -> Points:
    scan[:, :3] *= np.float32(case.pick([0.0, 1e-30, 1e-3]))
    return scan


def one_pixel(scan: Points, case: Case) -> Points:
    scan[:, :3] = np.float32([20.0, 0.0, -1.0]) * (1.0 + 1e-4 * case.rng.random((len(scan), 1)).astype(np.float32))
    return scan


def behind(scan: Points, case: Case) -> Points:
    scan[:, 0] = -np.abs(scan[:, 0])
    return scan


def edges(scan: Points, case: Case) -> Points:
    """One unit in the last place beside the edges of cells and of the view."""
    places = np.float32(case.pick([0.1, 0.4, 1.0])) * np.round(scan[:, :3] * 2.5)
    towards = np.float32(case.pick([-np.inf, np.inf]))
    scan[:, :3] = np.nextafter(places.astype(np.float32), towards)
    return scan


def shell(scan: Points, case: Case) -> Points:
    """A sphere, a wall around, a ceiling: nothing that looks like a road."""
    norm = np.maximum(np.linalg.norm(scan[:, :3].astype(np.float64), axis=1, keepdims=True), 1e-9)
    scan[:, :3] *= (10.0 / norm).astype(np.float32)
    if case.chance(0.3):
        scan[:, 2] = np.abs(scan[:, 2])
    return scan


def sparse_far(scan: Points, case: Case) -> Points:
    scan[:, :2] *= np.float32(10.0 ** case.rng.uniform(2, 37))
    return scan


def from_buffer(scan: Points, case: Case) -> Points:
    empty = bytes(scan.shape[1] * scan.itemsize)
    return np.frombuffer(np.ascontiguousarray(scan).tobytes() or empty, scan.dtype).reshape(-1, scan.shape[1])


MUTATIONS: list[Callable[[Points, Case], Any]] = [
    other_shape, other_dtype, structured, strided, not_finite, nan_bits, extreme_coordinates, only_extremes, identical,
    many_duplicates, one_column, lattice, full_lattice, millimeters, z_is_row, z_is_16_bits, swapped_axes, huge,
    remissions, read_only, byte_swapped, memory_mapped, subclass, masked, objects, unaligned, origin, one_pixel, behind,
    edges, shell, sparse_far, from_buffer,
]  # fmt: skip
IN_FLOAT32 = {
    extreme_coordinates, one_column, lattice, millimeters, z_is_row, z_is_16_bits, swapped_axes, origin,
    one_pixel, behind, edges, shell, sparse_far,
}  # fmt: skip
"""Those that change numbers in place, of a copy as float32."""


def save(path: Path, scan: Any) -> bytes:
    """A scan's bytes as .npy if it is a plain array, else its description."""
    if isinstance(scan, np.ndarray) and not scan.dtype.hasobject and scan.nbytes < 1 << 22:
        np.save(path, np.asarray(scan), allow_pickle=False)
        content = path.read_bytes()
        os.unlink(path)  # noqa: PTH108
        return content
    return repr(scan)[:2000].encode("utf-8", "replace")
