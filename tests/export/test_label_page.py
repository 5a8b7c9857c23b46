"""The page to draw roads: what it saves, which requests it refuses, and drawing in a browser."""

from __future__ import annotations

import contextlib
import csv
import hashlib
import http.client
import http.server
import json
import os
import re
import shutil
import socket
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

pytest.importorskip("PIL.Image")
for package in ("faster_coco_eval", "filelock", "tqdm", "onnx", "onnxruntime"):
    pytest.importorskip(package)

from database_helpers import TRAPEZIUM, drawn, plan_of, road_network

from edgeperc.system.printable import printable
from edgeperc.types.views import TopViewGeometry
from edgeperc_export.data.roads import DatabaseError, mask_of, read_coco
from edgeperc_export.database import label_page
from edgeperc_export.database.build import build
from edgeperc_export.database.files import TopViewDatabase
from edgeperc_export.database.label_page import LARGEST_BODY, LARGEST_HEAD, TOKEN, LabelServer
from strategies import JSON

ROAD = json.dumps([TRAPEZIUM])


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory, kitti: Path) -> Path:
    folder = tmp_path_factory.mktemp("database")
    model = road_network(folder / "low.onnx", TopViewGeometry())
    build(plan_of(kitti, folder / "out", str(model)), workers=1)
    return folder / "out"


@contextmanager
def running(server: LabelServer) -> Iterator[LabelServer]:
    with server:
        thread = threading.Thread(target=server.serve_forever, args=(0.02,))
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()


@pytest.fixture
def server(out: Path, kitti: Path, tmp_path: Path) -> Iterator[LabelServer]:
    with running(LabelServer(out, tmp_path / "road.json", kitti=kitti)) as server:
        yield server


class Answer:
    """The status, headers and body of an answer."""

    def __init__(self, response: http.client.HTTPResponse) -> None:
        self.status, self.headers, self.body = response.status, response.headers, response.read()

    @property
    def json(self) -> Any:
        return json.loads(self.body)


def ask(
    server: LabelServer, path: str, body: str | bytes | None = None, method: str = "", **headers: str | None
) -> Answer:
    """Ask as the page does; ``Sec_Fetch_Site="..."`` changes or adds a header, None leaves it out."""
    host = f"127.0.0.1:{server.server_address[1]}"
    sent: dict[str, str | None] = {"Host": host}
    if body is not None:
        body = body.encode() if isinstance(body, str) else body
        sent |= {"Origin": f"http://{host}", "Content-Type": "application/json", "Content-Length": str(len(body))}
        sent |= {TOKEN: server.token, "Sec-Fetch-Site": "same-origin"}
    sent |= {name.replace("_", "-"): value for name, value in headers.items()}
    lines = [f"{name}: {value}" for name, value in sent.items() if value is not None]
    head = [f"{method or ('GET' if body is None else 'PUT')} /{path} HTTP/1.1", *lines, "", ""]
    return raw(server, "\r\n".join(head).encode("latin-1") + (body or b""))


def raw(server: LabelServer, content: bytes, end: bool = True) -> Answer:
    """Send bytes, and read the answer."""
    with connected(server) as connection:
        connection.sendall(content)
        if end:
            connection.shutdown(socket.SHUT_WR)
        with http.client.HTTPResponse(connection) as response:
            response.begin()
            return Answer(response)


def connected(server: LabelServer) -> socket.socket:
    return socket.create_connection(("127.0.0.1", server.server_address[1]), timeout=30.0)


def roads(server: LabelServer, name: str) -> list[list[list[float]]]:
    polygons: list[list[list[float]]] = ask(server, f"road/{name}").json
    return polygons


def states(server: LabelServer) -> dict[str, str]:
    """State of each scene with polygons."""
    return {scene["name"]: scene["state"] for scene in ask(server, "scenes").json if scene["state"]}


