"""Worker processes, of this computer or of Ray, give what one process gives; scans and results at URLs."""

from __future__ import annotations

import contextlib
import io
import json
import os
import shutil
import subprocess
import sys
from argparse import Namespace
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.request import Request, urlopen

import numpy as np
import pytest

from cli_helpers import Shell, write_scan
from edgeperc import cli
from edgeperc.cli import side_by_side
from edgeperc.cli.main import build_parser
from edgeperc.cli.scans import Sensors
from edgeperc.errors import EdgepercError, MissingExtraError, OptionError, PointsError
from edgeperc.ground.leveling import MountingEstimator
from edgeperc.perceiver import Perceiver
from edgeperc.preprocess.health import Normal
from edgeperc.simulation.drawn import random_scene
from edgeperc.simulation.scene import simulate
from edgeperc.system.pool import Lost
from edgeperc.system.ray_cluster import map_on_ray, signals_kept
from edgeperc.system.remote import Remote, location
from edgeperc.types.mounting import MODEL_MOUNTING
from edgeperc.types.sensor import get_sensor
from scenes import urban

pytestmark = pytest.mark.filterwarnings("ignore")  # of Ray, boto and aiohttp

N_SCANS = 9
OPTIONS = ("--model", "pointseg", "--json", "--threads", "1")
FILES = ("--labels", "--ply")  # a page and a picture show times


