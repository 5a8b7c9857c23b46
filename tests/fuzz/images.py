"""Images: hostile arrays and logits through a `Perceiver`, damaged files of every format, and damaged data sets."""

from __future__ import annotations

import functools
import importlib.util
import io
import json
import struct
import zlib
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import tiny_camera
from numpy.typing import NDArray
from tiny_camera import PNG, png_chunk, png_file

from edgeperc import Perception
from edgeperc.camera.image import MAX_EDGE, MAX_PIXELS
from edgeperc.datasets.images import LabeledImages
from edgeperc.readers.images import read_image
from edgeperc.types.views import CameraGeometry

from .mutate import mutated_bytes, mutated_document
from .running import Case, check, one_of
from .scans import MadeUp, perceiver_of

LIMIT_S, LIMIT_MB = 10.0, 2000.0  # an image of 2**26 pixels takes 200 MB, decoded and converted 600 MB
SIZES = ((32, 24), (4, 4), (60, 8), (480, 360))
LARGEST = 2**18  # pixels of nearly all cases
EXIF = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0"


def base_image(case: Case) -> NDArray[np.uint8]:
    """(H, W, 3) uint8: noise, one color, or a gradient; small, thin, or as large as a camera's."""
    rng = case.rng
    longest = LARGEST if case.chance(0.03) else 4000
    height = int(longest ** rng.random())
    width = max(1, int((longest / height) ** rng.random()))
    if case.chance(0.5):
        height, width = width, height
    way = int(rng.integers(3))
    if way == 0:
        return rng.integers(0, 256, (height, width, 3), dtype=np.uint8)
    if way == 1:
        return np.broadcast_to(rng.integers(0, 256, 3).astype(np.uint8), (height, width, 3)).copy()
    ramp = np.linspace(0, 255, height * width * 3).astype(np.uint8)
    return ramp.reshape(height, width, 3)


class Wrapped:
    """An object that claims to be an array."""

    def __init__(self, values: Any) -> None:
        self.values = values

    def __array__(self, dtype: Any = None, copy: Any = None) -> Any:
        if isinstance(self.values, BaseException):
            raise self.values
        return self.values


def hostile_image(case: Case) -> Any:
    """An image with up to two mutations of its type, shape or layout."""
    image: Any = base_image(case)
    for _ in range(int(case.rng.choice([0, 0, 1, 1, 2]))):
        if type(image) is not np.ndarray or image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
            break  # to another kind of array, nothing more is done
        if not 0 < image.size <= 3 * LARGEST:
            break
        image = case.pick(MUTATIONS)(image, case)
    return image


def other_dtype(image: Any, case: Case) -> Any:
    kind = case.pick(["f4", "f8", "f2", "i1", "i2", "u2", "u4", "i8", "?", "O", ">u2", "S2", "U2", "c8", "V1", "M8[s]"])
    try:
        return image.astype(kind)
    except (TypeError, ValueError):
        return image.astype("O")


def other_shape(image: Any, case: Case) -> Any:
    ways: list[Callable[[], Any]] = [
        lambda: image[..., :1], lambda: image[..., 0], lambda: image[..., [0, 1, 2, 0]], lambda: image[None],
        lambda: image.transpose(2, 0, 1), lambda: image.ravel(), lambda: image[:0], lambda: image[:, :0],
        lambda: image[..., :0], lambda: image[..., None], lambda: np.uint8(3), lambda: image[:1], lambda: image[:, :1],
        lambda: image[..., :2],
    ]  # fmt: skip
    return case.pick(ways)()


def other_layout(image: Any, case: Case) -> Any:
    ways: list[Callable[[], Any]] = [
        lambda: np.asfortranarray(image), lambda: image[::-1], lambda: image[:, ::-2], lambda: image[..., ::-1],
        lambda: image.swapaxes(0, 1), lambda: np.broadcast_to(image[:1, :1], image.shape),
        lambda: np.frombuffer(b"x" + image.tobytes(), np.uint8, offset=1).reshape(image.shape),
        lambda: np.repeat(image, 2, axis=1)[:, ::2], lambda: memoryview(np.ascontiguousarray(image)),
        lambda: np.lib.stride_tricks.as_strided(image, image.shape, (0, 0, 0), writeable=False),
    ]  # fmt: skip
    return case.pick(ways)()