def test_the_page_saves_drawn_polygons(server: LabelServer, out: Path) -> None:
    scenes = ask(server, "scenes").json
    assert [scene["name"] for scene in scenes] == TopViewDatabase(out).names
    assert ask(server, "image/000003").body == (out / "images/000003.png").read_bytes()
    assert ask(server, "camera/000000").body.startswith(b"\x89PNG")
    assert ask(server, "draft/000000").json
    assert roads(server, "000003") == []
    assert ask(server, "road/000003", ROAD).json == 1
    assert ask(server, "road/000004", json.dumps([[[-5, 0], [300, 0], [100, 500]]])).status == 200
    assert roads(server, "000004") == [[[0, 0], [200, 0], [100, 400]]]  # clamped to the image
    saved = read_coco([server.polygons])
    np.testing.assert_array_equal(mask_of(saved["000003"]), mask_of([[np.ravel(TRAPEZIUM).tolist()]]))
    assert states(server) == {"000003": "drawn", "000004": "drawn"}
    assert ask(server, "road/000004", "[]").json == 0
    assert [*read_coco([server.polygons])] == ["000003"]
    (image,) = json.loads(server.polygons.read_text())["images"]
    assert image["scan"] == TopViewDatabase(out).rows[3]["scan_sha256"]
    with LabelServer(out, server.polygons) as again:
        assert again.roads == {"000003": [TRAPEZIUM]}
        assert again.server_address[0] == "127.0.0.1"
        assert again.token != server.token


def test_what_another_program_saves_meanwhile_stays(server: LabelServer, out: Path) -> None:
    ask(server, "road/000003", ROAD)
    with running(LabelServer(out, server.polygons)) as other:
        for name in ("000001", "000003"):
            assert ask(other, f"road/{name}", json.dumps([TRAPEZIUM, TRAPEZIUM])).status == 200
    assert ask(server, "road/000002", ROAD).status == 200
    assert [*read_coco([server.polygons])] == ["000001", "000002", "000003"]
    for _ in range(2):  # the page shows what it was before
        answer = ask(server, "road/000003", ROAD)
        assert (answer.status, b"another program has changed this scene in " in answer.body) == (409, True)
    assert roads(server, "000003") == [TRAPEZIUM, TRAPEZIUM]
    assert ask(server, "road/000003", ROAD).status == 200


def test_a_draft_counts_as_drawn_only_after_it_is_confirmed(server: LabelServer, out: Path) -> None:
    for name in ("000002", "000003"):
        assert ask(server, f"draft/{name}", ROAD).json == 1
    assert states(server) == {"000002": "draft", "000003": "draft"}
    assert roads(server, "000003") == [TRAPEZIUM]
    assert read_coco([server.polygons]) == {}  # nothing for training
    with LabelServer(out, server.polygons) as again:  # drafts outlive the server
        assert (again.roads, again.drafts) == ({}, {"000002": [TRAPEZIUM], "000003": [TRAPEZIUM]})
    assert ask(server, "road/000003", ROAD).json == 1  # confirmed
    assert states(server) == {"000002": "draft", "000003": "drawn"}
    assert [*read_coco([server.polygons])] == ["000003"]
    assert ask(server, "draft/000003", ROAD).json == 1  # a draft was added to it: to be checked again
    assert read_coco([server.polygons]) == {}
    for name in ("000002", "000003"):
        assert ask(server, f"draft/{name}", "[]").json == 0
    assert states(server) == {}
    assert "drafts" not in json.loads(server.polygons.read_text())


def test_a_file_that_cannot_be_edited_is_refused(server: LabelServer, out: Path, tmp_path: Path) -> None:
    ask(server, "road/000003", ROAD)
    content = json.loads(server.polygons.read_text())
    for drafts in ([], "x", {"000001": 3}, {"000001": [[1, 2]]}, {"000001": [[[1, 2], [3, 4], ["x", 1]]]}):
        server.polygons.write_text(json.dumps(content | {"drafts": drafts}))
        with pytest.raises(DatabaseError, match="drafts that are no polygons"):
            LabelServer(out, server.polygons)
    content["images"][0]["scan"] = "0" * 16
    server.polygons.write_text(json.dumps(content))
    with pytest.raises(DatabaseError, match=r"drawn over other scans .* here: 000003; names differ"):
        LabelServer(out, server.polygons)
    runs = {"size": [400, 200], "counts": [80_000]}
    for change, said in (({"segmentation": runs}, "run lengths"), ({"category_id": 1}, "annotations of background")):
        (tmp_path / "other.json").write_text(drawn(annotation=change))
        with pytest.raises(DatabaseError, match=said):
            LabelServer(out, tmp_path / "other.json")


