"""Images on the command line: run, info, eval."""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tiny_camera

from cli_helpers import Shell, run, write_scan

pillow = pytest.importorskip("PIL.Image")

import edgeperc
from edgeperc.cli.scans import check_pairs
from edgeperc.errors import ImageError
from edgeperc.simulation.camera import CAMERA_CLASSES
from edgeperc.types.perception import ImageLabels, Perception
from edgeperc.view import draw_image
from edgeperc.view.colors import CLASS_COLORS, SCENE_COLORS, color_of

CPU = ("--provider", "cpu", "--threads", "1")


@pytest.fixture
def model(tmp_path: Path) -> Path:
    return tiny_camera.write_camera(tmp_path)


def write_image(path: Path, color: tuple[int, int, int] = (200, 10, 20), width: int = 40, height: int = 30) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    pillow.fromarray(np.full((height, width, 3), color, np.uint8)).save(path)
    return path


def test_run_prints_a_line_an_image(tmp_path: Path, model: Path, shell: Shell) -> None:
    red, green = write_image(tmp_path / "red.png"), write_image(tmp_path / "green.JPG", (10, 200, 20), 64, 48)
    first, second = shell.out("run", red, green, "--model", model, *CPU).splitlines()
    assert first.startswith(f"{red}  40 x 30 pixels: Road 100.0 %  ")
    assert second.startswith(f"{green}  64 x 48 pixels: Tree 100.0 %  ")
    assert first.endswith(" ms")


def test_a_folder_of_images_is_sorted(tmp_path: Path, model: Path, shell: Shell) -> None:
    for name in "cab":
        write_image(tmp_path / "images" / f"{name}.png")
    (tmp_path / "images" / "notes.txt").write_text("no image")
    records = shell.records("run", tmp_path / "images", "--model", model, *CPU)
    files = [record["image"]["file"] for record in records]
    assert files == [str(tmp_path / "images" / f"{name}.png") for name in "abc"]


def test_json_and_picture(tmp_path: Path, model: Path, shell: Shell) -> None:
    pytest.importorskip("matplotlib")
    image, out = write_image(tmp_path / "street.png"), tmp_path / "out"
    (record,) = shell.records("run", image, "--model", model, *CPU, "--png", "--out", out)
    counts = {"Sky": 0, "Road": 1200, "Tree": 0}
    seen = {"width": 40, "height": 30, "drivable_share": 1.0, "pixel_counts": counts}
    assert record["image"] == {"file": str(image), **seen}
    assert (record["scan"], record["boxes"], record["point_counts"]) == (None, [], None)
    assert [file.name for file in out.iterdir()] == ["street.png"]
    with pillow.open(out / "street.png") as picture:
        assert picture.size[0] == 1600


def test_an_image_with_its_scan(tmp_path: Path, model: Path, shell: Shell) -> None:
    pytest.importorskip("matplotlib")
    images = [write_image(tmp_path / f"{k}.png") for k in range(2)]
    scans = [write_scan(tmp_path / f"{k}.bin", 40 + k) for k in range(2)]
    options = ("--model", model, "--model", "pointseg", *CPU, "--on-mismatch", "ignore")
    out = tmp_path / "out"
    first, second = shell.records("run", *images, "--scan", *scans, *options, "--labels", "--out", out)
    assert (first["scan"], first["image"]["file"], first["n_points"]) == (str(scans[0]), str(images[0]), 40)
    assert (second["n_points"], second["image"]["drivable_share"]) == (41, 1.0)
    assert {file.name for file in out.iterdir()} == {"0.label", "1.label"}
    line = shell.out("run", images[0], "--scan", scans[0], *options, "--png", "--out", out)
    assert {file.name for file in out.iterdir()} == {"0.label", "1.label", "0.png", "0_scan.png"}
    assert "40 x 30 pixels: Road 100.0 %  40 points" in line


