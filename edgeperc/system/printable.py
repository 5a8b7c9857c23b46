"""Texts from outside (names of files, models and classes, messages) made safe to show in a terminal or on a page."""

from __future__ import annotations


def printable(text: object) -> str:
    r"""Show characters that are not printable as ``\uXXXX``.

    These are control characters and escape sequences of terminals, line breaks, marks that reorder text (a file name
    can look like another one), zero-width characters, and bytes of a file name that are not UTF-8 (``\udcXX``).

    Returns one line, for which `str.isprintable` is true. JSON text stays the same JSON: where it may hold such a
    character (DEL, in a string), ``\uXXXX`` is the character's escape.
    """
    shown = str(text)
    if shown.isprintable():
        return shown
    return "".join(
        c if c.isprintable() else f"\\u{ord(c):04x}" if ord(c) < 0x10000 else f"\\U{ord(c):08x}" for c in shown
    )


def many(n: int, noun: str) -> str:
    """A count and its noun, singular or plural."""
    return f"{n:,} {noun}{'s' * (n != 1)}"
