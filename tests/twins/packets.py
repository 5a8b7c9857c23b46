"""Slow twins of the kernels that decode packets."""

from __future__ import annotations

import struct
from collections.abc import Sequence

import numpy as np


def ouster_turn(
    packets: Sequence[bytes], places: tuple[int, ...], fields: Sequence[tuple[int, int, int]], shape: tuple[int, int]
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


def spinning_returns(
    packets: np.ndarray, places: Sequence[int], blocks: np.ndarray, beams: np.ndarray, lens: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Twin of `spinning_packets.fill_returns`: the distances of all first, then the returns one by one."""
    header, block_bytes, first, channel_bytes, is_big, mask, back_blocks, back_channels = places
    n_blocks, n_channels = beams.shape[:2]
    points, times_s = [], []
    for packet, timed in zip(packets, blocks, strict=True):
        distances = np.zeros((n_blocks, n_channels), int)
        for b in range(n_blocks):
            for c in range(n_channels):
                at = header + b * block_bytes + first + c * channel_bytes
                distances[b, c] = int.from_bytes(bytes(packet[at : at + 2]), "big" if is_big else "little") & mask
        for b, (azimuth, time_s, speed) in enumerate(timed.tolist()):
            for c in range(n_channels) if np.isfinite([azimuth, time_s, speed]).all() else ():
                others = [0]
                if back_channels == 0 and b >= back_blocks and timed[b - back_blocks, 0] == azimuth:
                    others.append(distances[b - back_blocks, c])
                elif 0 < back_channels <= c:
                    others.append(distances[b, c - back_channels])
                if distances[b, c] in others:
                    continue
                elevation, offset, fired_us = beams[b, c]
                axis = np.radians(lens[1] - azimuth - speed * 1e-6 * fired_us)
                ray = lens[0] * distances[b, c]
                across = ray * np.cos(elevation) * np.exp(1j * (axis - np.radians(offset))) + lens[2] * np.exp(
                    1j * axis
                )
                at = header + b * block_bytes + first + c * channel_bytes + 2
                points.append([across.real, across.imag, ray * np.sin(elevation) + lens[3], packet[at]])
                times_s.append(time_s + 1e-6 * fired_us)
    return np.array(points).reshape(-1, 4), np.array(times_s)


def livox_points(content: bytes, stride: int, layout: int) -> tuple[np.ndarray, np.ndarray]:
    """Twin of `livox_packets.fill_points`, by struct."""
    points, numbers = [], []
    for k in range(len(content) // stride):
        record = content[k * stride : (k + 1) * stride]
        if layout == 3:
            distance, zenith, azimuth, remission = struct.unpack_from("<IHHB", record)
            zenith, azimuth = np.radians(zenith / 100), np.radians(azimuth / 100)
            ray = np.array([np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)])
            xyz = distance / 1000 * ray if distance else np.zeros(3)
            returned = distance > 0
        else:
            *xyz, remission = struct.unpack_from("<iiiB" if layout == 4 else "<hhhB", record)
            returned, xyz = any(xyz), np.array(xyz) / (1000 if layout == 4 else 100)
        if returned:
            points.append([*xyz, remission])
            numbers.append(k)
    return np.array(points).reshape(-1, 4), np.array(numbers, int)
