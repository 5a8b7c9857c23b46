"""A file that a library writes from native code, where an exception would be lost."""

from __future__ import annotations

from typing import Any


class KeptFile:
    """A file that keeps its first error. The SDK only logs errors of a file, and a panic follows some."""

    def __init__(self, file: Any) -> None:
        self._file = file
        self._error: OSError | None = None

    def check(self) -> None:
        """Raise the error, if there was one."""
        if self._error is not None:
            raise OSError(self._error.errno, self._error.strerror)

    def write(self, data: bytes) -> int:
        """Write, unless there was an error; the number of bytes given."""
        try:
            if self._error is None:
                self._file.write(data)
        except OSError as exc:
            self._error = exc
        return len(data)

    def seek(self, offset: int, whence: int = 0) -> int:
        """As of a file."""
        return int(self._file.seek(offset, whence))

    def flush(self) -> None:
        """As of a file, unless there was an error."""
        try:
            if self._error is None:
                self._file.flush()
        except OSError as exc:
            self._error = exc