def test_a_file_that_cannot_be_written_is_reported(server: LabelServer, capsys: pytest.CaptureFixture[str]) -> None:
    server.polygons.mkdir()
    answer = ask(server, "road/000001", ROAD)
    assert answer.status == 500
    assert "road.json" in answer.body.decode()
    assert capsys.readouterr().err.count("\n") == 1
    assert roads(server, "000001") == []  # as in the file
    server.polygons.rmdir()
    assert ask(server, "road/000001", ROAD).status == 200
    assert roads(server, "000001") == [TRAPEZIUM]


@pytest.mark.parametrize(
    ("path", "body", "headers", "status"),
    [
        ("image/000099", None, {}, 404),
        ("image/../index.csv", None, {}, 404),
        ("image/%2e%2e%2findex.csv", None, {}, 404),
        ("image/..%5cindex.csv", None, {}, 404),
        ("image/000001/../000002", None, {}, 404),
        ("image/000001%00", None, {}, 404),
        ("../index.csv", None, {}, 404),
        ("//index.csv", None, {}, 404),
        ("camera/000001", None, {}, 404),
        ("nothing", None, {}, 404),
        ("road/000099", "[]", {}, 404),
        ("image/000001", "[]", {}, 404),
        ("road/000001", ROAD, {"Content_Type": "text/plain"}, 415),
        ("road/000001", ROAD, {"Content_Type": None}, 415),
        ("road/000001", ROAD, {"method": "POST"}, 501),
        ("road/000001", ROAD, {"method": "DELETE"}, 501),
        ("scenes", None, {"method": "\x1b[31m"}, 501),
        # Only the page can write.
        ("road/000001", ROAD, {TOKEN: None}, 403),
        ("road/000001", ROAD, {TOKEN: ""}, 403),
        ("road/000001", ROAD, {TOKEN: "x" * 43}, 403),
        ("road/000001", ROAD, {TOKEN: "\xe9"}, 403),
        ("road/000001", ROAD, {"Origin": None}, 403),
        ("road/000001", ROAD, {"Origin": "null"}, 403),
        ("road/000001", ROAD, {"Origin": "http://evil.example"}, 403),
        ("road/000001", ROAD, {"Origin": "http://localhost"}, 403),
        ("road/000001", ROAD, {"Origin": "http://localhost:1"}, 403),
        ("road/000001", ROAD, {"Origin": "https://127.0.0.1:{port}"}, 403),
        ("road/000001", ROAD, {"Sec-Fetch-Site": "cross-site"}, 403),
        ("road/000001", ROAD, {"Sec-Fetch-Site": "same-site"}, 403),
        ("road/000001", ROAD, {"Sec-Fetch-Site": "none"}, 403),
        ("road/000001", ROAD, {"Host": "evil.example:{port}", "Origin": "http://evil.example:{port}"}, 403),
    ],
)
def test_wrong_requests_are_refused(
    server: LabelServer, path: str, body: str | None, headers: dict[str, Any], status: int
) -> None:
    port = server.server_address[1]
    answer = ask(server, path, body, **{name: value and value.format(port=port) for name, value in headers.items()})
    assert answer.status == status
    assert answer.headers["Content-Type"] == "text/plain; charset=utf-8"
    assert answer.body.decode().strip().isprintable()
    assert not server.polygons.exists()


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:{port}", "localhost", "localhost:1", "[::1]:{port}", "", None]
)
@pytest.mark.parametrize("path", ["", "scenes", "image/000001"])
def test_other_hosts_are_refused(server: LabelServer, host: str | None, path: str) -> None:
    """A site can let its own name resolve to this computer (DNS rebinding)."""
    named = None if host is None else host.format(port=server.server_address[1])
    assert ask(server, path, Host=named).status == 403


def test_both_names_of_this_computer_are_accepted(server: LabelServer) -> None:
    port = server.server_address[1]
    for host in (f"127.0.0.1:{port}", f"localhost:{port}", f"LocalHost:{port}"):
        assert ask(server, "", Host=host).status == 200
        assert ask(server, "road/000001", ROAD, Host=host, Origin=f"http://{host.lower()}").status == 200
    for host, other in (("127.0.0.1", "localhost"), ("localhost", "127.0.0.1")):  # something between may change Host
        assert ask(server, "road/000001", ROAD, Host=f"{host}:{port}", Origin=f"http://{other}:{port}").status == 200
    two = f"GET / HTTP/1.1\r\nHost: localhost:{port}\r\nHost: evil.example\r\n\r\n"
    assert raw(server, two.encode()).status == 403


