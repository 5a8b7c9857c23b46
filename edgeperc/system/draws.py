"""Random numbers of kernels: a linear congruential generator, the same on every computer."""

from __future__ import annotations

from .kernels import njit


@njit(cache=True, nogil=True)
def next_draw(draw: int) -> int:
    """The draw after another one, in 0..2^31 - 1; any integer may be the first."""
    return (draw * 1103515245 + 12345) & 0x7FFFFFFF


@njit(cache=True, nogil=True)
def drawn_of(draw: int, n: int) -> int:
    """A draw as one of n numbers from 0 on."""
    return (draw * n) >> 31
