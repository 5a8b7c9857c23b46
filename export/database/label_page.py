"""A local web page to draw roads over a database's images (section 3.3).

Only this computer can open the page, and the page loads nothing from the network. Each change is saved to the COCO
file, where roads stay that another program writes meanwhile. A model's draft counts as drawn only after it is
confirmed: until then its polygons are in the file's ``drafts``, and no road of the scene is in the annotations. Pages
of other sites, which a browser on this computer may have open, can neither read nor write: a request must name this
server as its host, and a write also needs the page's origin and its token. No site can show the page in a frame.
Requests are limited in size, number and time.
"""

from __future__ import annotations

import contextlib
import http.client
import json
import secrets
import socket
import sys
import threading
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from pathlib import Path
from typing import Any, cast
from urllib.parse import unquote

from edgeperc.cli.output import print_error
from edgeperc.errors import EdgepercError
from edgeperc.system.atomic import write_atomic
from edgeperc.system.fields import Fields
from edgeperc.system.printable import printable

from ..data.roads import HEIGHT, ROAD, WIDTH, DatabaseError, read_coco, write_coco
from .coco import draft, scans_of
from .files import TopViewDatabase

PICTURES = {".png": "image/png", ".jpg": "image/jpeg", ".jpeg": "image/jpeg", ".webp": "image/webp"}
LARGEST_BODY = 1_000_000  # bytes; about 60,000 corners
LARGEST_HEAD = 32_768  # bytes of all header lines; a browser sends the cookies of every server on this computer
MOST_CONNECTIONS = 32  # a browser opens six
REQUEST_S = 20.0  # to receive, answer and send

TOKEN = "X-Edgeperc-Token"
EXPECTED = f"expected a list of polygons, each of three corners [x, y] or more, with 0..{WIDTH} x 0..{HEIGHT} pixels"
_FIELDS = Fields("a drawing", ValueError)