def other_object(image: Any, case: Case) -> Any:
    ways: list[Callable[[], Any]] = [
        lambda: np.ma.masked_array(image, image > 9), lambda: image[:8, :8].tolist(), lambda: Wrapped(image),
        lambda: Wrapped(ZeroDivisionError()), lambda: Wrapped(image.tolist()), lambda: [[1, 2], [3]], lambda: {},
        lambda: image.view(np.recarray), lambda: "image.png", lambda: image.tobytes(), lambda: [image, image[:1]],
        lambda: np.zeros(image.shape[:2], [("r", "u1"), ("g", "u1"), ("b", "u1")]), lambda: object(),
        lambda: np.broadcast_to(image[:1, :1], (1 << 20, 1 << 20, 3)),
        lambda: np.broadcast_to(image[:1, :1], (MAX_EDGE + 1, 1, 3)),
        lambda: np.broadcast_to(image[:1, :1], (1, MAX_EDGE, 3)),
    ]  # fmt: skip
    return case.pick(ways)()


MUTATIONS = (other_dtype, other_shape, other_layout, other_layout, other_object)


def check_image(perception: Perception, height: int, width: int, n_classes: int) -> None:
    """The labels are complete, in range, and can be written as JSON."""
    found = perception.image
    check(found is not None, "no labels of the image")
    check(found.labels.shape == (height, width), f"labels of shape {found.labels.shape} for {height} x {width}")
    check(found.labels.dtype == np.uint8 and found.labels.flags.c_contiguous, "labels of another type")
    check(int(found.labels.max()) < n_classes, f"label {found.labels.max()} of {n_classes} classes")
    check(sum(found.counts().values()) == height * width, "counts do not add up")
    check(0.0 <= found.drivable_share <= 1.0, f"drivable share {found.drivable_share}")
    check(min(perception.stage_ms.values()) >= 0.0, "negative time")
    json.dumps(perception.to_dict(), allow_nan=False)