@pytest.mark.parametrize("path", ["scenes", "image/000001", "camera/000000", "road/000001", "draft/000001"])
def test_other_sites_cannot_read(server: LabelServer, path: str) -> None:
    for site in ("cross-site", "same-site"):
        assert ask(server, path, Sec_Fetch_Site=site).status == 403
    assert ask(server, path, Sec_Fetch_Site="same-origin").status == 200
    assert ask(server, "", Sec_Fetch_Site="cross-site").status == 200  # a link to the page


def test_every_answer_has_the_protective_headers(server: LabelServer) -> None:
    port = server.server_address[1]
    answers = [ask(server, path) for path in ("", "scenes", "image/000001", "camera/000000", "nothing")]
    answers += [ask(server, "", Host="evil.example"), ask(server, "road/000001", "{"), ask(server, "road/000001", ROAD)]
    answers.append(raw(server, f"BREW / HTTP/1.1\r\nHost: localhost:{port}\r\n\r\n".encode()))
    for answer in answers:
        assert answer.headers["X-Frame-Options"] == "DENY"
        assert answer.headers["X-Content-Type-Options"] == "nosniff"
        assert answer.headers["Cache-Control"] == "no-store"
        assert answer.headers["Referrer-Policy"] == "no-referrer"
        policy = answer.headers["Content-Security-Policy"]
        assert {"default-src 'none'", "frame-ancestors 'none'"} <= {*policy.split("; ")}
        assert "unsafe" not in policy
        assert "Python" not in str(answer.headers)
    page = answers[0].body.decode()
    (nonce,) = set(re.findall(r"'nonce-([^']+)'", answers[0].headers["Content-Security-Policy"]))
    assert re.findall(r"<(\w+) nonce=\"([^\"]+)\"", page) == [("style", nonce), ("script", nonce)]
    assert page.count(server.token) == 1
    assert "@@" not in page
    assert nonce not in ask(server, "").body.decode()
    assert not any(server.token.encode() in answer.body for answer in answers[1:])


@pytest.mark.parametrize(
    ("lengths", "status"),
    [
        ([], 411),
        (["-1"], 400),
        (["+4"], 400),
        (["1_0"], 400),
        (["4.0"], 400),
        (["0x4"], 400),
        (["\xb2"], 400),
        ([""], 400),
        (["four"], 400),
        (["4", "5"], 400),
        (["4, 4"], 400),
        ([f"{LARGEST_BODY + 1}"], 413),
        (["9" * 400], 413),
        (["9" * 5000], 413),
        (["5"], 400),  # the body has four
        (["4"], 200),
    ],
)
def test_the_length_of_a_body(server: LabelServer, lengths: list[str], status: int) -> None:
    host = f"127.0.0.1:{server.server_address[1]}"
    lines = [f"Host: {host}", f"Origin: http://{host}", f"{TOKEN}: {server.token}", "Content-Type: application/json"]
    lines += [f"Content-Length: {length}" for length in lengths]
    head = "\r\n".join(["PUT /road/000001 HTTP/1.1", *lines, "", ""]).encode("latin-1")
    assert raw(server, head + b"[  ]").status == status


def test_a_body_in_chunks_is_refused(server: LabelServer) -> None:
    for more in ({}, {"Content_Length": None}):
        chunks = ask(server, "road/000001", b"2\r\n[]\r\n0\r\n\r\n", Transfer_Encoding="chunked", **more)
        assert chunks.status == 411


@pytest.mark.parametrize(
    "body",
    [
        "",
        "{",
        "7",
        "null",
        "{}",
        '""',
        "[[]]",
        "[{}]",
        '["abc"]',
        "[[[1, 2], [3, 4]]]",
        "[[[1, 2], [3, 4], [5]]]",
        '[[[1, 2], [3, 4], ["x", 1]]]',
        '[[[1, 2], [3, 4], "ab"]]',
        "[[[1, 2], [3, 4], [true, 1]]]",
        "[[[1, 2], [3, 4], [null, 1]]]",
        "[[[1, 2], [3, 4], [NaN, 1]]]",
        "[[[1, 2], [3, 4], [1e999, 1]]]",
        "[[[1, 2], [3, 4], [-Infinity, 1]]]",
        f"[[[1, 2], [3, 4], [{'9' * 400}, 1]]]",
        f"[[[1, 2], [3, 4], [-{'9' * 5000}, 1]]]",
        "[" * 100_000,
        "[" * 100_000 + "]" * 100_000,
        '{"a":' * 100_000,
        b"\xff\xfe[",
        b'["\xff"]',
    ],
    ids=lambda body: str(body[:30]),
)
def test_a_wrong_body_is_explained(server: LabelServer, body: str | bytes) -> None:
    answer = ask(server, "road/000001", body)
    assert answer.status == 400
    assert "expected a list of polygons" in answer.body.decode()
    assert len(answer.body) < 500
    assert not server.polygons.exists()