# The page may use its own script and style, marked with a nonce, and pictures and data of this server only.
POLICY = (
    "default-src 'none'; script-src 'nonce-{0}'; style-src 'nonce-{0}'; img-src 'self' data:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
HEADERS = {
    "Cache-Control": "no-store",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}


class LabelServer(ThreadingHTTPServer):
    """The server of the page on 127.0.0.1, at ``url``: it answers to ``hosts`` alone and writes the COCO file, if a
    header has ``token``. A scene is in ``roads`` or, unconfirmed, in ``drafts``. Raises DatabaseError, OSError.
    """

    daemon_threads = True
    request_queue_size = 64  # of more than 5 at once, which is the default, the others would try again after a second

    def __init__(self, root: Path, polygons: Path, *, kitti: Path | None = None, port: int = 0) -> None:
        self.database = TopViewDatabase(root)
        self.names = {*self.database.names}
        self.polygons, self.kitti = polygons, kitti
        self.lock = threading.Lock()
        self.roads, self.drafts = dict[str, list[Any]](), dict[str, list[Any]]()
        self.scans = {row["scene"]: row["scan_sha256"] for row in self.database.rows}
        self.content = b""  # of the file, as it was last read or written
        self.read()
        self.changed = set[str]()  # scenes that another program has changed since the page asked for them
        self.token = secrets.token_urlsafe(32)
        self.slots = threading.BoundedSemaphore(MOST_CONNECTIONS)
        super().__init__(("127.0.0.1", port), _Handler)
        taken = self.server_address[1]
        self.url = f"http://127.0.0.1:{taken}/"
        self.hosts = {
            f"{name}{end}" for name in ("127.0.0.1", "localhost") for end in (f":{taken}", "")[: 1 + (taken == 80)]
        }

    def read(self) -> set[str]:
        """Read the file if another program has written it; returns the scenes with other polygons than before."""
        content = self.polygons.read_bytes() if self.polygons.is_file() else self.content
        if content == self.content:
            return set()
        roads, drafts = _polygons(self.polygons)
        self.scans |= scans_of(self.polygons, self.scans)
        before, self.roads, self.drafts, self.content = (self.roads, self.drafts), roads, drafts, content
        pairs = [*zip(before, (roads, drafts), strict=True)]
        return {name for old, new in pairs for name in old.keys() | new.keys() if old.get(name) != new.get(name)}

    def polygons_of(self, name: str) -> list[Any]:
        """A scene's polygons, drawn or a draft, as the file has them now."""
        with self.lock:
            self.changed = (self.changed | self.read()) - {name}
            return self.roads.get(name) or self.drafts.get(name, [])

    def save(self, name: str, polygons: list[Any], *, confirmed: bool) -> None:
        """Set a scene's polygons, drawn or a draft, and write the file."""
        with self.lock:
            self.changed |= self.read()
            if name in self.changed:
                text = f"another program has changed this scene in {self.polygons}; reload the page to see it"
                raise _RefusedError(HTTPStatus.CONFLICT, text)
            roads, drafts = ({k: v for k, v in known.items() if k != name} for known in (self.roads, self.drafts))
            if polygons:
                (roads if confirmed else drafts)[name] = polygons
            content = json.loads(write_coco(roads, self.scans))
            if drafts:
                content["drafts"] = drafts
            written = (json.dumps(content, indent=1) + "\n").encode()
            write_atomic(self.polygons, written)
            self.roads, self.drafts, self.content = roads, drafts, written

    def state(self, name: str) -> str:
        """``"drawn"``, ``"draft"``, or ``""`` for a scene without polygons."""
        return "drawn" if name in self.roads else "draft" if name in self.drafts else ""

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer in a thread; refuse the connection if too many are open."""
        if self.slots.acquire(blocking=False):
            try:
                super().process_request(request, client_address)
            except BaseException:
                self.slots.release()
                raise
        else:
            with contextlib.suppress(OSError):
                request.sendall(b"HTTP/1.0 503 Service Unavailable\r\nRetry-After: 1\r\nContent-Length: 0\r\n\r\n")
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Answer one connection, and close it when its time is over."""
        limit = threading.Timer(REQUEST_S, _hang_up, (request,))
        limit.daemon = True
        limit.start()
        try:
            super().process_request_thread(request, client_address)
        finally:
            limit.cancel()
            self.slots.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Print an error, but not that the browser closed a connection."""
        exc = sys.exc_info()[1]
        if not isinstance(exc, (ConnectionError, TimeoutError)):
            print_error(f"a request failed: {exc!r}", "edgeperc-export")


def _hang_up(connection: socket.socket) -> None:
    with contextlib.suppress(OSError):  # it may be closed already
        connection.shutdown(socket.SHUT_RDWR)


def _polygons(path: Path) -> tuple[dict[str, list[Any]], dict[str, list[Any]]]:
    """Scene -> polygons, and scene -> polygons of its draft."""
    roads = {}
    for name, segmentations in read_coco([path]).items():
        if not all(isinstance(each, list) for each in segmentations):
            raise DatabaseError(f"{path} has run lengths for {name}; the page edits polygons only; give another file")
        rings = [ring for each in segmentations for ring in each]
        roads[name] = [[[float(x), float(y)] for x, y in zip(ring[::2], ring[1::2], strict=True)] for ring in rings]
    content = json.loads(path.read_text())
    drawn = {annotation["category_id"] for annotation in content["annotations"]}
    named = {str(category["name"]) for category in content["categories"] if category["id"] in drawn}
    if others := sorted(name for name in named if name.lower() not in ROAD):
        raise DatabaseError(
            f"{path} has annotations of {', '.join(others)}, which the page would drop when it saves; give a copy "
            "that has roads alone"
        )
    try:
        drafts = {name: _clamped(rings) for name, rings in content.get("drafts", {}).items()}
    except (AttributeError, TypeError, _RefusedError) as exc:
        raise DatabaseError(f"{path} has drafts that are no polygons ({exc}); expected them by scene") from exc
    return roads, {name: rings for name, rings in drafts.items() if rings and name not in roads}


class _RefusedError(Exception):
    """A request is answered with a status and a text."""

    def __init__(self, status: HTTPStatus, text: str) -> None:
        super().__init__(text)
        self.status = status


class _Head:
    """The header lines of a request, up to `LARGEST_HEAD` bytes."""

    def __init__(self, file: Any) -> None:
        self.file, self.left = file, LARGEST_HEAD

    def readline(self, limit: int) -> bytes:
        line: bytes = self.file.readline(min(limit, self.left + 1))
        self.left -= len(line)
        if self.left < 0:
            raise http.client.LineTooLong(f"headers of more than {LARGEST_HEAD:,} bytes")
        return line


class _Handler(BaseHTTPRequestHandler):
    server: LabelServer
    server_version, sys_version = "edgeperc-export", ""

    def parse_request(self) -> bool:
        whole, self.rfile = self.rfile, cast(Any, _Head(self.rfile))
        try:
            return super().parse_request()
        finally:
            self.rfile = whole

    def do_GET(self) -> None:
        self._answer(self._get)

    def do_PUT(self) -> None:
        """Set the polygons of a scene, ``road`` or an unconfirmed ``draft``: corners [x, y] in pixels of the image."""
        self._answer(self._put)

    def _answer(self, method: Callable[[str, str], None]) -> None:
        try:
            hosts = self.headers.get_all("Host", [])
            if len(hosts) != 1 or hosts[0].lower() not in self.server.hosts:
                # A site can give its own name the address of this computer.
                raise _RefusedError(
                    HTTPStatus.FORBIDDEN, f"this server is called {' or '.join(sorted(self.server.hosts))}"
                )
            what, _, name = unquote(self.path.partition("?")[0]).lstrip("/").partition("/")
            method(what, name)
        except _RefusedError as exc:
            self.send_error(exc.status, str(exc))
        except (ConnectionError, TimeoutError):
            raise
        except (EdgepercError, OSError) as exc:
            print_error(exc, "edgeperc-export")
            self.send_error(HTTPStatus.INTERNAL_SERVER_ERROR, str(exc))

    def _get(self, what: str, name: str) -> None:
        server = self.server
        if what == "":
            nonce = secrets.token_urlsafe(16)
            page = resources.files(__package__).joinpath("label_page.html").read_text(encoding="utf-8")
            page = page.replace("@@NONCE@@", nonce).replace("@@TOKEN@@", server.token)
            return self._send("text/html; charset=utf-8", page.encode(), policy=POLICY.format(nonce))
        if self.headers.get("Sec-Fetch-Site", "none") not in ("same-origin", "none"):
            raise _RefusedError(HTTPStatus.FORBIDDEN, "another site asked for it")
        if what == "scenes":
            return self._send_json(
                [
                    {
                        "name": row["scene"],
                        "title": printable(row["scene"]),
                        "drive": printable(row["drive"]),
                        "split": printable(row["split"]),
                        "state": server.state(row["scene"]),
                    }
                    for row in server.database.rows
                ]
            )
        if name in server.names:
            if what == "image":
                return self._send("image/png", (server.database.root / "images" / f"{name}.png").read_bytes())
            if what == "camera" and server.kitti is not None:
                for suffix, kind in PICTURES.items():
                    path = server.kitti / "training/image_2" / f"{name}{suffix}"
                    if path.exists():
                        return self._send(kind, path.read_bytes())
            if what == "draft":
                return self._send_json(draft(server.database.scene(name).map))
            if what == "road":
                return self._send_json(server.polygons_of(name))
        raise _RefusedError(HTTPStatus.NOT_FOUND, "there is no such thing here")

    def _put(self, what: str, name: str) -> None:
        body = self._body()  # read in any case: a connection closed with unread data may lose the answer
        if self.headers.get("Origin") not in {f"http://{host}" for host in self.server.hosts}:
            raise _RefusedError(HTTPStatus.FORBIDDEN, "only the page of this server can write")
        if self.headers.get("Sec-Fetch-Site", "same-origin") != "same-origin":
            raise _RefusedError(HTTPStatus.FORBIDDEN, "another site asked for it")
        if not secrets.compare_digest(self.headers.get(TOKEN, "").encode(), self.server.token.encode()):
            raise _RefusedError(HTTPStatus.FORBIDDEN, "the page belongs to an earlier start of this server; reload it")
        if self.headers.get_content_type() != "application/json":
            raise _RefusedError(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "expected application/json")
        if what not in ("road", "draft") or name not in self.server.names:
            raise _RefusedError(HTTPStatus.NOT_FOUND, "there is no such scene")
        try:
            polygons = _clamped(json.loads(body))
        except (ValueError, RecursionError) as exc:
            raise _RefusedError(HTTPStatus.BAD_REQUEST, f"not JSON ({str(exc)[:200]}); {EXPECTED}") from exc
        self.server.save(name, polygons, confirmed=what == "road")
        self._send_json(len(polygons))

    def _body(self) -> bytes:
        lengths = self.headers.get_all("Content-Length", [])
        if not lengths or "Transfer-Encoding" in self.headers:
            raise _RefusedError(HTTPStatus.LENGTH_REQUIRED, "expected a Content-Length and no Transfer-Encoding")
        (length,) = lengths if len(lengths) == 1 else [""]
        if not (length.isascii() and length.isdigit()):
            raise _RefusedError(HTTPStatus.BAD_REQUEST, "Content-Length is not one number of bytes")
        if len(length) > 18 or int(length) > LARGEST_BODY:
            raise _RefusedError(
                HTTPStatus.REQUEST_ENTITY_TOO_LARGE,
                f"the body has more than {LARGEST_BODY:,} bytes; draw fewer corners",
            )
        body = self.rfile.read(int(length))
        if len(body) < int(length):
            raise _RefusedError(HTTPStatus.BAD_REQUEST, f"the body ends after {len(body)} of {length} bytes")
        return body

    def _send_json(self, value: Any) -> None:
        self._send("application/json", json.dumps(value).encode())

    def _send(
        self,
        kind: str,
        content: bytes,
        status: int = HTTPStatus.OK,
        policy: str = "default-src 'none'; frame-ancestors 'none'",
    ) -> None:
        self.send_response(status)
        headers = {"Content-Type": kind, "Content-Length": str(len(content)), "Content-Security-Policy": policy}
        for name, value in (headers | HEADERS).items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(content)

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Answer with a status and a line of text; http.server calls this for malformed requests."""
        self.close_connection = True
        text = printable(message or HTTPStatus(code).phrase)
        self._send("text/plain; charset=utf-8", f"{text}\n".encode(), code)

    def log_message(self, *_: Any) -> None:
        """Log no requests."""


def _clamped(content: Any) -> list[list[list[float]]]:
    """Polygons as JSON has them, inside the image, rounded to 0.01 pixels."""
    try:
        rings = _FIELDS.read(tuple[tuple[tuple[float, float], ...], ...], content, "polygons")
    except ValueError as exc:
        raise _RefusedError(HTTPStatus.BAD_REQUEST, f"{exc}; {EXPECTED}") from exc
    if any(len(ring) < 3 for ring in rings):
        raise _RefusedError(HTTPStatus.BAD_REQUEST, f"a polygon has fewer than three corners; {EXPECTED}")
    size = WIDTH, HEIGHT
    return [
        [[round(min(max(v, 0.0), most), 2) for v, most in zip(corner, size, strict=True)] for corner in ring]
        for ring in rings
    ]
