"""Files of a run: those of its scans, and one of the whole run, which has its name only if it is whole."""

from __future__ import annotations

import os
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from threading import Thread

from ..errors import OptionError
from ..system.atomic import beside, name_part, name_whole, write_atomic


class ScanFiles:
    """The files of one run in one folder: each scan has its own, and none replaces a scan."""

    def __init__(self) -> None:
        self._sources: dict[Path, str] = {}

    def checked(self, target: Path, scan: str) -> Path:
        """Return ``target`` for the scan of this name; OptionError if it is the scan itself, or another one's file."""
        if os.path.realpath(target) == os.path.realpath(scan):
            raise OptionError(f"{target} is the scan itself and would be overwritten; choose another folder")
        source = self._sources.setdefault(target, scan)
        if source != scan:
            raise OptionError(f"{target} is already the file of {source}; run each folder of scans by itself")
        return target

    def write(self, target: Path, scan: str, content: bytes) -> None:
        """Write the file of a scan, in place of none with other content; OptionError as `checked`, OSError."""
        if self.checked(target, scan).exists() and target.read_bytes() != content:  # a drive's only copy, hours of work
            raise OptionError(
                f"{target} exists with other content, perhaps corrected by hand or of another drive, and stays; "
                "choose another folder, or delete it"
            )
        write_atomic(target, content)


class RunFile:
    """A file for native code, where an exception would be lost: it keeps the first error for `check`. It lies beside
    its place until `close`, and stays ``NAME.part`` if it is not whole; a special file is written directly.
    """

    def __init__(self, path: Path) -> None:
        self._path = Path(os.path.realpath(path))
        self._is_special = self._path.exists() and not self._path.is_file()
        self.place = self._path if self._is_special else beside(self._path)
        self._file = self.place.open("wb" if self._is_special else "xb")
        self._error: OSError | None = None
        self._is_told = False
        self._at = self._end = 0

    def check(self) -> None:
        """Raise the error, if there was one."""
        if self._error is not None:
            self._is_told = True
            raise OSError(self._error.errno, self._error.strerror, str(self._path))

    def fail(self, error: OSError) -> None:
        """Count as failed, unless an earlier error is known."""
        self._error = self._error or error

    def write(self, data: bytes) -> int:
        """Write, unless there was an error; the number of bytes given."""
        self._unless_failed(self._file.write, data)
        self._at += len(data)
        self._end = max(self._end, self._at) if data else self._end
        return len(data)

    def seek(self, offset: int, whence: int = 0) -> int:
        """Move to where a file without an error would be."""
        self._at = offset + (0, self._at, self._end)[whence]
        self._unless_failed(self._file.seek, self._at)
        return self._at

    def tell(self) -> int:
        """Where a file without an error would be."""
        return self._at

    def flush(self) -> None:
        """As of a file, unless there was an error."""
        self._unless_failed(self._file.flush)

    def _unless_failed(self, act: Callable[..., object], *given: object) -> None:
        if self._error is None:
            try:
                act(*given)
            except OSError as exc:
                self.fail(exc)

    def close(self, whole: bool = True) -> None:
        """Give the file its name, or that of a part if the run ended before its last scan. Raises OSError, once."""
        try:
            self.flush()
            self._file.close()
        except OSError as exc:  # of what is still in its buffer; the file is closed nevertheless
            self.fail(exc)
        if not self._is_special:
            try:
                settle(self.place, self._path, whole and self._error is None)
            except OSError as exc:
                self.fail(exc)
        if not self._is_told:
            self.check()


def settle(temporary: Path, path: Path, whole: bool) -> None:
    """Give what a run has written its name, or leave it as a part and warn; OSError if it could not be written so."""
    try:
        if whole:
            name_whole(temporary, path)
    finally:
        if temporary.exists():
            warn_of(name_part(temporary, path), path)


def warn_of(part: Path, path: Path) -> None:
    """Warn that a part was left."""
    warnings.warn(f"{path} was not written to its end; what there is of it is {part}", RuntimeWarning, stacklevel=2)


class Pipe:
    """A named pipe that a thread empties into a file, for a library that waits for ever if it cannot write its own."""

    def __init__(self, file: RunFile) -> None:
        self._file = file
        self._folder = tempfile.TemporaryDirectory(prefix="edgeperc-")
        self.path = Path(self._folder.name) / "pipe"
        os.mkfifo(self.path, 0o600)
        self._reader = os.open(self.path, os.O_RDONLY | os.O_NONBLOCK)  # so that who opens it to write need not wait
        os.set_blocking(self._reader, True)
        self._thread = Thread(target=self._empty, name="edgeperc-pipe", daemon=True)

    def start(self) -> None:
        """Begin, as soon as the library has opened the path."""
        self._folder.cleanup()
        self._thread.start()

    def ends(self, patience_s: float) -> bool:
        """Wait until the library has closed the pipe, and all is in the file; False if it takes longer."""
        self._thread.join(patience_s)
        return not self._thread.is_alive()

    def _empty(self) -> None:
        try:
            while data := os.read(self._reader, 1 << 20):
                self._file.write(data)
        finally:
            os.close(self._reader)
