"""Images: what is refused, how they are scaled, and the labels of their pixels; kernels against their slow twins."""

from __future__ import annotations

import concurrent.futures
import itertools
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import twins.image as twins
from edgeperc.camera.image import (
    MAX_EDGE,
    Channels,
    ImageScaler,
    as_image,
    between,
    fill_image_labels,
    fill_scaled,
    label_pixels,
    taps,
)
from edgeperc.errors import CardMismatchError, ImageError, InferenceError
from edgeperc.types.card import InputSpec
from edgeperc.types.points import read_only
from edgeperc.types.views import CameraGeometry

SPEC = InputSpec("x", ("red", "green", "blue"), (120.0, 110.0, 100.0), (60.0, 61.0, 62.0))
PLAIN = InputSpec("x", ("red", "green", "blue"), (0.0,) * 3, (1.0,) * 3)
RNG = np.random.default_rng(0)


def noise(height: int, width: int, seed: int = 0) -> NDArray[np.uint8]:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def scaled(image: Any, width: int, height: int, spec: InputSpec = PLAIN) -> NDArray[np.float32]:
    view = CameraGeometry(width, height)
    out = np.full((len(spec.channels), height, width), np.nan, np.float32)
    ImageScaler(view, spec).fill(as_image(image), out)
    return out


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (
            np.zeros((4, 5), np.uint8),
            r"shape \(4, 5\).*if it is gray, pass np.repeat\(image\[:, :, None\], 3, axis=2\)",
        ),
        (np.zeros((4, 5, 1), np.uint8), r"if it is gray, pass np.repeat\(image, 3, axis=2\)"),
        (np.zeros((4, 5, 4), np.uint8), r"alpha, pass image\[:, :, :3\]"),
        (np.zeros((3, 4, 5), np.uint8), r"pass image.transpose\(1, 2, 0\)"),
        (np.zeros((1, 4, 5, 3), np.uint8), "one image at a time"),
        (np.zeros((4, 5, 2), np.uint8), r"expected \(H, W, 3\)"),
        (np.zeros((4, 5, 3), np.uint16), "uint16; expected uint8.*image >> 8"),
        (np.zeros((4, 5, 3), np.float32), "float32; expected uint8.*np.rint"),
        (np.zeros((4, 5, 3), np.int8), "int8; expected uint8"),
        (np.zeros((4, 5, 3), bool), "bool; expected uint8"),
        (np.zeros((4, 5, 3), object), "object; expected uint8"),
        (np.zeros((0, 5, 3), np.uint8), "image of 5 x 0; expected at least one pixel"),
        (np.zeros((5, 0, 3), np.uint8), "image of 0 x 5; expected at least one pixel"),
        (np.broadcast_to(np.zeros(3, np.uint8), (2**13, 2**14, 3)), "16384 x 8192; expected at most 67,108,864 pixels"),
        (np.broadcast_to(np.zeros(3, np.uint8), (1, MAX_EDGE + 1, 3)), "32,768 along an edge. Scale it down"),
        (np.ma.zeros((4, 5, 3), np.uint8), "masked"),
        ([[1, 2], [3]], "not an array"),
        (None, r"shape \(\)"),
        ("street.jpg", r"got 'street.jpg'; expected .*: pass edgeperc.read_image\(path\)"),
        (np.zeros(4, [("r", "u1")]), r"shape \(4,\)"),
    ],
)
def test_what_is_not_an_image_is_refused(array: Any, message: str) -> None:
    with pytest.raises(ImageError, match=message):
        as_image(array)


def test_images_are_passed_on_read_only_and_uncopied() -> None:
    image = noise(4, 5)
    passed = as_image(image)
    assert np.shares_memory(passed, image)
    assert not passed.flags.writeable
    assert image.flags.writeable
    turned = as_image(image[::-1, :, ::-1])
    assert turned.flags.c_contiguous
    np.testing.assert_array_equal(turned, image[::-1, :, ::-1])
    np.testing.assert_array_equal(as_image(image.astype(">u1")), image)


@given(st.binary(max_size=40), st.lists(st.integers(0, 4), max_size=4), st.sampled_from(["u1", "u2", "i8", "f4", "?"]))
def test_any_array_is_an_image_or_refused(content: bytes, shape: list[int], dtype: str) -> None:
    array = np.resize(np.frombuffer(content or b"\0", np.uint8), shape).astype(dtype)
    try:
        assert as_image(array).shape == array.shape
    except ImageError:
        assert array.ndim != 3 or array.shape[2] != 3 or dtype != "u1" or not array.size