corners = st.tuples(*[st.integers(-(10**400), 10**400) | st.floats()] * 2)


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.binary() | JSON.map(json.dumps) | st.lists(st.lists(corners, max_size=5), max_size=3).map(json.dumps))
def test_any_body_is_answered(server: LabelServer, body: str | bytes) -> None:
    answer = ask(server, "road/000002", body)
    assert answer.status in (200, 400)
    if answer.status == 200:
        saved = roads(server, "000002")
        assert len(saved) == answer.json
        assert all(0 <= x <= 200 and 0 <= y <= 400 for ring in saved for x, y in ring)
        assert len(read_coco([server.polygons]).get("000002", [])) == len(saved)


def test_a_scenes_name_cannot_leave_its_folder(out: Path, tmp_path: Path) -> None:
    shutil.copytree(out, tmp_path / "out")
    index, manifest = tmp_path / "out/index.csv", tmp_path / "out/manifest.json"
    for name in ("../000001", "a/b", "/etc/passwd", "..", ".", "a\\b", "C:a", '""'):
        content = (out / "index.csv").read_text().replace("\n000001,", f"\n{name},").encode()
        assert name.encode() in content
        index.write_bytes(content)
        known = json.loads((out / "manifest.json").read_text())
        known["sha256"]["index.csv"] = hashlib.sha256(content).hexdigest()
        manifest.write_text(json.dumps(known))
        with pytest.raises(DatabaseError, match="plain file name"):
            LabelServer(tmp_path / "out", tmp_path / "road.json")


@pytest.mark.parametrize(
    ("head", "status"),
    [
        (b"GET /" + b"a" * 70_000 + b" HTTP/1.1\r\n\r\n", 414),
        (b"GET / HTTP/1.1\r\nA: " + b"a" * LARGEST_HEAD + b"\r\n\r\n", 431),
        (b"GET / HTTP/1.1\r\n" + b"A: b\r\n" * 200 + b"\r\n", 431),
        (b"GET / HTTP/1.1\r\n" + (b"A: " + b"a" * 600 + b"\r\n") * 60 + b"\r\n", 431),
        (b"GET / HTTP/1.1\r\nno colon\r\n\r\n", 403),
    ],
    ids=lambda head: str(head)[:40],
)
def test_a_wrong_head_is_refused(server: LabelServer, head: bytes, status: int) -> None:
    assert raw(server, head, end=False).status == status
    assert ask(server, "scenes").status == 200


@pytest.mark.parametrize(
    "head", [b"GET\r\n\r\n", b"GET / HTTP/9.9\r\n\r\n", b"\x00\xff\x16\x03 / HTTP/x\r\n\r\n", b"\r\n"]
)
def test_what_is_not_http_gets_at_most_one_line(server: LabelServer, head: bytes) -> None:
    with connected(server) as connection, connection.makefile("rb") as answer:
        connection.sendall(head)
        assert len(answer.read().splitlines()) <= 1
    assert ask(server, "scenes").status == 200


def test_a_closed_connection_prints_nothing(server: LabelServer, capsys: pytest.CaptureFixture[str]) -> None:
    host = f"Host: localhost:{server.server_address[1]}\r\n".encode()
    request = b"GET /image/000001 HTTP/1.1\r\n" + host
    before = threading.active_count()
    for content in (
        b"",
        b"GET /",
        request,
        request + b"\r\n",
        b"PUT /road/000001 HTTP/1.1\r\nContent-Length: 9\r\n" + host + b"\r\n[[",
    ):
        for _ in range(5):
            connection = connected(server)
            connection.sendall(content)
            # Closing resets the connection, so that the server's next call on it fails.
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            connection.close()
    until = time.monotonic() + 10.0
    while threading.active_count() > before and time.monotonic() < until:  # their threads and timers
        time.sleep(0.02)
    assert ask(server, "scenes").status == 200
    captured = capsys.readouterr()
    assert (captured.out, captured.err) == ("", "")


