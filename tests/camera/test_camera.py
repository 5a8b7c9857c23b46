"""A camera model in a perceiver: alone, beside LiDAR models, and in files that cannot be read."""

from __future__ import annotations

import concurrent.futures
import io
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tiny_camera
from numpy.typing import NDArray
from tiny_camera import png_file

import edgeperc
from edgeperc import (
    CardMismatchError,
    ImageError,
    ImageLabels,
    InferenceError,
    MissingExtraError,
    OptionError,
    Perceiver,
    PointsError,
)
from edgeperc.camera.image import MAX_EDGE
from scenes import urban

RED, GREEN, BLUE = (200, 10, 20), (10, 200, 20), (20, 10, 200)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_camera.write_camera(tmp_path_factory.mktemp("models"))


@pytest.fixture(scope="module")
def perceive(model: Path) -> Perceiver:
    return Perceiver(model, provider="cpu", n_threads=1)


@pytest.fixture(scope="module")
def image() -> NDArray[np.uint8]:
    """Blue above, red below, green in the lower right."""
    image = np.full((48, 64, 3), BLUE, np.uint8)
    image[24:] = RED
    image[24:, 48:] = GREEN
    return image


def test_each_pixel_has_a_class(perceive: Perceiver, image: NDArray[np.uint8]) -> None:
    perception = perceive(image=image, stamp_s=3.5)
    found = perception.require_image()
    assert found.labels.shape == (48, 64)
    assert found.labels.dtype == np.uint8
    assert found.classes == ("Sky", "Road", "Tree")
    np.testing.assert_array_equal(found.labels[:20], 0)
    np.testing.assert_array_equal(found.labels[28:, :44], 1)
    np.testing.assert_array_equal(found.labels[28:, 52:], 2)
    np.testing.assert_array_equal(found.drivable, found.labels == 1)
    assert found.drivable_share == pytest.approx(24 * 48 / (48 * 64), abs=0.02)
    assert sum(found.counts().values()) == 48 * 64
    assert (perception.points, perception.top_view, perception.boxes) == (None, None, ())
    assert (perception.n_points, perception.stamp_s, perception.fitness) == (0, 3.5, ())
    assert perception.providers == {"tinycam": "tinycam fp32, CPUExecutionProvider"}
    assert min(perception.stage_ms[stage] for stage in ("project", "infer", "decode")) > 0.0
    assert perception.stage_ms["refine"] == 0.0


def test_classes_of_roads_are_drivable() -> None:
    labels = np.array([[0, 1], [2, 3]], np.uint8)
    assert ImageLabels(labels, ("Sky", "ROAD", "Tree", "drivable")).drivable.tolist() == [[False, True], [False, True]]
    assert ImageLabels(labels, ("a", "b", "c", "d")).drivable_share == 0.0


def test_pixels_are_counted_in_parts() -> None:
    labels = np.resize(np.uint8([0, 1, 1, 2]), (3, 2**20))
    assert ImageLabels(labels, ("a", "b", "c", "d")).counts() == {"a": 786432, "b": 1572864, "c": 786432, "d": 0}


@pytest.mark.parametrize("size", [(1, 1), (1, 900), (24, 32), (25, 31), (700, 1)])
def test_any_size_of_image(perceive: Perceiver, size: tuple[int, int]) -> None:
    found = perceive(image=np.broadcast_to(np.uint8(RED), (*size, 3))).require_image()
    np.testing.assert_array_equal(found.labels, np.ones(size, np.uint8))


def test_a_gigantic_image(perceive: Perceiver) -> None:
    """As large as is allowed along an edge; one pixel more is refused before anything is allocated."""
    found = perceive(image=np.broadcast_to(np.uint8(GREEN), (64, MAX_EDGE, 3))).require_image()
    assert (found.labels == 2).all()
    with pytest.raises(ImageError, match="Scale it down"):
        perceive(image=np.broadcast_to(np.uint8(GREEN), (MAX_EDGE, MAX_EDGE, 3)))
    with pytest.raises(ImageError, match=r"got 'street\.jpg'"):
        perceive(image="street.jpg")


