"""Captures name their sensor, or an error lists the choices."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from capture_writers import vlp16_packets, write_clouds, write_pcap
from hypothesis import example, given, settings
from hypothesis import strategies as st
from test_captures import POINTS, write_bag1, write_bag2, write_mcap
from test_captures import ouster as ouster

from checkout import printed
from cli_helpers import Shell, run
from edgeperc.errors import EdgepercError, PointsError, SensorError
from edgeperc.live import stream
from edgeperc.readers.captures import known_sensor, read_scans, sensor_of
from edgeperc.readers.identify import KnownSensor, of_cloud, of_metadata
from edgeperc.types.sensor import SENSORS, SensorProfile, get_sensor
from strategies import JSON

pytestmark = pytest.mark.usefixtures("in_this_process")


def velodyne(product: int, mode: int = 0x37, flags: Sequence[bytes] = (b"\xff\xee",)) -> list[bytes]:
    """Packets of a Velodyne whose blocks have these flags in turn."""
    found = []
    for packet in vlp16_packets(0.1):
        changed = bytearray(packet)
        for k in range(12):
            changed[100 * k : 100 * k + 2] = flags[k % len(flags)]
        changed[-2:] = bytes([mode, product])
        found.append(bytes(changed))
    return found


@pytest.mark.parametrize(
    ("packets", "name"),
    [
        (velodyne(0x21), "hdl-32e"),
        (velodyne(0x22, 0x39), "vlp-16"),
        (velodyne(0x24), "vlp-16-hi-res"),
        (velodyne(0x28), "vlp-32c"),
        (velodyne(0xA1, 0x37, [b"\xff\xee", b"\xff\xdd", b"\xff\xcc", b"\xff\xbb"]), "vls-128"),
        (velodyne(0x05, 0x48, [b"\xff\xee", b"\xff\xdd"]), "hdl-64e"),
    ],
)
def test_packets_of_a_velodyne(tmp_path: Path, packets: list[bytes], name: str) -> None:
    gps = b"$GPRMC".ljust(512, b"\0")
    path = write_pcap(tmp_path / "any.pcap", [gps, *packets])
    assert sensor_of(path) is SENSORS[name]
    assert known_sensor(path) == KnownSensor(SENSORS[name], "named by the packets")


@pytest.mark.parametrize(
    ("packets", "error"),
    [
        (velodyne(0, 0), "do not name the model"),
        (velodyne(0x22, 0x00), "do not name the model"),
        (velodyne(0x77), "do not name the model"),
        (velodyne(0x23), "Velodyne VLP-32A or VLP-32B, of which no profile"),
        (velodyne(0x63), "Velodyne VLS-128"),
        (velodyne(0x28, 0x37, [b"\xff\xee", b"\xff\xdd", b"\xff\xcc", b"\xff\xbb"]), "Velodyne VLS-128"),
        ([*velodyne(0x21), *velodyne(0x22)], "Velodyne hdl-32e, vlp-16"),
    ],
)
def test_a_velodyne_that_is_unknown(tmp_path: Path, packets: list[bytes], error: str) -> None:
    path = write_pcap(tmp_path / "any.pcap", packets)
    with pytest.raises(SensorError, match=rf"any\.pcap: .*{error}") as caught:
        sensor_of(path)
    assert all(name in str(caught.value) for name in SENSORS)
    assert "--sensor" in str(caught.value)


def test_packets_that_begin_like_a_hesais_by_chance(ouster: Path, tmp_path: Path) -> None:
    content = (ouster / "sphere.pcap").read_bytes()
    path = tmp_path / "sphere.pcap"
    path.with_suffix(".json").write_bytes((ouster / "sphere.json").read_bytes())
    first = bytearray(content)
    first[24 + 16 + 42 : 24 + 16 + 44] = b"\xee\xff"
    path.write_bytes(first)
    assert sensor_of(path).n_beams == 64


def metadata(line: str | None, angles: Any, columns: int = 2048) -> dict[str, Any]:
    n = len(angles)
    return {
        "sensor_info": {} if line is None else {"prod_line": line},
        "beam_intrinsics": {"beam_altitude_angles": angles, "beam_azimuth_angles": [0.0] * n},
        "lidar_data_format": {"pixels_per_column": n, "columns_per_frame": columns, "column_window": [0, columns - 1]},
    }


def spread(half_deg: float, n: int) -> list[float]:
    return [round(float(e), 3) for e in np.linspace(half_deg, -half_deg - 0.01, n)]


@pytest.mark.parametrize(
    ("line", "half_deg", "n", "name"),
    [
        ("OS-0-128", 45.3, 128, "os0-128"),
        ("OS-1-64", 16.6, 64, "os1-64"),
        ("OS-2-64-BH02", 11.0, 64, "os2-64"),
        ("OS-1-16-A1", 16.6, 16, "os1-16"),
        ("OS2-128", 11.25, 128, "os2-128"),
        (None, 16.6, 64, "os1-64"),
        (None, 11.3, 128, "os2-128"),
        (None, 45.0, 32, "os0-32"),
    ],
)
def test_metadata_of_an_ouster(line: str | None, half_deg: float, n: int, name: str) -> None:
    angles = spread(half_deg, n)
    profile, because = of_metadata(metadata(line, angles), "the metadata x.json")
    assert (profile.name, profile.elevations_deg, profile.columns) == (name, tuple(angles), 2048)
    assert profile.remission_range == (0.0, 255.0)
    assert "x.json" in because
    if line is not None:
        # Early firmware has one level less.
        flat = {"prod_line": line, **metadata(line, angles)["beam_intrinsics"], "lidar_mode": "512x10"}
        legacy, _ = of_metadata(flat, "x")
        assert (legacy.name, legacy.elevations_deg, legacy.columns) == (name, tuple(angles), 512)


def test_metadata_without_usable_beam_angles() -> None:
    profile, because = of_metadata(metadata("OS-0-128", [0.0] * 128), "x")
    assert profile.elevations_deg == get_sensor("os0-128").elevations_deg
    assert "its beam angles" not in because


@pytest.mark.parametrize(
    ("content", "error"),
    [
        ({}, "names no sensor"),
        (metadata("OS-DOME-128", spread(90.0, 128)), "'OS-DOME-128', of which no profile is built in"),
        (metadata(None, spread(30.0, 64)), "span 60.0 deg, as no Ouster's"),
        (metadata("OS-1-20", [0.0] * 20), "no usable beam angles"),
        (metadata(None, [0.0] * 64), "names no sensor"),
    ],
)
def test_metadata_that_names_no_known_sensor(content: dict[str, Any], error: str) -> None:
    with pytest.raises(SensorError, match=error) as caught:
        of_metadata(content, "x")
    assert "os1-64" in str(caught.value)


KEYS = ("sensor_info", "prod_line", "beam_intrinsics", "beam_altitude_angles", "lidar_data_format", "lidar_mode")


@settings(max_examples=150)
@given(st.dictionaries(st.sampled_from([*KEYS, "config_params", "pixels_per_column"]), JSON) | JSON)
@example({"beam_altitude_angles": [-(2**63) - 1]})
def test_any_metadata_is_known_or_a_typed_error(content: Any) -> None:
    with suppress(EdgepercError):
        assert isinstance(of_metadata(content, "x").profile, SensorProfile)


def test_a_capture_of_an_ouster(ouster: Path, tmp_path: Path) -> None:
    """Packets and OSF, with the serial number that selects a sensor."""
    info = json.loads((ouster / "sphere.json").read_text())
    angles = tuple(info["beam_intrinsics"]["beam_altitude_angles"])
    for name in ("sphere.pcap", "sphere.osf"):
        for topic in (None, "991"):
            profile = sensor_of(ouster / name, topic=topic)
            assert (profile.name, profile.columns) == ("os1-64", 512)
            np.testing.assert_allclose(profile.elevations_deg, angles, atol=1e-9)
    with pytest.raises(PointsError, match=r"no LiDAR '17'; there are 991"):
        sensor_of(ouster / "sphere.osf", topic="17")


def test_packets_are_read_without_native_libraries(ouster: Path, tmp_path: Path) -> None:
    write_pcap(tmp_path / "vlp16.pcap", vlp16_packets(0.1))
    code = (
        "import sys; from edgeperc.readers.captures import sensor_of\n"
        "print(*[sensor_of(path).name for path in sys.argv[1:]])\n"
        "sys.exit(f'{sys.modules.keys()}' if {'ouster', 'velodyne_decoder', 'rosbags'} & sys.modules.keys() else 0)"
    )
    files = [tmp_path / "vlp16.pcap", ouster / "sphere.pcap", ouster / "sphere.osf"]
    assert printed(code, *files).split() == ["vlp-16", "os1-64", "os1-64"]


OUSTER_FIELDS = ["x", "y", "z", "intensity", "t", "reflectivity", "ring", "ambient", "range"]
VELODYNE_FIELDS = ["x", "y", "z", "intensity", "ring", "time"]


def described(
    fields: list[str], frame: str = "", topic: str = "/points", rings: Sequence[float | None] = ()
) -> dict[str, Any]:
    return {"topic": topic, "frame": frame, "fields": fields, "elevations_deg": list(rings)}


def beams(name: str, from_top: bool = True) -> list[float]:
    angles = list(get_sensor(name).elevations_deg)
    return angles if from_top else angles[::-1]


RINGED = [name for name, profile in SENSORS.items() if profile.pattern is None and not name.startswith("rs-")]


@pytest.mark.parametrize("name", RINGED)
@pytest.mark.parametrize("from_top", [True, False])
def test_clouds_are_recognized_by_their_rings(name: str, from_top: bool) -> None:
    frames = {"os": "os_sensor", "hd": "velodyne", "vl": "velodyne", "he": "rslidar", "ru": "rslidar"}
    frame = frames.get(name[:2], "hesai_lidar")
    fields = OUSTER_FIELDS if name.startswith("os") else VELODYNE_FIELDS
    rings: list[float | None] = [*(np.array(beams(name, from_top)) + np.random.default_rng(0).normal(0.0, 0.1))]
    rings[3] = None  # nothing returned
    profile, because = of_cloud(described(fields, frame, rings=rings))
    assert (profile.name, profile.elevations_deg) == (name, get_sensor(name).elevations_deg)
    assert profile.remission_range == (0.0, 255.0)
    assert "elevations of its rings" in because


@pytest.mark.parametrize(
    ("found", "name"),
    [
        (described(VELODYNE_FIELDS, "lidar", rings=beams("vlp-16", False)), "vlp-16"),
        (described(["x", "y", "z", "intensity"], "velodyne", rings=beams("hdl-32e", False)), "hdl-32e"),
        (described(["x", "y", "z"], "base", "/vlp16/points"), "vlp-16"),
        (described(["x", "y", "z"], "hdl64"), "hdl-64e"),
        (described(["x", "y", "z", "intensity"], "os1_64"), "os1-64"),
        (described(VELODYNE_FIELDS, "pandar", rings=beams("pandar64")), "pandar64"),
        (described(VELODYNE_FIELDS, "velodyne", "/vlp_16", beams("vlp-16")), "vlp-16"),
        (described(["x", "y", "z", "intensity"], "jt128_front_link", "/jt128/front/points"), "jt128"),
        (described(VELODYNE_FIELDS, "helios_32", rings=beams("helios-32")), "helios-32"),
    ],
)
def test_clouds_are_recognized_by_words(found: dict[str, Any], name: str) -> None:
    assert of_cloud(found).profile.name == name


@pytest.mark.parametrize(
    ("found", "error"),
    [
        (described(["x", "y", "z", "intensity"], "lidar"), "do not name their sensor"),
        (described(["x", "y", "z", "intensity"], "lidar", rings=beams("vlp-16")), "do not name their sensor"),
        (described(["x", "y", "z", "intensity", "ring", "timestamp"], "rslidar"), "by Robosense, but its model is unk"),
        (described(OUSTER_FIELDS, "velodyne", rings=beams("os1-64")), "do not name their sensor"),
        (described(VELODYNE_FIELDS), "a sensor by Velodyne, but its model is unknown"),
        (described(VELODYNE_FIELDS, rings=[None] * 16), "a sensor by Velodyne, but its model is unknown"),
        (described(VELODYNE_FIELDS, rings=[13.0 - 1.7 * k for k in range(16)]), "16 rings from -12.5 to 13.0 deg"),
        (described(VELODYNE_FIELDS, "vlp16", rings=beams("hdl-32e")), "its model is unknown"),
        (described(OUSTER_FIELDS, rings=[0.1 * k for k in range(64)]), "a sensor by Ouster, but its model is unknown"),
        (described(["x", "y", "z"], "velodyne", "/vlp16/hdl32"), "its model is unknown"),
    ],
)
def test_clouds_that_do_not_name_their_sensor(found: dict[str, Any], error: str) -> None:
    with pytest.raises(SensorError, match=error) as caught:
        of_cloud(found)
    assert all(name in str(caught.value) for name in SENSORS)


def rings_of(name: str, fields: Sequence[tuple[str, str]]) -> Any:
    """A cloud of a sphere of 10 m: every beam of a sensor, in 90 directions."""
    elevation = np.radians(get_sensor(name).elevations_deg)[:, None]
    azimuth = np.radians(np.arange(0.0, 360.0, 4.0))
    dtype = np.dtype([(field, f"<{kind}") for field, kind in fields])
    points = np.zeros((len(elevation), len(azimuth)), dtype)
    points["x"], points["y"] = 10 * np.cos(elevation) * np.cos(azimuth), 10 * np.cos(elevation) * np.sin(azimuth)
    points["z"] = 10 * np.sin(elevation)
    for field in ("intensity", "reflectivity"):
        if field in dtype.names:
            points[field] = {"intensity": 900, "reflectivity": 30}[field]
    if "ring" in dtype.names:
        points["ring"] = np.arange(len(points))[:, None]
    return points


XYZ = [("x", "f4"), ("y", "f4"), ("z", "f4"), ("intensity", "f4")]
LAYOUTS = {
    "os1-32": [*XYZ, ("t", "u4"), ("reflectivity", "u2"), ("ring", "u1"), ("ambient", "u2"), ("range", "u4")],
    "os2-128": [*XYZ, ("t", "u4"), ("reflectivity", "u2"), ("ambient", "u2"), ("range", "u4")],  # by its rows
    "vlp-32c": [*XYZ, ("ring", "u2"), ("time", "f4")],
}


@pytest.mark.parametrize("name", LAYOUTS)
def test_bags(tmp_path: Path, name: str) -> None:
    """And an Ouster's remission is its reflectivity, its intensity is a number of photons."""
    path = write_clouds(tmp_path / "drive.bag", [(5.0, rings_of(name, LAYOUTS[name]))])
    assert sensor_of(path) == get_sensor(name)
    ((_, read),) = read_scans(path)
    assert {*read[:, 3].tolist()} == {900.0 if name == "vlp-32c" else 30.0}
    ((_, read),) = read_scans(path, remission_field="intensity")
    assert read[0, 3] == 900.0


