"""A local web page to draw roads over a database's images (section 3.3).

Only this computer can open the page, and the page loads nothing from the network. Each change is saved to the COCO
file.
"""

from __future__ import annotations

import json
import math
import threading
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from edgeperc.atomic import write_atomic

from ..roads import HEIGHT, WIDTH, DatabaseError, read_coco, write_coco
from .coco import draft
from .files import TopViewDatabase

__all__ = ["LabelServer"]

PICTURES = {".png": "image/png", ".jpg": "image/jpeg", ".jpeg": "image/jpeg", ".webp": "image/webp"}
LARGEST_REQUEST = 4_000_000

# The page may use its own script and style, and pictures and data of this server only.
POLICY = "default-src 'none'; img-src 'self'; connect-src 'self'; script-src 'unsafe-inline'; style-src 'unsafe-inline'"


class LabelServer(ThreadingHTTPServer):
    """The server of the page, on 127.0.0.1; ``serve_forever`` runs it.

    Parameters
    ----------
    root : Path
        A finished database.
    polygons : Path
        COCO file to write; its polygons are read if it exists.
    kitti : Path, optional
        Object set whose ``training/image_2`` holds camera pictures.
    port : int
        0 takes any free port.

    Attributes
    ----------
    url : str
        Address of the page.

    Raises
    ------
    DatabaseError
        ``root`` is not a finished database, or ``polygons`` holds run lengths, which the page cannot draw.
    OSError
        The port is taken.
    """

    daemon_threads = True

    def __init__(self, root: Path, polygons: Path, *, kitti: Path | None = None, port: int = 0) -> None:
        self.database = TopViewDatabase(root)
        self.names = {*self.database.names}
        self.polygons, self.kitti = polygons, kitti
        self.lock = threading.Lock()
        self.roads, scans = _polygons(polygons) if polygons.exists() else ({}, {})
        self.scans = scans | {row["scene"]: row["scan_sha256"] for row in self.database.rows}
        super().__init__(("127.0.0.1", port), _Handler)
        self.url = f"http://127.0.0.1:{self.server_address[1]}/"

    def save(self, name: str, polygons: list[Any]) -> None:
        """Set a scene's polygons and write the file."""
        with self.lock:
            self.roads.pop(name, None)
            if polygons:
                self.roads[name] = polygons
            write_atomic(self.polygons, write_coco(self.roads, self.scans).encode())


def _polygons(path: Path) -> tuple[dict[str, list[Any]], dict[str, str]]:
    """Scene -> polygons, and scene -> hash of its scan."""
    roads = {}
    for name, segmentations in read_coco([path]).items():
        if not all(isinstance(each, list) for each in segmentations):
            raise DatabaseError(f"{path} has run lengths for {name}; the page edits polygons only; give another file")
        rings = [ring for each in segmentations for ring in each]
        roads[name] = [[[x, y] for x, y in zip(ring[::2], ring[1::2], strict=True)] for ring in rings]
    images = json.loads(path.read_text())["images"]
    return roads, {Path(image["file_name"]).stem: image["scan"] for image in images if "scan" in image}


class _Handler(BaseHTTPRequestHandler):
    server: LabelServer

    def do_GET(self) -> None:
        # Pages of other sites can reach this address under their own host name; they are refused.
        if self.headers.get("Host") != urlsplit(self.server.url).netloc:
            return self.send_error(HTTPStatus.FORBIDDEN)
        what, _, name = unquote(urlsplit(self.path).path).lstrip("/").partition("/")
        database = self.server.database
        if what == "":
            return self._send(
                "text/html; charset=utf-8", resources.files(__package__).joinpath("label_page.html").read_bytes()
            )
        if what == "scenes":
            return self._send_json(
                [
                    {
                        "name": r["scene"],
                        "drive": r["drive"],
                        "split": r["split"],
                        "drawn": r["scene"] in self.server.roads,
                    }
                    for r in database.rows
                ]
            )
        if name not in self.server.names:
            return self.send_error(HTTPStatus.NOT_FOUND)
        if what == "image":
            return self._send("image/png", (database.root / "images" / f"{name}.png").read_bytes())
        if what == "camera" and self.server.kitti is not None:
            for suffix, kind in PICTURES.items():
                path = self.server.kitti / "training/image_2" / f"{name}{suffix}"
                if path.exists():
                    return self._send(kind, path.read_bytes())
        if what == "draft":
            return self._send_json(draft(database.scene(name).map))
        if what == "road":
            return self._send_json(self.server.roads.get(name, []))
        return self.send_error(HTTPStatus.NOT_FOUND)

    def do_PUT(self) -> None:
        """Set the polygons of a scene: corners [x, y] in pixels of the image."""
        if self.headers.get("Host") != urlsplit(self.server.url).netloc:
            return self.send_error(HTTPStatus.FORBIDDEN)
        what, _, name = unquote(urlsplit(self.path).path).lstrip("/").partition("/")
        length = int(self.headers.get("Content-Length") or 0)
        # Pages of other sites cannot send JSON: the browser asks this server for permission first, and is refused.
        json_sent = self.headers.get("Content-Type") == "application/json"
        if what != "road" or name not in self.server.names:
            return self.send_error(HTTPStatus.NOT_FOUND)
        if not json_sent or length > LARGEST_REQUEST:
            return self.send_error(HTTPStatus.BAD_REQUEST)
        try:
            polygons = json.loads(self.rfile.read(length))
            clamped = [[[_within(x, WIDTH), _within(y, HEIGHT)] for x, y in corners] for corners in polygons]
            if any(len(corners) < 3 for corners in clamped):
                raise ValueError("a polygon has fewer than three corners")
        except (ValueError, TypeError) as exc:
            return self.send_error(HTTPStatus.BAD_REQUEST, str(exc).splitlines()[0])
        self.server.save(name, clamped)
        return self._send_json(len(clamped))

    def _send_json(self, value: Any) -> None:
        self._send("application/json", json.dumps(value).encode())

    def _send(self, kind: str, content: bytes) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("Content-Security-Policy", POLICY)
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, *_: Any) -> None:
        """Log no requests."""


def _within(value: float, limit: int) -> float:
    """A coordinate clamped to 0..limit, rounded to 0.01 pixels."""
    if isinstance(value, bool) or not math.isfinite(value):
        raise ValueError(f"a corner has the coordinate {value}")
    return round(min(max(float(value), 0.0), float(limit)), 2)