def test_results_own_their_arrays(perceive: Perceiver, image: NDArray[np.uint8]) -> None:
    first = perceive(image=image).require_image()
    kept = first.labels.copy()
    perceive(image=255 - image)
    np.testing.assert_array_equal(first.labels, kept)


def test_one_perceiver_in_threads_gives_the_same_result(perceive: Perceiver, image: NDArray[np.uint8]) -> None:
    images = [image, image[::-1], image[:, ::-1], image[::2, ::2]]

    def labels(k: int) -> bytes:
        return perceive(image=images[k % 4]).require_image().labels.tobytes()

    known = [labels(k) for k in range(4)]
    with concurrent.futures.ThreadPoolExecutor(4) as pool:
        assert [*pool.map(labels, range(40))] == known * 10


def test_scan_and_image_in_one_call(model: Path, perceive: Perceiver, image: NDArray[np.uint8]) -> None:
    """Each part is what it is without the other."""
    options: dict[str, Any] = {"provider": "cpu", "n_threads": 1, "on_mismatch": "ignore"}
    scan = urban(8).points
    alone = Perceiver(["pointseg"], **options)(scan)
    both = Perceiver(["pointseg", model], **options)
    assert [card.name for card in both.cards] == ["pointseg", "tinycam"]
    found, of_image = both(scan, image=image), perceive(image=image)
    np.testing.assert_array_equal(found.require_points().labels, alone.require_points().labels)
    np.testing.assert_array_equal(found.require_image().labels, of_image.require_image().labels)
    assert found.boxes == alone.boxes
    assert alone.image is None
    assert [*found.providers] == ["pointseg", "tinycam"]
    with pytest.raises(ImageError, match="got no image, and tinycam needs one; pass image="):
        both(scan)
    with pytest.raises(PointsError, match="got no points, and pointseg needs a scan; pass points"):
        both(image=image)
    assert both(np.empty((0, 4), np.float32), image=image).image is not None


def test_an_input_without_a_model_is_refused(perceive: Perceiver, image: NDArray[np.uint8]) -> None:
    with pytest.raises(PointsError, match="the only model is of a camera"):
        perceive(np.zeros((4, 4), np.float32), image=image)
    with pytest.raises(ImageError, match="got no image"):
        perceive()
    lidar = Perceiver("pointseg", provider="cpu", n_threads=1)
    with pytest.raises(ImageError, match=r"none of the models is of a camera .pointseg.; add one such as camseg"):
        lidar(np.zeros((4, 4), np.float32), image=image)
    for bad in (None, "a"):
        with pytest.raises(PointsError):
            lidar(bad)  # type: ignore[arg-type]


def test_one_camera_model_a_perceiver(model: Path) -> None:
    with pytest.raises(OptionError, match=r"'camera', 'camera'.; expected at most one a view"):
        Perceiver([model, model], provider="cpu")
    with pytest.raises(OptionError, match="add a range-image model"):
        Perceiver(model, provider="cpu", boxes_from="clusters")


def test_logits_that_are_not_finite_are_an_error(model: Path, image: NDArray[np.uint8]) -> None:
    perceive = Perceiver(model, provider="cpu", n_threads=1)
    session = perceive.sessions[0]
    session.outputs["camera_logits"][:] = np.nan
    real, session.inference = session.inference, type("Idle", (), {"run_with_iobinding": lambda *_: None})()
    with pytest.raises(InferenceError, match=r"tinycam: .* of camera_logits are not finite"):
        perceive(image=image)
    session.inference = real
    assert perceive(image=image).image is not None


