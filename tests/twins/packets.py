"""Slow twins of the kernels that decode packets."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def ouster_turn(
    packets: Sequence[bytes],
    places: tuple[int, ...],
    fields: Sequence[tuple[int, int, int]],
    shape: tuple[int, int],
) -> tuple[np.ndarray, np.ndarray]:
    """Twin of `ouster_packets.fill_turn`: each pixel is one number, of which a field takes some bits."""
    header, per_packet, column_bytes, status, first, pixel_bytes = places
    values = np.zeros((len(fields), *shape), np.uint32)
    stamps_ns = np.zeros(shape[1], np.uint64)
    for packet in packets:
        for k in range(per_packet):
            block = packet[header + k * column_bytes :][:column_bytes]
            column = int.from_bytes(block[8:10], "little")
            if block[status] % 2 == 0 or column >= shape[1]:
                continue
            stamps_ns[column] = int.from_bytes(block[:8], "little")
            for beam in range(shape[0]):
                pixel = int.from_bytes(block[first + beam * pixel_bytes :][:pixel_bytes], "little")
                for j, (bit, bits, shift) in enumerate(fields):
                    values[j, beam, column] = (pixel >> bit) % 2**bits << shift
    return values, stamps_ns