def hung_up(connection: socket.socket, drop: bytes) -> bool:
    """Send a drop every 50 ms until the server closes the connection; False after 30 s."""
    connection.settimeout(0.05)
    for _ in range(600):
        try:
            connection.sendall(drop)
            if connection.recv(1) == b"":
                return True
        except TimeoutError:
            continue
        except ConnectionError:
            return True
    return False


def test_slow_clients_are_disconnected(
    out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(label_page, "REQUEST_S", 0.5)
    with running(LabelServer(out, tmp_path / "road.json")) as server:
        host = f"Host: localhost:{server.server_address[1]}\r\n".encode()
        put = b"PUT /road/000001 HTTP/1.1\r\nContent-Length: 9000\r\n" + host + b"\r\n["
        for content, drop in ((b"", b""), (b"", b"G"), (b"GET / HTTP/1.1\r\nA:", b"b"), (put, b" ")):
            with connected(server) as connection:
                connection.sendall(content)
                assert hung_up(connection, drop)
    assert capsys.readouterr().err == ""


def test_the_number_of_connections_is_limited(out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(label_page, "MOST_CONNECTIONS", 3)
    with running(LabelServer(out, tmp_path / "road.json")) as server:
        idle = [connected(server) for _ in range(3)]
        for _ in range(5):
            assert raw(server, b"", end=False).status == 503
        for connection in idle:
            connection.close()
        until = time.monotonic() + 30.0
        while (status := status_of_scenes(server)) != 200 and time.monotonic() < until:
            time.sleep(0.02)
        assert status == 200


def test_connections_wait_while_the_server_is_busy(out: Path, tmp_path: Path) -> None:
    """Of more than five, the others tried again a second later."""
    with LabelServer(out, tmp_path / "road.json") as busy, contextlib.ExitStack() as opened:
        for _ in range(20):
            opened.enter_context(socket.create_connection(("127.0.0.1", busy.server_address[1]), timeout=5.0))


def status_of_scenes(server: LabelServer) -> int | None:
    """None if the connection was closed before the request was read."""
    try:
        return ask(server, "scenes").status
    except (OSError, http.client.HTTPException):
        return None


def test_drawing_undoing_saving_and_reloading_in_a_browser(server: LabelServer, browser: Any) -> None:
    """In a real browser, with mouse and keys. ``EDGEPERC_SCREENSHOTS`` names a folder for screenshots."""

    def saved() -> list[list[list[float]]]:
        return roads(server, "000000")

    page = browser.new_page(viewport={"width": 1400, "height": 900})
    page.set_default_timeout(60_000)
    troubles: list[str] = []
    page.on("pageerror", lambda error: troubles.append(str(error)))
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))

    def look(name: str) -> None:
        if "EDGEPERC_SCREENSHOTS" in os.environ:
            page.screenshot(path=Path(os.environ["EDGEPERC_SCREENSHOTS"]) / f"{name}.png")

    def place(x: float, y: float) -> tuple[float, float]:
        """Position of a pixel of the top view on the screen."""
        shown = page.evaluate(
            "() => { const b = canvas.getBoundingClientRect(); return [b.x, b.y, view.x, view.y, view.scale]; }"
        )
        left, top, view_x, view_y, scale = shown
        return left + view_x + x * scale, top + view_y + y * scale

    def wait_saved(n: int) -> None:
        text = f"Saved 000000: {n} polygon{'s' * (n != 1)}"
        page.wait_for_function(f"() => document.getElementById('saved').textContent === '{text}'")
        assert len(saved()) == n

    page.goto(server.url)
    page.wait_for_selector("body[data-scene='000000']")
    page.wait_for_selector("#camera:visible")
    look("1-opened")

    corners = [(60, 390), (80, 100), (120, 100), (140, 390)]
    for x, y in corners:
        page.mouse.click(*place(x, y))
    look("2-drawing")
    assert saved() == []  # not closed yet
    page.keyboard.press("Backspace")
    page.mouse.click(*place(150, 390))
    page.keyboard.press("Enter")
    wait_saved(1)
    np.testing.assert_allclose(saved()[0], [*corners[:3], (150, 390)], atol=1.0)
    look("3-closed")

    page.keyboard.press("Control+z")
    wait_saved(0)
    page.keyboard.press("Control+y")
    wait_saved(1)

    # A corner is dragged in the zoomed view.
    page.mouse.move(*place(150, 390))
    page.mouse.wheel(0, -400)
    page.wait_for_function("() => view.scale > 3")
    page.mouse.move(*place(150, 390))
    page.mouse.down()
    page.mouse.move(*place(155, 380), steps=4)
    page.mouse.up()
    page.wait_for_function("() => Math.abs(polygons[0][3][0] - 155) < 1")
    wait_saved(1)
    look("4-corner-moved")

    page.keyboard.press("f")
    page.keyboard.press("d")
    page.wait_for_function(
        "() => polygons.length > 1 && /the draft of 000000: [2-9]/.test(document.getElementById('saved').textContent)"
    )
    assert len(saved()) > 1
    assert states(server) == {"000000": "draft"}
    assert read_coco([server.polygons]) == {}
    page.wait_for_selector("#review:visible")
    look("5-draft")
    page.keyboard.press("c")
    page.wait_for_function("() => /Saved 000000: [2-9]/.test(document.getElementById('saved').textContent)")
    assert states(server) == {"000000": "drawn"}
    page.wait_for_selector("#review", state="hidden")
    page.click("#undo")  # the confirmation
    page.wait_for_selector("#review:visible")
    page.click("#undo")  # the draft
    wait_saved(1)
    assert states(server) == {"000000": "drawn"}

    # Dragging the middle of a selected polygon's edge adds a corner, which is then removed.
    page.mouse.click(*place(100, 300))
    page.wait_for_function("() => selected === 0")
    x, y = page.evaluate("() => middles(polygons[0])[1]")
    page.mouse.move(*place(x, y))
    page.mouse.down()
    page.mouse.move(*place(100, 80), steps=4)
    page.mouse.up()
    page.wait_for_function("() => polygons[0].length === 5")
    wait_saved(1)
    np.testing.assert_allclose(saved()[0][2], (100, 80), atol=1.0)
    look("6-edge-bent")
    page.keyboard.down("Shift")
    page.mouse.click(*place(100, 80))
    page.keyboard.up("Shift")
    page.wait_for_function("() => polygons[0].length === 4")
    page.keyboard.press("Escape")

    # A second polygon stays open across a reload; the first one is in the file.
    for x, y in [(10, 50), (40, 50)]:
        page.mouse.click(*place(x, y))
    page.reload()
    page.wait_for_selector("body[data-scene='000000']")
    page.wait_for_function("() => polygons.length === 1 && open.length === 2")
    page.mouse.click(*place(25, 90))
    page.mouse.dblclick(*place(10, 90))
    wait_saved(2)
    assert len(saved()[1]) == 4
    look("7-reloaded")

    page.mouse.click(*place(30, 60))
    page.keyboard.press("Delete")
    wait_saved(1)

    page.keyboard.press("ArrowRight")
    page.wait_for_selector("body[data-scene='000001']")
    page.wait_for_selector("#no-camera:visible")
    page.keyboard.press("4")
    look("8-next-scene")
    page.keyboard.press("ArrowLeft")
    page.wait_for_selector("body[data-scene='000000']")
    page.wait_for_function("() => polygons.length === 1")
    assert not troubles
    assert all(url.startswith((server.url, "data:")) for url in asked)
    (road,) = read_coco([server.polygons]).values()
    assert mask_of(road)[250, 100] == 1


