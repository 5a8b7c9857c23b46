"""Slow twins of reading packed points."""

from __future__ import annotations


def unpack_lzf(packed: bytes, size: int) -> bytes | None:
    """Twin of `edgeperc.readers.pcd.fill_unpacked_lzf`: the bytes, or None where the data is damaged."""
    packed, out = list(packed), []
    try:
        while packed:
            control = packed.pop(0)
            if control < 32:
                run = packed[: control + 1]
                del packed[: control + 1]
                if len(run) != control + 1:
                    return None
                out += run
            else:
                length = (control >> 5) + 2
                if length == 9:
                    length += packed.pop(0)
                start = len(out) - ((control & 31) << 8) - packed.pop(0) - 1
                if start < 0:
                    return None
                for k in range(length):
                    out.append(out[start + k])
            if len(out) > size:
                return None
    except IndexError:
        return None
    return bytes(out)