class Images:
    """The kind ``images``."""

    name, limit_s, limit_mb = "images", LIMIT_S, LIMIT_MB

    def __init__(self) -> None:
        self.perceivers = []
        for width, height in SIZES:
            card = tiny_camera.camera_card()
            card = replace(card, golden=None, view=CameraGeometry(width, height))
            session = MadeUp(card)
            self.perceivers.append((perceiver_of(session), session))
        ways: list[tuple[int, Callable[[Case], str]]] = [(12, self.array)]
        if importlib.util.find_spec("PIL"):
            ways += [(10, self.file_bytes), (6, self.png_header), (2, self.data_set), (3, self.whole_file)]
            self.files = list(self._files())
            self.labels = png_file(31, 20, 8, 0, bytes(20 * 32))
        self.ways = [way for weight, way in ways for _ in range(weight)]

    def _files(self) -> Any:
        from PIL import Image

        image = np.random.default_rng(3).integers(0, 256, (20, 31, 3), dtype=np.uint8)
        image[:10] = 120
        picture = Image.fromarray(image)
        exif = Image.Exif()
        exif[0x0112] = 6
        for kind, mode, options in (
            ("JPEG", "RGB", {"exif": exif}), ("JPEG", "RGB", {"progressive": True}), ("JPEG", "CMYK", {}),
            ("JPEG", "L", {}), ("PNG", "RGB", {"exif": exif}), ("PNG", "P", {"transparency": 0}), ("PNG", "LA", {}),
            ("PNG", "RGBA", {}), ("PNG", "I;16", {}), ("PNG", "1", {}), ("WEBP", "RGB", {}), ("WEBP", "RGBA", {}),
            ("WEBP", "RGB", {"lossless": True}), ("BMP", "RGB", {}), ("BMP", "P", {}), ("BMP", "1", {}),
            ("PPM", "RGB", {}), ("PPM", "L", {}), ("TIFF", "RGB", {}), ("GIF", "P", {}),
            ("PNG", "RGB", {"save_all": True, "append_images": [picture.rotate(9)]}),
            ("WEBP", "RGB", {"save_all": True, "append_images": [picture.rotate(9)]}),
        ):  # fmt: skip
            stream = io.BytesIO()
            picture.convert(mode).save(stream, kind, **options)
            yield stream.getvalue()
        yield b"P5 3 2 65535\n" + bytes(12)
        yield b"P3 1 1 255\n1 2 3\n"

    def run(self, case: Case) -> str:
        return one_of(self.ways, case)

    def array(self, case: Case) -> str:
        perceive, session = case.pick(self.perceivers)
        session.case, session.hostile = case, case.chance(0.4)
        image = hostile_image(case)
        case.evidence["image.txt"] = lambda: repr(image)[:5000].encode()
        before = image.copy() if type(image) is np.ndarray and image.size < LARGEST else None
        perception = perceive(image=image)
        height, width, _ = np.asarray(image).shape
        check_image(perception, height, width, len(perceive.cards[0].classes))
        check(np.isfinite(session.input).all(), "an input that is not finite")
        check(float(np.abs(session.input).max()) <= 1.0 + 1e-5, f"an input of {np.abs(session.input).max()}")
        if before is not None:
            check(np.array_equal(before, image), "the image was changed")
        return "answer"

    def read(self, case: Case, content: bytes) -> str:
        path = case.folder / case.pick(["image.png", "image.jpg", "image"])
        path.write_bytes(content)
        case.evidence["image"] = content
        image = read_image(path)
        check(image.dtype == np.uint8 and image.ndim == 3 and image.shape[2] == 3, f"{image.dtype} {image.shape}")
        check(0 < image.size <= 3 * MAX_PIXELS and max(image.shape) <= MAX_EDGE, f"{image.shape}")
        return "answer"

    def file_bytes(self, case: Case) -> str:
        return self.read(case, mutated_bytes(case.pick(self.files), case, 4, near=case.pick([0, 64])))

    def whole_file(self, case: Case) -> str:
        content = case.pick(self.files)
        return self.read(case, case.pick([content, content[: int(case.rng.integers(len(content) + 1))], content * 2]))

    def png_header(self, case: Case) -> str:
        """PNG files with checksums that are right, and with sizes, depths and chunks that are not."""
        rng = case.rng
        width, height = (int(case.pick([1, 7, 31, 31, 4097])) for _ in "wh")
        depth, color, ways = 8, int(case.pick([0, 2, 3, 4, 6])), [0, 0, 0]
        if case.chance(0.6):
            width = int(case.pick([0, width, MAX_EDGE, MAX_EDGE + 1, 2**31 - 1, 2**32 - 1]))
            height = int(case.pick([0, height, MAX_EDGE, MAX_EDGE + 1, 2**31 - 1, 2**32 - 1]))
            depth, color = int(case.pick([1, 2, 4, 8, 16, 3, 255])), int(case.pick([0, 2, 3, 4, 6, 1, 255]))
            ways = [int(rng.choice([0, 0, 0, 0, 1, 9])) for _ in range(3)]
        header = struct.pack(">IIBBBBB", width, height, depth, color, *ways)
        n = min(height * (1 + 4 * width), 1 << 18)
        rows = png_chunk(b"IDAT", packed_zeros(n))
        chunks = [
            rows, rows, png_chunk(b"IDAT", zlib.compress(rng.bytes(n), 0)),
            png_chunk(b"PLTE", rng.bytes(int(case.pick([0, 3, 768, 900])))), png_chunk(b"tRNS", rng.bytes(6)),
            png_chunk(b"eXIf", mutated_bytes(EXIF[6:] + bytes(12), case, 2)),
            png_chunk(b"iCCP", b"a\0\0" + rng.bytes(20)), png_chunk(b"zTXt", b"a\0\0" + packed_zeros(1 << 20)),
            png_chunk(b"acTL", struct.pack(">II", 3, 0)), png_chunk(b"IHDR", header), png_chunk(b"IEND", b""),
            struct.pack(">I", 2**31) + b"IDAT",
        ]  # fmt: skip
        picked = b"".join(case.pick(chunks) for _ in range(int(rng.integers(1, 6))))
        return self.read(case, PNG + png_chunk(b"IHDR", header) + picked + png_chunk(b"IEND", b""))

    def data_set(self, case: Case) -> str:
        root = case.folder / "set"
        for folder in ("val", "valannot"):
            (root / folder).mkdir(parents=True)
        names = mutated_document({"0": "Sky", "1": "Road", "2": "Tree", "3": "Unlabeled"}, case)
        (root / "classes.json").write_text(json.dumps(names) if case.chance(0.9) else "{")
        content = case.pick(self.files)
        (root / "val" / "a.png").write_bytes(content)
        labels = mutated_bytes(self.labels, case, 2) if case.chance(0.5) else case.pick([self.labels, *self.files])
        (root / "valannot" / "a.png").write_bytes(labels)
        data = LabeledImages(root)
        image, truth = data.read(data.files("validation")[0])
        check(image.shape[:2] == truth.shape and truth.dtype == np.uint8, f"{image.shape} {truth.shape}")
        check(((truth < len(data.classes)) | (truth == 255)).all(), "a label out of range")
        return "answer"


@functools.lru_cache(64)
def packed_zeros(n: int) -> bytes:
    return zlib.compress(bytes(n))


def make(seed: int) -> Images:
    return Images()
