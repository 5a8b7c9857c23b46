"""The calibration of a camera and a LiDAR: what is refused, KITTI's files, projection."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import twins.painting
from edgeperc import Calibration, CalibrationError, PointsError
from edgeperc.camera.calibration import fill_projected, read_kitti_calibration
from edgeperc.datasets.kitti import KittiObjects
from scenes import rotation_of

K = np.array([[700.0, 0.0, 319.5], [0.0, 710.0, 239.5], [0.0, 0.0, 1.0]])
AHEAD = np.array([[0.0, -1.0, 0.0, 0.1], [0.0, 0.0, -1.0, -0.1], [1.0, 0.0, 0.0, -0.3], [0.0, 0.0, 0.0, 1.0]])
KITTI = """P0: 721.5 0 609.6 0 0 721.5 172.9 0 0 0 1 0
P2: 721.5 0 609.6 44.86 0 721.5 172.9 0.2164 0 0 1 0.002746
R0_rect: 0.99992 0.009838 -0.007445 -0.00987 0.999942 -0.004278 0.007403 0.004352 0.999963
Tr_velo_to_cam: 0.007534 -0.999971 -0.000617 -0.004 0.014802 0.000728 -0.99989 -0.076 0.999862 0.007524 0.014808 -0.27

"""


def test_matrices_are_kept_and_cannot_be_changed() -> None:
    given_k = K.copy()
    made = Calibration(given_k, AHEAD.tolist(), np.int64(640), 480)  # type: ignore[arg-type]
    given_k[0, 0] = 1.0
    np.testing.assert_array_equal(made.K, K)
    np.testing.assert_array_equal(made.T_camera_sensor, AHEAD)
    assert (made.width, made.height) == (640, 480)
    assert type(made.width) is int
    with pytest.raises(ValueError, match="read-only"):
        made.K[0, 0] = 1.0


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda K, T: K.__setitem__((0, 0), 0.0), "focal lengths above 0"),
        (lambda K, T: K.__setitem__((1, 1), -700.0), "focal lengths above 0"),
        (lambda K, T: K.__setitem__((0, 2), 1e7), "up to 1e6 pixels"),
        (lambda K, T: K.__setitem__((0, 1), 2.0), "without skew"),
        (lambda K, T: K.__setitem__((0, 2), 640.0), "center at 640, 239.5, outside the image of 640 x 480"),
        (lambda K, T: K.__setitem__((0, 2), -20.0), "outside the image"),
        (lambda K, T: K.__setitem__((1, 2), 600.0), r"outside the image.*calibration\.resized"),
        (lambda K, T: K.__setitem__((2, 2), 2.0), "without skew"),
        (lambda K, T: K.__setitem__((0, 0), np.nan), r"K has shape \(3, 3\); expected a finite"),
        (lambda K, T: T.__setitem__((0, 3), np.inf), r"T_camera_sensor has shape \(4, 4\); expected \(4, 4\) finite"),
        (lambda K, T: T.__setitem__((0, 1), -0.9), "expected a rotation"),
        (lambda K, T: T.__setitem__((slice(0, 2), slice(0, 3)), T[[1, 0], :3]), "expected a rotation"),  # mirrored
        (lambda K, T: T.__setitem__((0, 3), 270.0), "not millimeters"),
        (lambda K, T: T.__setitem__((3, 0), 1.0), "last row"),
    ],
)
def test_what_is_no_camera_is_refused(change: Callable[[np.ndarray, np.ndarray], None], text: str) -> None:
    changed, pose = K.copy(), AHEAD.copy()
    change(changed, pose)
    with pytest.raises(CalibrationError, match=text):
        Calibration(changed, pose, 640, 480)


@pytest.mark.parametrize("matrix", [np.eye(4), [[1.0, 2.0], [3.0]], "K", None, np.eye(3)[0]])
def test_what_is_no_matrix_is_refused(matrix: object) -> None:
    with pytest.raises(CalibrationError, match="K "):
        Calibration(matrix, AHEAD, 640, 480)  # type: ignore[arg-type]


@pytest.mark.parametrize("width", [0, -1, 640.0, True, "640", None, 2**15 + 1])
def test_what_is_no_size_is_refused(width: object) -> None:
    with pytest.raises(CalibrationError, match="width"):
        Calibration(K, AHEAD, width, 480)  # type: ignore[arg-type]
    with pytest.raises(CalibrationError, match="height"):
        Calibration(K, AHEAD, 640, width)  # type: ignore[arg-type]
    with pytest.raises(CalibrationError, match="width x height is 32768 x 32768"):
        Calibration(K, AHEAD, 2**15, 2**15)


def test_projection_by_hand() -> None:
    made = Calibration(K, AHEAD, 640, 480)
    u, v, depth = made.project([[10.3, 0.1, -0.1], [20.3, 2.1, 0.9], [-5.0, 0.0, 0.0], [0.2, 0.0, 0.0]])
    np.testing.assert_allclose(depth, [10.0, 20.0, -5.3, -0.1], atol=1e-6)
    np.testing.assert_allclose(u[:2], [319.5, 319.5 - 700.0 * 2.0 / 20.0], atol=1e-4)
    np.testing.assert_allclose(v[:2], [239.5, 239.5 - 710.0 * 1.0 / 20.0], atol=1e-4)
    assert np.isnan([u[2:], v[2:]]).all()


@given(st.integers(0, 2**32 - 1))
def test_a_projected_point_comes_back(seed: int) -> None:
    """From a pixel and a depth to the point and back, for any pose."""
    rng = np.random.default_rng(seed)
    T, turn = np.eye(4), rng.normal(size=4)
    T[:3, :3], T[:3, 3] = rotation_of(*turn / np.linalg.norm(turn)), rng.uniform(-3.0, 3.0, 3)
    focal = rng.uniform(100.0, 3000.0, 2)
    made = Calibration([[focal[0], 0, 400.0], [0, focal[1], 300.0], [0, 0, 1]], T, 800, 600)  # type: ignore[arg-type]
    pixels, depth = rng.uniform(-100.0, 900.0, (50, 2)), rng.uniform(0.5, 80.0, 50)
    camera = np.column_stack([(pixels - [400.0, 300.0]) / focal, np.ones(50)]) * depth[:, None]
    points = (camera - T[:3, 3]) @ T[:3, :3]
    u, v, back = made.project(points)
    np.testing.assert_allclose(back, depth, atol=3e-5)
    # The points are rounded to float32: 4 um at 64 m.
    np.testing.assert_allclose(u, pixels[:, 0], atol=1e-4 * focal[0] / depth.min())
    np.testing.assert_allclose(v, pixels[:, 1], atol=1e-4 * focal[1] / depth.min())


@given(st.integers(0, 2**32 - 1), st.sampled_from([0, 1, 40]))
def test_projection_equals_twin(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(0.0, 30.0, (n, 4)).astype(np.float32)
    points[rng.random((n, 4)) < 0.05] = rng.choice([np.nan, np.inf, -np.inf, 3e38])
    P = K @ AHEAD[:3]
    u, v, depth = np.empty((3, n))
    fill_projected(points, P, u, v, depth)
    for fast, slow in zip((u, v, depth), twins.painting.projected(points, P), strict=True):
        np.testing.assert_allclose(fast, slow, rtol=1e-9, atol=1e-6)
    assert np.isnan(depth).tolist() == (~np.isfinite(points[:, :3]).all(axis=1)).tolist()


@pytest.mark.parametrize(
    "points", [np.zeros(3), np.zeros((4, 2)), "points", [[1.0], [2.0, 3.0]], None, np.ma.masked_all((4, 3))]
)
def test_what_are_no_points_is_refused(points: object) -> None:
    with pytest.raises(PointsError, match=r"expected \(n, [34]|got a masked array"):
        Calibration(K, AHEAD, 640, 480).project(points)  # type: ignore[arg-type]


def test_a_resized_image_shows_points_at_the_same_place() -> None:
    whole = Calibration(K, AHEAD, 640, 480)
    half = whole.resized(320, 120)
    points = np.random.default_rng(0).uniform([5.0, -5.0, -2.0], [30.0, 5.0, 2.0], (50, 3))
    (u, v, depth), (u2, v2, depth2) = whole.project(points), half.project(points)
    np.testing.assert_allclose((u2 + 0.5) / 320, (u + 0.5) / 640, atol=1e-6)
    np.testing.assert_allclose((v2 + 0.5) / 120, (v + 0.5) / 480, atol=1e-6)
    np.testing.assert_array_equal(depth, depth2)
    with pytest.raises(CalibrationError, match="height"):
        whole.resized(320, 0)
    for size in ((400, 300), (480, 640)):  # of an image that was resized or turned with the matrix of what it was
        with pytest.warns(UserWarning, match=r"far from the middle of the image of .*was it resized"):
            Calibration(K, AHEAD, *size)


def test_a_file_of_kitti(tmp_path: Path) -> None:
    path = tmp_path / "000000.txt"
    path.write_text(KITTI)
    made = Calibration.from_kitti(path, 1242, 375)
    np.testing.assert_array_equal(made.K, [[721.5, 0.0, 609.6], [0.0, 721.5, 172.9], [0.0, 0.0, 1.0]])
    T, P2 = read_kitti_calibration(path)
    points = np.random.default_rng(0).uniform([5.0, -5.0, -2.0], [30.0, 5.0, 2.0], (50, 3)).astype(np.float32)
    u, v, depth = made.project(points)
    x, y, z = P2 @ T @ np.column_stack([points, np.ones(50)]).T
    np.testing.assert_allclose([u, v, depth], [x / z, y / z, z], rtol=1e-9)
    # The files of the odometry data have the product of both matrices.
    (tmp_path / "calib.txt").write_text(
        f"{KITTI.splitlines()[1]}\nTr: {' '.join(str(each) for each in T[:3].ravel().tolist())}\n",
        "utf-8-sig",  # as editors of Windows write it
    )
    np.testing.assert_allclose(
        Calibration.from_kitti(tmp_path / "calib.txt", 1242, 375).T_camera_sensor, made.T_camera_sensor
    )


@pytest.mark.parametrize("name", ["", "calib_velo_to_cam.txt", "calib_cam_to_cam.txt"])
def test_the_calibration_of_a_raw_drive(tmp_path: Path, name: str) -> None:
    """The same camera as in the object data, by the two files of a day."""
    path = tmp_path / "000000.txt"
    path.write_text(KITTI)
    made = Calibration.from_kitti(path, 1242, 375)
    values = {key: numbers.split() for key, numbers in (line.split(":") for line in KITTI.splitlines() if line.strip())}
    T = [values["Tr_velo_to_cam"][k : k + 4] for k in (0, 4, 8)]
    folder = tmp_path / "2011_09_26"
    folder.mkdir()
    (folder / "calib_velo_to_cam.txt").write_text(
        "calib_time: 15-Mar-2012 11:37:16\n"
        f"R: {' '.join(' '.join(row[:3]) for row in T)}\nT: {' '.join(row[3] for row in T)}\n"
        "delta_f: 0 0\ndelta_c: 0 0\n"
    )
    with pytest.raises(CalibrationError, match=r"calib_cam_to_cam\.txt is missing"):
        Calibration.from_kitti(folder / name if name.startswith("calib_velo") else folder, 1242, 375)
    (folder / "calib_cam_to_cam.txt").write_text(
        "calib_time: 09-Jan-2012 13:57:47\ncorner_dist: 9.95e-02\n"
        f"R_rect_00: {' '.join(values['R0_rect'])}\nP_rect_02: {' '.join(values['P2'])}\n"
    )
    found = Calibration.from_kitti(folder / name if name else folder, 1242, 375)
    np.testing.assert_allclose(found.T_camera_sensor, made.T_camera_sensor)
    np.testing.assert_array_equal(found.K, made.K)
    (folder / "calib_cam_to_cam.txt").write_text("R_rect_00: 1 0 0 0 1 0 0 0 1\n")
    with pytest.raises(CalibrationError, match="expected R, T, R_rect_00 and P_rect_02"):
        Calibration.from_kitti(folder, 1242, 375)


def test_an_odometry_calibration_without_the_velodyne(tmp_path: Path) -> None:
    (tmp_path / "calib.txt").write_text("".join(f"P{k}: 720 0 610 45 0 720 173 0.2 0 0 1 0.003\n" for k in range(4)))
    with pytest.raises(CalibrationError, match="lacks Tr, the place of the Velodyne"):
        Calibration.from_kitti(tmp_path / "calib.txt", 1242, 375)


@pytest.mark.parametrize(
    "text",
    ["", "nonsense", KITTI.replace("P2", "P9"), KITTI.replace("44.86 ", ""), KITTI.replace("721.5", "many"),
     KITTI.replace("R0_rect", "R9"), KITTI.replace("721.5", "0"), "\xff\xfe", KITTI.replace("721.5", "nan"),
     KITTI.replace("44.86", "inf"), KITTI + "R_rect: -1e999 0 0\n", KITTI.replace("velo_to_cam: ", "velo_to_cam: -"),
     KITTI.replace("P2: ", "P2: -")],
)  # fmt: skip
def test_a_damaged_file_of_kitti_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "000000.txt"
    path.write_text(text, "latin-1")
    with pytest.raises(CalibrationError):
        read_kitti_calibration(path)
    with pytest.raises(OSError, match="missing"):
        Calibration.from_kitti(tmp_path / "missing.txt", 1242, 375)


def test_real_files_of_kitti(kitti_root: Path) -> None:
    """As the labels of the data set are projected: the boxes of objects hold the points that they should."""
    data = KittiObjects(kitti_root)
    for name in [*data.grades][:3]:
        frame = data.frame(name)
        made = Calibration.from_kitti(kitti_root / "training/calib" / f"{frame.name}.txt", 1242, 375)
        u, v, depth = made.project(frame.points)
        pixel, wanted = frame.calibration.to_image(frame.points)
        np.testing.assert_allclose(depth, wanted, atol=1e-6)
        front = wanted > 1.0
        np.testing.assert_allclose(np.column_stack([u, v])[front], pixel[front], atol=1e-3)