def test_what_is_written_of_a_scan_with_its_image_is_of_the_scan(tmp_path: Path, model: Path, shell: Shell) -> None:
    image, scan = write_image(tmp_path / "image_2/0.png"), write_scan(tmp_path / "0.bin")
    before, out = scan.read_bytes(), tmp_path / "out"
    options = ("--model", model, "--model", "pointseg", *CPU, "--on-mismatch", "ignore")
    labels = ("--labels-for", "labelcloud", "--out", out)
    assert run("run", image, "--scan", scan, *options, "--movable", "--static", out, *labels) == 0
    assert json.loads((out / "labels/0.json").read_text())["path"] == str(scan)
    assert (out / "0.bin").stat().st_size
    said = shell.err("run", image, "--scan", scan, *options, "--movable", "--static", tmp_path, code=1)
    assert "is the scan itself" in said
    assert scan.read_bytes() == before


def test_times_in_names_tell_that_a_pair_is_none() -> None:
    images, scans = ([Path(f"{1_700_000_000 + k / 10 + at:.2f}.x") for k in range(5)] for at in (0.02, 0.0))
    check_pairs(argparse.Namespace(), images[:4], scans[:4])
    with pytest.warns(UserWarning, match=f"{images[1]} gets {scans[2]}, and .* {scans[1]} is nearer"):
        check_pairs(argparse.Namespace(), images[:4], scans[1:])


def test_each_image_may_have_its_calibration(tmp_path: Path, model: Path, shell: Shell) -> None:
    pytest.importorskip("matplotlib")
    image, scan = write_image(tmp_path / "a.png"), write_scan(tmp_path / "0.bin", 4000)
    (tmp_path / "calib").mkdir()
    calibration = "P2: 30 0 20 0 0 30 15 0 0 0 1 0\nR0_rect: 1 0 0 0 1 0 0 0 1\n"
    calibration += "Tr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0\n"
    (tmp_path / "calib/0.txt").write_text(calibration)
    out = tmp_path / "out"
    wanted = ("--calib", tmp_path / "calib", "--png", "--out", out)
    options = ("--model", model, "--model", "pointseg", *CPU, "--on-mismatch", "ignore", "--sensor", "hdl-64e")
    for kind in ("kitti", "labelcloud"):  # whose labels need no camera
        assert run("run", image, "--scan", scan, *options, *wanted, "--labels-for", kind) == 0
    assert (out / "a_both.png").exists()
    assert (out / "calib/0.txt").read_text() == calibration
    other = write_image(tmp_path / "image_00/data/a.png")
    said = shell.err("run", other, "--scan", scan, *options, *wanted, code=2)
    assert f"left color camera, and {other} is of another one" in said


def test_an_image_that_fails_leaves_the_others(tmp_path: Path, model: Path, shell: Shell) -> None:
    bad, good = tmp_path / "bad.jpg", write_image(tmp_path / "good.png")
    bad.write_bytes(b"\xff\xd8\xff")
    printed = shell.both("run", bad, good, tmp_path / "none.png", "--model", model, *CPU, "--json", code=1)
    failed, fine, missing = map(json.loads, printed.out.splitlines())
    assert failed["image"] == {"file": str(bad)}
    assert "cannot be read" in failed["error"]
    assert fine["image"]["drivable_share"] == 1.0
    assert "no such file" in missing["error"]
    assert "3 images, 2 failed" in printed.err


