"""Scans and results at URLs that fsspec reads and writes, such as ``s3://bucket/scans``."""

from __future__ import annotations

import posixpath
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from ..errors import EdgepercError, OptionError, PointsError
from .extras import require
from .names import by_number

MOST_BYTES = 4 * 2**30
"""Largest file that is fetched: a scan or a capture."""


def location(text: str) -> Path | Remote:
    """A path of this computer, also from ``file://``, ports of it (``udp:2368``), or a URL."""
    if text.startswith("file://"):
        return Path(unquote(urlsplit(text).path))
    return Remote(text.rstrip("/")) if "://" in text and not text.startswith("udp:") else Path(text)


@dataclass(frozen=True)
class Remote:
    """A file or folder at a URL; names and ``/`` work as for a `pathlib.Path`. Every method may raise `OSError`, with
    the URL in the message, `MissingExtraError` without fsspec, and `OptionError` for an unknown protocol.
    """

    url: str  # as fsspec has it. Its package for the protocol must be installed, e.g. s3fs for ``s3://``.

    def __str__(self) -> str:
        return self.url

    @property
    def name(self) -> str:
        """The last part."""
        return posixpath.basename(self.url)

    @property
    def suffix(self) -> str:
        """The ending of the name, with its dot."""
        return posixpath.splitext(self.name)[1]

    @property
    def parent(self) -> Remote:
        """The folder."""
        return Remote(posixpath.dirname(self.url))

    @property
    def place(self) -> str:
        """The URL as an absolute path, without its protocol."""
        return f"/{self.url.partition('://')[2]}"

    def __truediv__(self, name: str | Path) -> Remote:
        """A file or folder in this folder."""
        return Remote(f"{self.url}/{Path(name).as_posix()}")

    def with_name(self, name: str) -> Remote:
        """Another file in the same folder."""
        return self.parent / name

    def files(self, suffixes: Collection[str]) -> list[Remote]:
        """This file, or the files with these suffixes anywhere below this folder, sorted, without hidden ones."""
        with self._system() as (system, path):
            names = [file.removeprefix(path) for file in sorted(system.find(path), key=by_number)]
        return [
            Remote(self.url + inside)
            for inside in names
            if not inside or (posixpath.splitext(inside)[1].lower() in suffixes and "/." not in inside)
        ]

    def stamp(self) -> tuple[int, str] | None:
        """Size in bytes, and what changes whenever the file does; None if there is no such file."""
        try:
            with self._system() as (system, path):
                info = system.info(path)
        except FileNotFoundError:
            return None
        version = next(
            (str(info[key]) for key in ("ETag", "etag", "LastModified", "created", "mtime") if key in info), ""
        )
        return int(info["size"] or 0), version

    def read_bytes(self) -> bytes:
        """The content."""
        with self._system() as (system, path):
            return bytes(system.cat_file(path))

    def write_bytes(self, content: bytes) -> None:
        """Write or replace the file. An object store shows the whole file or nothing; other protocols may not."""
        with self._system() as (system, path):
            try:
                system.pipe_file(path, content)
            except FileNotFoundError:  # a protocol with real folders
                system.makedirs(posixpath.dirname(path), exist_ok=True)
                system.pipe_file(path, content)

    def fetch(self, folder: Path) -> Path:
        """Copy the file into a local folder."""
        stamp = self.stamp()
        if stamp is None:
            raise PointsError(f"{self}: there is no such file; expected a scan or a capture")
        if stamp[0] > MOST_BYTES:
            raise PointsError(
                f"{self}: {stamp[0]:,} bytes are not fetched; expected at most {MOST_BYTES:,}. Copy the file, and pass "
                "its path"
            )
        target = folder / self.name
        with self._system() as (system, path):
            system.get_file(path, str(target))
        return target

    @contextmanager
    def _system(self) -> Iterator[tuple[Any, str]]:
        """The file system, and the path in it."""
        core = require("fsspec.core", "remote", f"Reading or writing {self.url}")
        try:
            system, path = core.url_to_fs(self.url)
        except ImportError as exc:  # fsspec names the package, e.g. s3fs
            protocol = self.url.partition("://")[0]
            raise OptionError(f"{self}: fsspec has no package for {protocol}:// ({exc}); install it with pip") from exc
        except ValueError as exc:
            raise OptionError(f"{self}: {exc}; expected a path, or a URL such as s3://bucket/scans") from exc
        except OSError as exc:  # ftp:// connects here
            raise OSError(f"{self}: {type(exc).__name__}: {exc}") from exc
        try:
            yield system, path
        except EdgepercError:
            raise
        except FileNotFoundError as exc:
            raise FileNotFoundError(f"{self}: {exc}") from exc
        except Exception as exc:  # credentials, network, permissions: each package has errors of its own
            raise OSError(f"{self}: {type(exc).__name__}: {exc}") from exc