@pytest.mark.parametrize("write", [write_bag1, write_bag2, write_mcap])
def test_bags_that_do_not_name_their_sensor(tmp_path: Path, write: Callable[[Path], Path]) -> None:
    path = write(tmp_path / f"drive{'.bag' if write is write_bag1 else '.mcap' if write is write_mcap else ''}")
    with pytest.raises(
        SensorError, match=r"do not name their sensor \(topic /lidar/points, frame 'lidar', fields x, y"
    ):
        sensor_of(path)
    file = path if path.is_file() else next(path.glob("*.db3"))
    file.write_bytes(file.read_bytes()[:100])
    with pytest.raises(PointsError, match="damaged"):
        sensor_of(path)


def test_folders_of_captures(tmp_path: Path) -> None:
    for name in ("a.pcap", "b.pcap"):
        write_pcap(tmp_path / name, velodyne(0x28))
    assert sensor_of(tmp_path) is SENSORS["vlp-32c"]
    write_pcap(tmp_path / "c.pcap", velodyne(0x22))
    with pytest.raises(SensorError, match=r"several sensors \(vlp-16, vlp-32c\)"):
        sensor_of(tmp_path)
    (tmp_path / "c.pcap").unlink()
    POINTS.tofile(tmp_path / "d.bin")
    assert sensor_of(str(tmp_path / "d.bin")) is None  # which scan files do not name
    with pytest.raises(SensorError, match=r"several sensors \(scan files, vlp-32c\)"):
        sensor_of(tmp_path)


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The sensors that perceivers are made for; the perceivers fail every scan."""
    sensors: list[Any] = []

    class Perceiver:
        cards = ()

        def __init__(self, *_: Any, sensor: Any, **__: Any) -> None:
            self.sensor = sensor
            sensors.append(sensor)

        def __call__(self, points: Any, stamp_s: Any = None, **_: Any) -> Any:
            raise PointsError("not perceived")

    monkeypatch.setattr("edgeperc.perceiver.Perceiver", Perceiver)
    return sensors


def test_run_reads_each_capture_as_its_sensor(
    tmp_path: Path, made: list[Any], capsys: pytest.CaptureFixture[str]
) -> None:
    for name, packets in (("a", velodyne(0x28)), ("b", velodyne(0x22)), ("c", velodyne(0)), ("d", velodyne(0x28))):
        write_pcap(tmp_path / f"{name}.pcap", packets)
    POINTS.tofile(tmp_path / "e.bin")
    assert run("run", tmp_path) == 1
    assert [get_sensor(sensor).name for sensor in made] == ["vlp-32c", "vlp-16", "hdl-64e"]
    errors = capsys.readouterr().err
    assert "c.pcap: the packets are a Velodyne's but do not name the model. Pass its name" in errors
    assert "a.pcap/000000: not perceived" in errors


@pytest.mark.filterwarnings("default:.*--sensor says:UserWarning")
def test_run_believes_the_user(tmp_path: Path, made: list[Any], shell: Shell) -> None:
    known, unknown = (write_pcap(tmp_path / f"{k}.pcap", velodyne(k)) for k in (0x22, 0))
    errors = shell.err("run", known, unknown, "--sensor", "os1-64", code=1)
    assert [get_sensor(sensor).name for sensor in made] == ["os1-64"]
    assert errors.count("warning") == 1
    assert f"{known}: --sensor says os1-64, the capture vlp-16 (named by the packets)" in errors
    assert "warning" not in shell.err("run", known, "--sensor", "vlp-16", code=1)


def test_info_tells_how_the_sensor_is_known(tmp_path: Path, shell: Shell) -> None:
    path = write_pcap(tmp_path / "a.pcap", vlp16_packets(1.5))
    (document,) = shell.records("info", path)  # all of it is as far away as the walls of a hall
    assert (document["sensor"], document["sensor_from"]) == ("vlp-16", "named by the packets")
    assert "do not name the model" in shell.err("info", write_pcap(tmp_path / "b.pcap", velodyne(0)), code=1)
    POINTS.tofile(tmp_path / "c.bin")
    shown = shell.out("info", tmp_path / "c.bin", code=1)  # run refuses it
    assert "hdl-64e: the default: too few points to tell" in shown


def test_a_stream_warns_of_another_sensor(tmp_path: Path) -> None:
    class Perceiver:
        sensor = get_sensor("hdl-64e")

        def __call__(self, points: Any, stamp_s: Any = None, **_: Any) -> Any:
            raise AssertionError

    path = write_pcap(tmp_path / "a.pcap", velodyne(0x22))
    with pytest.warns(UserWarning, match="the perceiver's sensor is hdl-64e, the capture names vlp-16"):
        stream(path, Perceiver()).close()


def test_real_metadata(data_root: Callable[[str], Path]) -> None:
    files = sorted((data_root("other_sensors") / "ouster" / "metadata").glob("*.json"))
    names = [of_metadata(json.loads(file.read_text()), file.name).profile.name for file in files]
    assert names == ["os1-64", "os1-64", "os1-128", "os1-128"]