def test_logits_must_divide_the_view(tmp_path: Path) -> None:
    card = replace(tiny_camera.camera_card(30, 24, 6), golden=None)
    path = tmp_path / "odd.onnx"
    path.write_bytes(tiny_camera.camera_model(replace(card, view=replace(card.view, width=32)), 6))
    with pytest.raises(CardMismatchError, match="expected rows and columns that divide the view's 24 and 32"):
        Perceiver(path, provider="cpu")


def test_the_card_decides_the_order_of_colors(tmp_path: Path, image: NDArray[np.uint8], perceive: Perceiver) -> None:
    card = tiny_camera.camera_card()
    turned = replace(card, name="bgr", input=replace(card.input, channels=("blue", "green", "red")))
    path = tmp_path / "bgr.onnx"
    path.write_bytes(tiny_camera.camera_model(turned))
    found, known = Perceiver(path, provider="cpu")(image=image[:, :, ::-1]), perceive(image=image)
    np.testing.assert_array_equal(found.require_image().labels, known.require_image().labels)


@pytest.mark.skipif(os.name != "posix", reason="forks")
def test_a_forked_child_perceives_images(model: Path) -> None:
    code = """
import os, sys, numpy as np, edgeperc
image = np.random.default_rng(0).integers(0, 256, (40, 50, 3), dtype=np.uint8)
for n_threads in (1, 2):
    perceive = edgeperc.Perceiver(sys.argv[1], provider="cpu", n_threads=n_threads)
    known = perceive(image=image).image.labels
    child = os.fork()
    if child == 0:
        try:
            print("equal" if (perceive(image=image).image.labels == known).all() else "different")
        except edgeperc.InferenceError as error:
            print(error)
        sys.stdout.flush()
        os._exit(0)
    os.waitpid(child, 0)
"""
    done = subprocess.run([sys.executable, "-c", code, model], capture_output=True, text=True)
    first, second = done.stdout.splitlines()
    assert first == "equal", done.stderr
    assert "construct the Perceiver in the process that calls it" in second, done.stderr


def saved(image: Any, kind: str, **options: Any) -> bytes:
    stream = io.BytesIO()
    image.save(stream, kind, **options)
    return stream.getvalue()


@pytest.mark.parametrize("kind", ["PNG", "BMP", "PPM", "JPEG", "WEBP"])
def test_files_are_read(tmp_path: Path, image: NDArray[np.uint8], kind: str) -> None:
    pillow = pytest.importorskip("PIL.Image")
    path = tmp_path / "image.bin"  # the content decides
    path.write_bytes(saved(pillow.fromarray(image), kind, **({"lossless": True} if kind == "WEBP" else {})))
    found = edgeperc.read_image(path)
    assert (found.dtype, found.flags.c_contiguous, found.flags.writeable) == (np.uint8, True, True)
    if kind == "JPEG":
        assert np.abs(found.astype(int) - image).mean() < 10.0
    else:
        np.testing.assert_array_equal(found, image)


def test_gray_palette_and_opaque_alpha_are_converted(tmp_path: Path, image: NDArray[np.uint8]) -> None:
    pillow = pytest.importorskip("PIL.Image")
    path, picture = tmp_path / "image.png", pillow.fromarray(image)
    path.write_bytes(saved(picture.convert("L"), "PNG"))
    gray = np.asarray(picture.convert("L"))
    np.testing.assert_array_equal(edgeperc.read_image(path), np.repeat(gray[:, :, None], 3, axis=2))
    path.write_bytes(saved(picture.quantize(8), "PNG"))
    np.testing.assert_array_equal(edgeperc.read_image(str(path)), image)
    opaque = picture.convert("RGBA")
    path.write_bytes(saved(opaque, "PNG"))
    np.testing.assert_array_equal(edgeperc.read_image(path), image)
    opaque.putpixel((3, 4), (1, 2, 3, 254))
    path.write_bytes(saved(opaque, "PNG"))
    with pytest.raises(ImageError, match="1 of 3072 pixels are transparent"):
        edgeperc.read_image(path)
    path.write_bytes(saved(picture.quantize(8), "PNG", transparency=0))
    with pytest.raises(ImageError, match="are transparent"):
        edgeperc.read_image(path)