def test_wrong_usage(tmp_path: Path, model: Path, shell: Shell) -> None:
    image, scan = write_image(tmp_path / "a.png"), write_scan(tmp_path / "b.bin")
    others = {"a.mp4": b"\0\0\0\x20ftypisom", "a.tif": b"II*\0", "a.las": b"LASF"}
    film, tiff, las = (tmp_path / name for name in others)
    for name, head in others.items():
        (tmp_path / name).write_bytes(head + bytes(400))
    out, photos = ("--out", tmp_path / "out"), tmp_path / "photos"
    photos.mkdir()
    write_image(photos / "b.jpg")
    lost = {write_image(tmp_path / f"image_2/{k}.png").parent for k in (0, 2, 10)}
    there = [write_scan(tmp_path / f"velodyne/{k}.bin") for k in (0, 1, 2)]
    twin = write_image(tmp_path / "a_scan.png")
    for arguments, said in (
        ((image, "--scan", scan, scan.with_name("c.bin"), "--model", model), "--scan: 2 scans for 1 image"),
        ((scan, "--scan", scan), "--scan: 1 scan for 0 images"),
        ((image, twin, "--scan", scan, scan), "1 scan for 2 images; expected as many, each once: run one camera"),
        ((*lost, "--scan", there[0].parent), f"image_2/2.png would get {there[1]}, and {there[2]} has its name"),
        ((image, "--labels", *out), "--labels needs --scan for images"),
        ((image, "--track"), "--track needs --scan for images"),
        ((image, "--live"), f"--live needs scans, and {image} is an image"),
        ((image, "--deskew", "--track"), "--deskew needs scans"),
        ((image, "--png", "--out", tmp_path, "--model", model), "is one of the images and would be overwritten"),
        ((image, twin, "--scan", scan, las, "--png", *out, "--model", model), f"would both be {out[1] / 'a_scan.png'}"),
        ((photos, "--png", "--out", photos, "--model", model), "would be read with the images of its folder"),
    ):
        assert said in shell.err("run", *arguments)
    for arguments, said in (
        ((image, scan), "b.bin is not an image, and"),
        ((image, "--model", "pointseg"), "images need a camera model; add --model camseg"),
        ((image, "--model", "pointseg", "--model", model), "images alone need a camera model alone"),
        ((scan, "--model", model), "scans without images need no camera model"),
        ((film, "--model", model), "a.mp4: this is a film"),
        ((tiff, "--model", model), "a.tif: this is a TIFF or GIF image"),
        ((las, "--model", model), "a.las: this is a LAS or LAZ file"),
    ):
        assert said in shell.err("run", *arguments, *CPU)
    assert not (tmp_path / "out").exists()


def test_info_of_images_and_camera_models(tmp_path: Path, model: Path, shell: Shell) -> None:
    image = write_image(tmp_path / "a.png")
    said = shell.out("info", image, model)
    assert "40 x 30 pixels, upright" in said
    assert "red 200, green 10, blue 20 of 255" in said
    assert "camera: 32 x 24 pixels, images are stretched to it" in said
    assert "a class for every pixel of a camera's image (3 classes)" in said
    assert shell.records("info", image)[0]["width"] == 40
    assert run("info", tmp_path / "none.jpg") == 1


def test_pictures_of_images(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    labels = np.arange(12, dtype=np.uint8).reshape(3, 4) % 3
    labels[0, 0] = 255  # of an image that somebody labeled
    perception = Perception(
        0, 0, None, None, (), {"infer": 1.0}, {"m": "m"}, (), None, image=ImageLabels(labels, tuple("abc"))
    )
    image = np.zeros((3, 4, 3), np.uint8)
    png = draw_image(perception, image, tmp_path / "a.png", title="a street")
    assert (tmp_path / "a.png").read_bytes() == png
    tall = replace(perception, image=ImageLabels(np.zeros((500, 2), np.uint8), ("a", "b")))
    assert draw_image(tall, np.zeros((500, 2, 3), np.uint8)).startswith(b"\x89PNG")
    with pytest.raises(ImageError, match="expected what was perceived"):
        draw_image(perception, np.zeros((3, 5, 3), np.uint8))
    with pytest.raises(ImageError, match="of a perception of no image"):
        draw_image(replace(perception, image=None), image)


def test_classes_of_images_have_colors() -> None:
    colors = [color_of(name) for name in CAMERA_CLASSES]
    assert len({*colors}) == len(CAMERA_CLASSES) == 11
    assert color_of("Car") == CLASS_COLORS["car"]
    assert not SCENE_COLORS.keys() & CLASS_COLORS.keys()
    assert edgeperc.__all__