@pytest.fixture(scope="module")
def scans(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Nine scans; the eighth is damaged, and the last two have no remission."""
    folder = tmp_path_factory.mktemp("scans")
    for k in range(N_SCANS):
        points = urban(k).points[::3].copy()
        if k >= 7:
            points[:, 3] = 0.0
        points.tofile(folder / f"{k}.bin")
    (folder / "6.bin").write_bytes(b"no scan")
    return folder


@pytest.fixture(scope="module")
def cluster() -> Iterator[None]:
    """A Ray cluster of two processes, for all tests here: starting one takes seconds."""
    ray = pytest.importorskip("ray")
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    with signals_kept():
        ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False, object_store_memory=2**28)
    yield
    ray.shutdown()


def run(*arguments: str | Path) -> tuple[int, list[dict[str, Any]], str]:
    """Exit code, records without times, and stderr of ``edgeperc run --json``."""
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as err:
        code = cli.main(["run", *map(str, arguments), *OPTIONS])
    records = [json.loads(line) for line in out.getvalue().splitlines()]
    for record in records:
        record.pop("stage_ms", None)
    return code, records, err.getvalue()


def contents(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and ".run" not in path.parts
    }


@pytest.fixture(params=["local", "ray"])
def workers(request: pytest.FixtureRequest) -> tuple[str, ...]:
    """Options of two worker processes."""
    if request.param == "ray":
        request.getfixturevalue("cluster")
    return ("--engine", request.param, "--workers", "2")


@pytest.fixture(scope="module")
def alone(scans: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, bytes], list[dict[str, Any]]]:
    """Files and records of one process."""
    out = tmp_path_factory.mktemp("alone")
    code, records, _ = run(scans, "--out", out, *FILES)
    assert code == 1
    assert [bool(record.get("error")) for record in records] == [k == 6 for k in range(N_SCANS)]
    assert "no remission" in " ".join(records[7]["fitness"])
    assert not records[8]["fitness"]  # said once
    files = contents(out)
    assert len(files) == 2 * (N_SCANS - 1)
    return files, records


def test_workers_give_the_same_bytes(scans: Path, alone: Any, tmp_path: Path, workers: tuple[str, ...]) -> None:
    code, records, said = run(scans, "--out", tmp_path, *FILES, *workers)
    assert code == 1
    assert (contents(tmp_path), records) == alone
    assert "6.bin" in said


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Workers are of this process, and decide as others do."""

    def map_here(make: Callable[..., Any], arguments: tuple[Any, ...], items: list[Any], **_: Any) -> Iterator[Any]:
        return map(make(*arguments), items)

    monkeypatch.setattr(side_by_side, "ENGINES", {"local": map_here})


def test_workers_find_the_sensor_of_each_folder(here: None, tmp_path: Path) -> None:
    folders = [tmp_path / name for name in ("os1-64", "unknown", "vlp-16")]
    write_scan(folders[1] / "0.bin", 5000)
    for folder in (folders[0], folders[2]):
        folder.mkdir()
        urban(3, folder.name).points.tofile(folder / "0.bin")
    code, records, said = run(*folders)
    assert ("sensor cannot be told" in said, code) == (True, 1)
    assert run(*folders, "--workers", "2")[:2] == (code, records)


def test_what_workers_have_made_is_kept(scans: Path, alone: Any, here: None, tmp_path: Path) -> None:
    """What is missing, cut short, or of other options is made again."""
    arguments = (scans, "--out", tmp_path, *FILES, "--workers", "2")
    assert "kept" not in run(*arguments)[2]
    (tmp_path / "5.ply").unlink()
    (tmp_path / "7.label").write_bytes(b"cut")
    code, records, said = run(*arguments)
    assert code == 1
    assert (contents(tmp_path), records) == alone
    assert "1 scan of an earlier run kept" in said
    _, others, said = run(*arguments, "--boxes-from", "network")
    assert "kept" not in said
    assert others != records
    run(*arguments)
    before = contents(tmp_path)
    run(*arguments[:-2], "--no-agreement")  # one process replaces files by others of the same size
    run(*arguments)
    assert contents(tmp_path) == before
    profile = tmp_path / "sensor.json"
    for ego_box in (None, ((-9.0, 9.0), (-9.0, 9.0), (-1.0, 2.0))):
        profile.write_text(replace(get_sensor("hdl-64e"), ego_box=ego_box).to_json())
        assert "kept" not in run(*arguments, "--sensor", profile)[2]


def test_what_is_kept_was_made_after_the_same_first_scans() -> None:
    """With a known mounting and remission, only the health shows that they are others."""
    perceiver: Any = SimpleNamespace(cards=(), sensor=None, providers={})
    known = {"mounting": MountingEstimator(MODEL_MOUNTING), "remission": SimpleNamespace(matched=None), "to_check": 0}
    made = []
    for normal in (Normal(), Normal(np.zeros((72, 4)))):
        learned: Any = SimpleNamespace(**known, normal=normal)
        made.append(side_by_side.ScanWorker(lambda _: (perceiver, None, None), Namespace(json=True), learned).made_of)
    assert made[0] != made[1]


def figures(file: Path, *options: str) -> tuple[Any, list[str]]:
    """What an evaluation writes and prints."""
    with contextlib.redirect_stdout(io.StringIO()) as out:
        assert cli.main(["eval", "simulation:7", *options, "--json", str(file)]) == 0
    written = json.loads(file.read_text())
    del written["command"]
    # Ray itself prints that a process of its died, which a busy computer may bring about; the block is done again.
    return written, [line for line in out.getvalue().splitlines() if "(raylet)" not in line]


@pytest.fixture(scope="module")
def figures_alone(tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, list[str]]:
    """Those of one process."""
    return figures(tmp_path_factory.mktemp("figures") / "one.json")


def test_workers_give_the_same_figures(tmp_path: Path, figures_alone: Any, workers: tuple[str, ...]) -> None:
    assert figures(tmp_path / "workers.json", *workers) == figures_alone


@pytest.mark.usefixtures("cluster")
def test_an_item_that_kills_its_process_is_lost_alone() -> None:

    def make(factor: int) -> Callable[[int], int]:  # inside, because a worker cannot import this file
        def function(item: int) -> int:
            if item == 5:
                os._exit(1)
            if item == 7:
                raise ValueError("seven")
            return factor * item

        return function

    found = list(map_on_ray(make, (10,), range(40), workers=1))
    assert len(found) == 40
    assert isinstance(found[5], Lost)
    assert "died" in found[5].reason
    assert "ValueError: seven" in found[7].reason
    assert [each for each in found if not isinstance(each, Lost)] == [10 * k for k in range(40) if k not in (5, 7)]


@pytest.mark.usefixtures("cluster")
@pytest.mark.parametrize(
    ("dies", "message"), [(False, "could not start: .*no such model"), (True, "2 worker processes ended before")]
)
def test_what_cannot_start_on_ray_is_an_error(dies: bool, message: str) -> None:

    def make() -> Callable[[int], int]:
        if dies:
            os._exit(4)
        raise ValueError("no such model")

    with pytest.raises(EdgepercError, match=f"(?s){message}"):
        list(map_on_ray(make, (), range(4), workers=1))


def test_a_perceiver_starts_from_what_another_learned(scans: Path) -> None:
    """The mounting is that of the first scans; the perceiver has its own otherwise."""
    one, other = (Perceiver("pointseg", sensor="vlp-16", provider="cpu", on_mismatch="ignore") for _ in range(2))
    points = np.fromfile(scans / "0.bin", np.float32).reshape(-1, 4) * np.float32([1, 1, 1, 255])
    points[:, 2] += 0.9
    for _ in range(5):
        one(points)
    assert one.learned.is_settled
    assert not other.learned.is_settled
    other.start_from(one.learned)
    assert other.learned == one.learned
    assert other(points).mounting == one(points).mounting


@pytest.mark.parametrize("option", ["--track", "--live", "--static=out"])
@pytest.mark.parametrize("asked", ["--engine ray", "--workers 2"])
def test_what_needs_an_order_is_refused(scans: Path, tmp_path: Path, option: str, asked: str, shell: Shell) -> None:
    assert f"in their order, and {asked} perceives" in shell.err("run", scans, *asked.split(), option)
    drive = tmp_path / "drive.pcap"
    drive.write_bytes(b"\xd4\xc3\xb2\xa1" + bytes(20))
    assert f"{asked} takes scan files" in shell.err("run", drive, *asked.split(), "--model", "pointseg")


def test_that_ray_is_missing_is_said_before_the_first_scan(
    scans: Path, shell: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    printed = shell.both("run", scans / "0.bin", "--engine", "ray", code=2)
    assert "--engine ray needs ray, which is not installed" in printed.err
    assert not printed.out


def test_paths_stay_paths(tmp_path: Path) -> None:
    assert location("a/b.bin") == Path("a/b.bin")
    assert location("udp://:2368") == Path("udp://:2368")
    assert location(tmp_path.as_uri()) == tmp_path
    assert location("s3://bucket/a/") == Remote("s3://bucket/a")
    url = Remote("s3://bucket/a/0.pcd.bin")
    assert (url.name, url.suffix, url.place) == ("0.pcd.bin", ".bin", "/bucket/a/0.pcd.bin")
    assert (str(url.parent / Path("b/c")), url.with_name("x")) == ("s3://bucket/a/b/c", Remote("s3://bucket/a/x"))


def _results_at_urls_are_those_of_paths(root: str, scans: Path, tmp_path: Path) -> None:
    """Scans below ``root`` and results there are those of local folders."""
    local = tmp_path / "scans"
    for k, part in ((0, "a"), (1, "a"), (0, "b"), (6, "b")):
        (local / part).mkdir(parents=True, exist_ok=True)
        shutil.copy(scans / f"{k}.bin", local / part)
        Remote(f"{root}/scans/{part}/{k}.bin").write_bytes((scans / f"{k}.bin").read_bytes())
    Remote(f"{root}/scans/.hidden/0.bin").write_bytes(b"")
    code, records, _ = run(local / "a", local / "b", "--out", tmp_path / "out", "--labels", "--ply")
    there = run(f"{root}/scans", "--out", f"{root}/out", "--labels", "--ply")
    assert there[0] == code == 1
    for record, other in zip(there[1], records, strict=True):
        assert record.pop("scan").endswith(other.pop("scan").removeprefix(str(tmp_path)))
    assert "scans/b/6.bin: " in there[2]
    found = {url: Remote(f"{root}/out/{url}").read_bytes() for url in contents(tmp_path / "out")}
    assert found == contents(tmp_path / "out")
    assert len(found) == 6
    back = run(f"{root}/scans/a/0.bin", "--out", tmp_path / "back", "--labels")
    assert contents(tmp_path / "back") == {"0.label": contents(tmp_path / "out")["a/0.label"]}
    assert back[0] == 0


@pytest.mark.parametrize(("sensor", "n_damaged"), [("vlp-16", 0), ("os1-64", 2)])
def test_the_sensor_of_scans_at_a_url_is_found(sensor: str, n_damaged: int, tmp_path: Path) -> None:
    """For workers, and for one process: from the first scans of the folder that can be read."""
    pytest.importorskip("fsspec")
    folder = Remote(f"memory://{sensor}/scans")
    urls = [Remote(f"{folder.url}/{k}.bin") for k in range(4)]
    for k, url in enumerate(urls):
        points = simulate(random_scene(k, "urban"), sensor, seed=k).points
        url.write_bytes(b"no scan" if k < n_damaged else points.tobytes())
    arguments = build_parser().parse_args(["run", folder.url])
    fetched = urls[n_damaged].fetch(tmp_path)
    for found, how in (Sensors(arguments, urls).of(urls[0]), Sensors(arguments, urls).of(fetched, urls[n_damaged])):
        assert found.name == sensor
        assert "beams found" in how


def test_no_more_is_fetched_than_the_sensor_needs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Three scans that can be read; none with ``--sensor``. Files of this computer need no temporary folder."""
    pytest.importorskip("fsspec")
    folder, fetched = Remote("memory://few/scans"), []
    urls = [Remote(f"{folder.url}/{name}") for name in ("0.bin", "1.bin", "2.bin", "3.bin", "4.bin", "whole.pcap")]
    points = simulate(random_scene(1, "urban"), "vlp-16", seed=1).points
    for k, url in enumerate(urls):
        url.write_bytes(b"no scan" if k == 0 else points.tobytes())
    fetch = Remote.fetch

    def counted(url: Remote, to: Path) -> Path:
        fetched.append(url.name)
        return fetch(url, to)

    monkeypatch.setattr(Remote, "fetch", counted)
    parser = build_parser()
    assert Sensors(parser.parse_args(["run", folder.url]), urls).of(urls[0])[0] != "hdl-64e"
    assert fetched == ["0.bin", "1.bin", "2.bin", "3.bin"]
    given = parser.parse_args(["run", folder.url, "--sensor", "os1-64"])
    (tmp_path / "4.bin").write_bytes(points.tobytes())
    assert Sensors(given, urls).of(tmp_path / "4.bin", urls[4])[0] == "os1-64"
    assert len(fetched) == 4
    monkeypatch.setattr("edgeperc.cli.scans.tempfile.TemporaryDirectory", pytest.fail)
    here = tmp_path / "4.bin"
    sensor, _ = Sensors(parser.parse_args(["run", str(here)]), [here]).of(here)
    assert sensor.name == "vlp-16"


def test_urls_that_cannot_be_fetched_are_reported_later(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("fsspec")
    monkeypatch.setattr("edgeperc.system.remote.MOST_BYTES", 10)
    urls = [Remote(f"memory://large/{k}.bin") for k in range(2)]
    for url in urls:
        url.write_bytes(bytes(16))
    found = Sensors(build_parser().parse_args(["run", "memory://large"]), urls).of(urls[0])
    assert found == ("hdl-64e", "the default: too few points to tell")


def test_scans_in_memory(scans: Path, tmp_path: Path) -> None:
    pytest.importorskip("fsspec")
    _results_at_urls_are_those_of_paths("memory://edgeperc", scans, tmp_path)


@pytest.fixture
def bucket(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A bucket of a local S3 server."""
    server = pytest.importorskip("moto.server")
    s3fs = pytest.importorskip("s3fs")
    import boto3

    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(name, "test")
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    s3 = server.ThreadedMotoServer(ip_address="127.0.0.1", port=0)
    s3.start()
    host, port = s3.get_host_and_port()
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
    urlopen(Request(f"http://{host}:{port}/moto-api/reset", method="POST")).close()  # what an earlier server had
    boto3.client("s3").create_bucket(Bucket="edgeperc")
    yield "s3://edgeperc"
    s3fs.S3FileSystem.clear_instance_cache()  # they know this server
    s3.stop()


def test_scans_at_s3(bucket: str, scans: Path, tmp_path: Path) -> None:
    _results_at_urls_are_those_of_paths(bucket, scans, tmp_path)
    with pytest.raises(PointsError, match="no such file"):
        Remote(f"{bucket}/nothing.bin").fetch(tmp_path)
    with pytest.raises(OSError, match="nobody"):
        Remote("s3://nobody/scan.bin").read_bytes()


def test_ray_reads_from_and_writes_to_s3(bucket: str, scans: Path, alone: Any) -> None:
    pytest.importorskip("ray")
    for path in scans.iterdir():
        Remote(f"{bucket}/scans/{path.name}").write_bytes(path.read_bytes())
    files, records = alone
    # Workers have the environment that the cluster was started with, so this one has its own.
    arguments = [f"{bucket}/scans", "--out", f"{bucket}/out", *FILES, *OPTIONS]
    command = [sys.executable, "-m", "edgeperc", "run", *arguments, "--engine", "ray", "--workers", "2"]
    done = [subprocess.run(command, capture_output=True, text=True, timeout=300) for _ in range(2)]
    for each in done:
        assert each.returncode == 1, each.stderr
        there = [json.loads(line) for line in each.stdout.splitlines()]
        assert len(there) == len(records)
        for record, other in zip(there, records, strict=True):
            assert record.pop("scan") == f"{bucket}/scans/{Path(other['scan']).name}"
            if "error" in record:
                assert f"{bucket}/scans/6.bin" in record.pop("error")
            expected = {key: value for key, value in other.items() if key not in ("scan", "error")}
            assert {key: value for key, value in record.items() if key != "stage_ms"} == expected
    assert "kept" not in done[0].stderr
    assert "kept" in done[1].stderr
    assert {name: Remote(f"{bucket}/out/{name}").read_bytes() for name in files} == files


def test_large_files_are_not_fetched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("fsspec")
    monkeypatch.setattr("edgeperc.system.remote.MOST_BYTES", 10)
    large = Remote("memory://edgeperc/large.pcap")
    large.write_bytes(bytes(11))
    with pytest.raises(PointsError, match="11 bytes are not fetched"):
        large.fetch(tmp_path)


def test_the_package_of_a_protocol_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("fsspec")
    monkeypatch.setitem(sys.modules, "adlfs", None)
    with pytest.raises(OptionError, match="adlfs"):
        Remote("abfs://container/scan.bin").read_bytes()
    with pytest.raises(OptionError, match="nosuch"):
        Remote("nosuch://container/scan.bin").read_bytes()
    monkeypatch.setitem(sys.modules, "fsspec.core", None)
    with pytest.raises(MissingExtraError, match=r"edgeperc\[remote\]"):
        Remote("s3://bucket/scan.bin").read_bytes()


@pytest.mark.parametrize("arguments", [["--gif", "--track", "--out", "s3://b/out"], ["--live"]])
def test_what_urls_cannot_do(arguments: list[str], shell: Shell) -> None:
    assert "takes no URL" in shell.err("run", "s3://bucket/scans", *arguments)