def test_images_are_turned_as_exif_says(tmp_path: Path, image: NDArray[np.uint8]) -> None:
    pillow = pytest.importorskip("PIL.Image")
    turns = {1: image, 3: image[::-1, ::-1], 6: np.rot90(image, -1), 8: np.rot90(image), 2: image[:, ::-1]}
    for orientation, known in turns.items():
        exif = pillow.Exif()
        exif[0x0112] = orientation
        path = tmp_path / f"{orientation}.png"
        path.write_bytes(saved(pillow.fromarray(image), "PNG", exif=exif))
        np.testing.assert_array_equal(edgeperc.read_image(path), known)


def test_files_that_are_not_images(tmp_path: Path, image: NDArray[np.uint8]) -> None:
    pillow = pytest.importorskip("PIL.Image")
    picture = pillow.fromarray(image)
    whole = saved(picture, "JPEG")
    rows = bytes(4 * (1 + 5 * 6))
    files = {
        "empty": (b"", "the file has 0 bytes"),
        "text": (b"not an image" * 9, "cannot be read: it is damaged, cut short or of another format"),
        "truncated": (whole[: len(whole) // 2], "cannot be read.*[Tt]runcated"),
        "truncated png": (saved(picture, "PNG")[:90], "cannot be read"),
        "gif": (saved(picture.quantize(8), "GIF"), "another format than BMP"),
        "postscript": (b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n%%EndComments\n", "another format than BMP"),
        "16 bits of gray": (saved(pillow.fromarray(np.zeros((4, 5), np.uint16)), "PNG"), "more than 8 bits a channel"),
        "16 bits of color": (png_file(5, 4, 16, 2, rows), "more than 8 bits a channel"),
        "16 bits of color as PPM": (b"P6\n2 1\n65535\n" + bytes(12), "more than 8 bits a channel"),
        "12 bits of color as text": (b"P3\n1 1\n4095\n0 900 4095\n", "more than 8 bits a channel"),
        "bits": (saved(picture.convert("1"), "PNG"), "of mode 1; expected colors"),
        "cmyk": (saved(picture.convert("CMYK"), "JPEG"), "of mode CMYK; expected colors"),
        "tiff": (saved(picture, "TIFF"), "another format than BMP"),
        "two": (saved(picture, "PNG", save_all=True, append_images=[picture.rotate(9)]), "the file holds 2 images"),
        "gigantic": (png_file(9000, 9000, 8, 2, b""), "9000 x 9000; expected at most 67,108,864 pixels"),
        "more than Pillow opens": (png_file(60_000, 60_000, 8, 2, b""), "3600000000 pixels"),
        "long": (png_file(MAX_EDGE + 1, 1, 8, 2, b""), "expected at most 67,108,864 pixels and 32,768 along an edge"),
        "no pixels": (png_file(0, 5, 8, 2, b""), "cannot be read"),
    }
    for name, (content, message) in files.items():
        path = tmp_path / name
        path.write_bytes(content)
        with pytest.raises(ImageError, match=message) as caught:
            edgeperc.read_image(path)
        assert str(path) in str(caught.value)
    for missing in (tmp_path / "none", tmp_path, "a\0b"):
        with pytest.raises(ImageError, match=r"no such file|cannot be read|expected a path without a null character"):
            edgeperc.read_image(missing)


def test_without_pillow_the_error_names_the_extra(tmp_path: Path) -> None:
    code = (
        "import sys; sys.modules['PIL.Image'] = None\nimport edgeperc\n"
        "try:\n    edgeperc.read_image('a.jpg')\nexcept edgeperc.MissingExtraError as error:\n    print(error)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == (
        "Reading an image needs pillow, which is not installed. Run: pip install 'edgeperc[camera]'"
    ), done.stderr
    assert issubclass(MissingExtraError, ImportError)