def test_the_page_works_by_the_name_localhost(server: LabelServer, browser: Any) -> None:
    page = browser.new_page()
    page.goto(server.url.replace("127.0.0.1", "localhost"))
    page.wait_for_selector("body[data-scene='000000']")
    page.keyboard.press("d")
    page.wait_for_function("() => /^Saved the draft/.test(document.getElementById('saved').textContent)")
    page.click("#confirm")
    page.wait_for_function("() => /^Saved 000000/.test(document.getElementById('saved').textContent)")
    assert page.text_content("#count") == "1 of 8 scenes drawn"
    page.close()
    assert states(server) == {"000000": "drawn"}


class OtherSite(http.server.BaseHTTPRequestHandler):
    """A page of another server of this computer; a browser does not let other computers' pages ask this one at all."""

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.end_headers()
        self.wfile.write(b"<!doctype html><title>another site</title><body>")

    def log_message(self, *_: Any) -> None: ...


def test_other_sites_cannot_frame_read_or_write(server: LabelServer, browser: Any) -> None:
    page = browser.new_page()
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), OtherSite) as other:
        threading.Thread(target=other.serve_forever, args=(0.02,)).start()
        page.goto(f"http://127.0.0.1:{other.server_address[1]}/")
        other.shutdown()
    page.evaluate(
        """url => new Promise(done => {
            const frame = document.createElement("iframe");
            frame.onload = () => setTimeout(done, 300);
            frame.src = url;
            document.body.append(frame);
        })""",
        server.url,
    )
    (frame,) = page.main_frame.child_frames
    assert "Road polygons" not in frame.content()
    attempt = """async ([url, init]) => {
        try { const answer = await fetch(url, init); return [answer.type, answer.status]; }
        catch (error) { return ["failed", 0]; }
    }"""
    sent = {"Content-Type": "application/json", TOKEN: server.token}
    for init in (
        {"method": "PUT", "body": ROAD, "headers": sent},
        {"method": "PUT", "body": ROAD},
        {"method": "POST", "body": ROAD, "mode": "no-cors"},
    ):
        kind, _ = page.evaluate(attempt, [f"{server.url}road/000001", init])
        assert kind in ("failed", "opaque")
    assert page.evaluate(attempt, [f"{server.url}scenes", {}]) == ["failed", 0]
    width = """url => new Promise(done => {
        const image = new Image();
        image.onload = image.onerror = () => done(image.naturalWidth);
        image.src = url;
    })"""
    assert page.evaluate(width, f"{server.url}image/000001") == 0
    page.goto(server.url)  # not blocked
    page.wait_for_selector("body[data-scene='000000']")
    assert page.evaluate(width, f"{server.url}image/000001") == 200
    page.close()
    assert not server.polygons.exists()


