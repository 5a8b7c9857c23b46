"""Sensor files and captures to points: one module a family of formats.

`files` knows a file by its content and suffix and calls the parser; `captures` reads packet captures and bags.
"""

from __future__ import annotations

__all__: list[str] = []