SIZES = [(1, 1), (1, 7), (9, 1), (24, 32), (25, 33), (48, 64), (12, 16), (100, 30), (7, 301), (61, 47)]


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("channels", [("red", "green", "blue"), ("blue", "green", "red")])
def test_scaling_matches_its_twins(size: tuple[int, int], channels: tuple[str, ...]) -> None:
    image, view, spec = noise(*size), CameraGeometry(32, 24), InputSpec("x", channels, SPEC.mean, SPEC.std)
    out = scaled(image, 32, 24, spec)
    np.testing.assert_allclose(out, twins.scaled(image, view, spec), atol=2e-6 * 255)
    order = np.array([("red", "green", "blue").index(name) for name in channels], np.int32)
    tables = taps(size[0], 24), taps(size[1], 32), Channels(order, np.float32(spec.mean), np.float32(spec.std))
    again, same = np.empty_like(out), np.empty_like(out)
    twins.fill_scaled(image.reshape(size[0], -1), *tables, again)
    fill_scaled(as_image(image).reshape(size[0], -1), *tables, same)
    assert again.tobytes() == same.tobytes() == out.tobytes()


@given(st.integers(1, 200), st.integers(1, 200))
def test_weights_are_a_triangle_around_each_center(n_in: int, n_out: int) -> None:
    start, weights = taps(n_in, n_out)
    assert start.min() >= 0
    assert start.max() + weights.shape[1] <= n_in
    expected, got = np.zeros((2, n_out, n_in))
    for k in range(n_out):
        for j, weight in twins.taps(n_in, n_out, k).items():
            expected[k, j] = weight
        got[k, start[k] : start[k] + weights.shape[1]] = weights[k]
    np.testing.assert_allclose(got, expected, atol=1e-6)


def test_an_image_of_the_inputs_size_stays_as_it_is() -> None:
    image = noise(24, 32)
    np.testing.assert_array_equal(scaled(image, 32, 24), image.transpose(2, 0, 1))
    start, weights = taps(24, 24)
    np.testing.assert_array_equal(start, np.arange(24))
    np.testing.assert_array_equal(weights, np.ones((24, 1)))


def test_enlarging_is_bilinear_with_half_pixel_centers() -> None:
    image = np.zeros((1, 2, 3), np.uint8)
    image[0, 1] = 200
    np.testing.assert_array_equal(scaled(image, 4, 1)[0], [[0.0, 50.0, 150.0, 200.0]])


def test_shrinking_leaves_out_no_pixel() -> None:
    for at in range(12):
        image = np.zeros((1, 12, 3), np.uint8)
        image[0, at] = 255
        assert scaled(image, 3, 1)[0].sum() > 30.0


def test_a_uniform_image_stays_uniform() -> None:
    for size in SIZES:
        np.testing.assert_allclose(scaled(np.full((*size, 3), 255, np.uint8), 32, 24), 255.0, atol=1e-4)


def test_scaling_is_what_pillow_computes() -> None:
    pillow = pytest.importorskip("PIL.Image")
    for size in ((360, 480), (720, 960), (1080, 1920), (100, 91)):
        image = noise(*size)
        known = np.asarray(pillow.fromarray(image).resize((96, 72), pillow.Resampling.BILINEAR)).transpose(2, 0, 1)
        assert np.abs(scaled(image, 96, 72) - known).max() <= 1.0  # Pillow rounds to whole numbers, twice


def test_memory_layout_and_threads_do_not_matter() -> None:
    image = noise(77, 91)
    known = scaled(image, 32, 24, SPEC).tobytes()
    wide = np.zeros((154, 182, 6), np.uint8)
    wide[::2, ::2, ::2] = image
    frozen = np.frombuffer(image.tobytes(), np.uint8).reshape(image.shape)
    others: list[Any] = [np.asfortranarray(image), wide[::2, ::2, ::2], frozen, memoryview(image)]
    for other in (*others, image[:, ::-1][:, ::-1], image[:, :, ::-1][:, :, ::-1]):
        assert scaled(other, 32, 24, SPEC).tobytes() == known
    with concurrent.futures.ThreadPoolExecutor(4) as pool:
        found = pool.map(lambda _: scaled(image, 32, 24, SPEC).tobytes(), range(16))
    assert {*found} == {known}