@pytest.mark.skipif(os.name != "posix", reason="elsewhere files cannot have these names")
def test_names_of_scenes_are_only_text(out: Path, tmp_path: Path, browser: Any) -> None:
    hostile = {
        "000001": "<img src=x onerror='window.stolen=1'>",
        "000002": "\"'<svg onload=window.stolen=1>",
        "000003": "\u202egpj@@TOKEN@@ #?%2e&\n",
    }
    shutil.copytree(out, tmp_path / "out")
    rows = [{**row, "scene": hostile.get(row["scene"], row["scene"])} for row in TopViewDatabase(out).rows]
    for row in rows:
        row["drive"] = "<script>window.stolen=1</script>"
    for old, new in hostile.items():
        for folder, suffix in (("images", "png"), ("labels", "txt"), ("maps", "png")):
            (tmp_path / "out" / folder / f"{old}.{suffix}").rename(tmp_path / "out" / folder / f"{new}.{suffix}")
    with (tmp_path / "out/index.csv").open("w", newline="") as file:
        index = csv.DictWriter(file, rows[0])
        index.writeheader()
        index.writerows(rows)
    known = json.loads((out / "manifest.json").read_text())
    known["sha256"]["index.csv"] = hashlib.sha256((tmp_path / "out/index.csv").read_bytes()).hexdigest()
    (tmp_path / "out/manifest.json").write_text(json.dumps(known))
    with running(LabelServer(tmp_path / "out", tmp_path / "road.json")) as server:
        page = browser.new_page()
        page.goto(server.url)
        page.wait_for_selector("body[data-scene]")
        listed = page.evaluate(
            "[...document.querySelectorAll('nav button')].map(button => button.firstChild.textContent)"
        )
        assert set(map(printable, hostile.values())) < set(listed)
        assert server.token not in str(listed)
        for k, row in enumerate(rows):
            page.click(f"nav button >> nth={k}")
            page.wait_for_function("name => document.body.dataset.scene === name", arg=row["scene"])
            assert page.text_content("h1") == f"{printable(row['scene'])} {row['drive']}, {row['split']}"
            assert page.evaluate("window.stolen") is None
            page.keyboard.press("d")
            page.wait_for_function("() => /^(Saved|The model)/.test(document.getElementById('saved').textContent)")
        page.close()
        assert {*hostile.values()} & {*server.drafts}