def test_a_scaler_follows_the_size_of_its_images() -> None:
    scaler, out = ImageScaler(CameraGeometry(32, 24), SPEC), np.empty((3, 24, 32), np.float32)
    for size in (*SIZES, *SIZES[::-1]):
        scaler.fill(noise(*size), out)
        np.testing.assert_array_equal(out, scaled(noise(*size), 32, 24, SPEC))


@pytest.mark.parametrize("out", [np.empty((3, 24, 31), np.float32), np.empty((3, 24, 32)), np.empty((24, 32, 3)).T])
def test_another_buffer_is_refused(out: NDArray[Any]) -> None:
    with pytest.raises(ImageError, match="the buffer is"):
        ImageScaler(CameraGeometry(32, 24), SPEC).fill(noise(4, 4), out)


def logits_of(n_classes: int, height: int, width: int, kind: str) -> NDArray[np.float32]:
    rng = np.random.default_rng(n_classes)
    if kind == "noise":
        return rng.normal(size=(n_classes, height, width)).astype(np.float32)
    if kind == "ties":
        return rng.integers(0, 2, (n_classes, height, width)).astype(np.float32)
    areas = np.kron(rng.integers(0, n_classes, (3, 3)), np.ones((height, width), int))[::3, ::3]  # areas of one class
    return (4.0 * (np.arange(n_classes)[:, None, None] == areas) + rng.random((n_classes, height, width))).astype("f4")


@pytest.mark.parametrize("kind", ["noise", "ties", "areas"])
@pytest.mark.parametrize("grid", [(1, 1), (1, 5), (6, 8), (9, 12)])
@pytest.mark.parametrize("size", [(1, 1), (6, 8), (24, 32), (25, 31), (2, 40), (3, 3)])
def test_labels_match_their_twin(kind: str, grid: tuple[int, int], size: tuple[int, int]) -> None:
    logits = logits_of(5, *grid, kind)
    np.testing.assert_array_equal(label_pixels(logits, *size), twins.pixel_labels(logits, *size))


def test_between_centers_of_one_class_that_class_is_taken() -> None:
    """It is also the class with the largest interpolated logit."""
    logits = logits_of(11, 12, 16, "areas").astype(np.float64)
    labels = label_pixels(logits.astype(np.float32), 48, 64)
    across = np.stack(
        [np.interp((np.arange(64) + 0.5) / 4 - 0.5, np.arange(16), row) for row in logits.reshape(-1, 16)]
    )
    across = across.reshape(11, 12, 64).transpose(0, 2, 1).reshape(-1, 12)
    known = np.stack([np.interp((np.arange(48) + 0.5) / 4 - 0.5, np.arange(12), col) for col in across])
    np.testing.assert_array_equal(labels, known.reshape(11, 64, 48).argmax(axis=0).T)


def test_logits_at_the_images_size_are_their_own_best_class() -> None:
    logits = logits_of(11, 24, 32, "noise")
    np.testing.assert_array_equal(label_pixels(logits, 24, 32), logits.argmax(axis=0))


def test_every_pixel_is_written_once() -> None:
    for n_in, n_out in ((1, 1), (1, 9), (7, 3), (12, 48), (5, 301)):
        sides, weight, runs = between(n_in, n_out)
        assert runs[0] == 0
        assert runs[-1] == n_out
        assert (np.diff(runs) > 0).all()
        for begin, end in itertools.pairwise(runs):
            assert len({*map(tuple, sides[:, begin:end].T)}) == 1
        assert ((weight >= 0) & (weight < 1)).all()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_logits_that_are_not_finite_are_an_error(value: float) -> None:
    logits = logits_of(3, 4, 5, "noise")
    logits[1, 2, 3] = logits[2, 0, 0] = value
    tables = (*between(4, 8), *between(5, 10))
    assert fill_image_labels(read_only(logits), *tables, np.empty((8, 10), np.uint8)) == 2
    with pytest.raises(InferenceError, match="m: 2 of 60 values of camera_logits are not finite"):
        label_pixels(logits, 8, 10, model="m")


@pytest.mark.parametrize("shape", [(4, 5), (1, 3, 4, 5), (0, 4, 5), (3, 0, 5), (256, 1, 1)])
def test_logits_of_another_shape_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(CardMismatchError, match="camera_logits have shape"):
        label_pixels(np.zeros(shape, np.float32), 8, 10)
