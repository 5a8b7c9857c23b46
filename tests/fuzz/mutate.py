"""Mutations of bytes, of protobuf messages and of JSON documents."""

from __future__ import annotations

import copy
import json
import re
from typing import Any

from tiny_model import varint

from .running import Case

MAGIC_BYTES = [0x00, 0xFF, 0x7F, 0x80, 0x01, 0x20, 0x0A]
MAGIC_WORDS = [0, 1, 0x7F, 0x80, 0xFF, 0x100, 0x7FFF, 0x8000, 0xFFFF, 0x10000, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF]


def mutated_bytes(content: bytes, case: Case, most: int = 8, near: int = 0) -> bytes:
    """Some bytes set, flipped, cut out, doubled, swapped or put in; ``near``: mostly among the first bytes."""
    rng, damaged = case.rng, bytearray(content)
    for _ in range(int(rng.integers(1, most + 1))):
        if not damaged:
            break
        n = near if near and rng.random() < 0.7 else len(damaged)
        at, way = int(rng.integers(min(n, len(damaged)))), int(rng.integers(10))
        length = int(2 ** (12 * rng.random()))
        if way <= 2:
            damaged[at] = int(rng.choice(MAGIC_BYTES)) if rng.random() < 0.5 else int(rng.integers(256))
        elif way == 3:
            damaged[at] ^= 1 << int(rng.integers(8))
        elif way == 4:
            size = int(rng.choice([2, 4, 8]))
            word = int(rng.choice(MAGIC_WORDS)) % (1 << 8 * size)
            damaged[at : at + size] = word.to_bytes(size, str(rng.choice(["little", "big"])))  # type: ignore[arg-type]
        elif way == 5:
            del damaged[at : at + length]
        elif way == 6:
            damaged[at:at] = damaged[at : at + length]
        elif way == 7:
            damaged[at:at] = rng.bytes(min(length, 64))
        elif way == 8:
            other = int(rng.integers(len(damaged)))
            damaged[at : at + 8], damaged[other : other + 8] = damaged[other : other + 8], damaged[at : at + 8]
        elif rng.random() < 0.3:
            del damaged[at:]
        else:
            damaged[at : at + length] = bytes([int(rng.choice(MAGIC_BYTES))]) * len(damaged[at : at + length])
    return bytes(damaged)


WORDS = [
    b"0", b"1", b"-1", b"2", b"3", b"4", b"8", b"1e9", b"1e400", b"nan", b"inf", b"-0.0", b"4294967296", b"65537",
    b"9" * 30, b"9" * 5000, b"", b"x", b"y", b"z", b"intensity", b"t", b"_", b"F", b"U", b"I", b"\xff", b"float",
    b"double", b"uchar", b"list", b"list uchar int", b"vertex", b"#", b":", b"\0", b"true", b"1,5", b"0x10", b"1_0",
]  # fmt: skip


def mutated_words(content: bytes, case: Case, most: int = 4, within: int = 400) -> bytes:
    """Words among the first bytes replaced, removed, doubled or swapped, or a line removed or doubled."""
    rng = case.rng
    parts = re.split(rb"([ \n])", content[:within])  # words at even places
    for _ in range(int(rng.integers(1, most + 1))):
        at, other, way = (
            2 * int(rng.integers((len(parts) + 1) // 2)),
            int(rng.integers(len(WORDS))),
            int(rng.integers(8)),
        )
        if way <= 3:
            parts[at] = WORDS[other]
        elif way == 4:
            parts[at] = b""
        elif way == 5:
            parts[at] += b" " + parts[at]
        elif way == 6:
            k = 2 * (other % ((len(parts) + 1) // 2))
            parts[at], parts[k] = parts[k], parts[at]
        else:
            lines = b"".join(parts).split(b"\n")
            k = other % len(lines)
            lines[k : k + 1] = [lines[k]] * int(case.pick([0, 2]))
            parts = re.split(rb"([ \n])", b"\n".join(lines))
    return b"".join(parts) + content[within:]


Field = list[Any]
"""Number, wire type, value: an int, bytes, or a list of fields of the message that the bytes are."""


def parse(content: bytes, depth: int = 0) -> list[Field] | None:
    """Fields of a message, messages within parsed too; None if these bytes are no message."""
    fields: list[Field] = []
    at = 0
    while at < len(content):
        tag, at = _number(content, at)
        if tag < 8 or tag & 7 not in (0, 1, 2, 5):
            return None
        if tag & 7 == 0:
            value: Any
            value, at = _number(content, at)
            if at > len(content):
                return None
        else:
            size = {1: 8, 5: 4}.get(tag & 7)
            if size is None:
                size, at = _number(content, at)
            value = content[at : at + size]
            if len(value) < size:
                return None
            at += size
            if tag & 7 == 2 and depth < 6 and 2 <= size < 100_000:
                inner = parse(value, depth + 1)
                value = value if inner is None else inner
        fields.append([tag >> 3, tag & 7, value])
    return fields


def _number(content: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while at < len(content) and shift < 70:
        byte = content[at]
        value, at, shift = value | (byte & 0x7F) << shift, at + 1, shift + 7
        if byte < 0x80:
            return value, at
    return 0, len(content) + 1


def unparse(fields: list[Field]) -> bytes:
    out = bytearray()
    for number, wire, value in fields:
        out += varint(number << 3 | wire)
        if wire == 0:
            out += varint(value)
        else:
            inner = unparse(value) if isinstance(value, list) else value
            out += (varint(len(inner)) if wire == 2 else b"") + inner
    return bytes(out)


NUMBERS = [0, 1, 2, 3, 7, 8, 127, 128, 1 << 16, 1 << 31, 1 << 32, 1 << 40, (1 << 63) - 1, 1 << 63, (1 << 64) - 1]


def mutated_message(fields: list[Field], case: Case, pieces: list[Field], most: int = 4) -> bytes:
    """A message with fields changed, removed, doubled, moved, replaced by others of it or by the given ``pieces``."""
    fields = copy.deepcopy(fields)
    rng = case.rng
    for _ in range(int(rng.integers(1, most + 1))):
        places: list[tuple[list[Field], int]] = []

        def walk(message: list[Field], places: list[tuple[list[Field], int]] = places) -> None:
            for k, (_, _, value) in enumerate(message):
                places.append((message, k))
                if isinstance(value, list):
                    walk(value)

        walk(fields)
        if not places:
            break
        message, k = case.pick(places)
        field, way = message[k], int(rng.integers(8))
        if way == 0:
            del message[k]
        elif way == 1:
            message.insert(int(rng.integers(len(message) + 1)), copy.deepcopy(field))
        elif way == 2:
            message.append(copy.deepcopy(case.pick(pieces)))
        elif way == 3:
            message.insert(0, copy.deepcopy(case.pick(pieces)))
        elif way == 4:
            field[0] = int(rng.integers(1, 30))
        elif way == 5:
            other, j = case.pick(places)
            message[k] = copy.deepcopy(other[j])
        elif isinstance(field[2], int):
            field[2] = case.pick(NUMBERS)
        elif isinstance(field[2], bytes):
            field[2] = mutated_bytes(field[2], case, 2) if field[1] == 2 else rng.bytes(len(field[2]))
        else:
            rng.shuffle(field[2])
    return unparse(fields)


VALUES: list[Any] = [
    None, True, False, 0, 1, -1, 2, 0.5, 1e-9, 5e-324, -5e-324, 1e308, -1e308, 1.7976931348623157e308, 1e300, 1e30, 1e9,
    2**31, 2**53 + 1, 2**63, 2**64, 10**400, float("nan"), float("inf"), -float("inf"), "", "x", "1", "\0", "\ud800",
    "../../etc/passwd", "</script>", "x" * 3000, [], {}, [[]], [None], [1, 2], [0.0, 0.0], [5.0, 1.0], [1e308, -1e308],
    ["a", "b"], {"a": 1}, {"": {}}, [0] * 300, "car", "logarithm", ["logarithm"], {"kind": []}, "auto", "cpu",
]  # fmt: skip


def _places(value: Any, found: list[tuple[Any, Any]]) -> list[tuple[Any, Any]]:
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, each in inner:
        found.append((value, key))
        _places(each, found)
    return found


def mutated_document(document: Any, case: Case, most: int = 3) -> Any:
    """A JSON document with values replaced, scaled, removed, doubled, nested, or under another key."""
    document, rng = copy.deepcopy(document), case.rng
    for _ in range(int(rng.integers(1, most + 1))):
        places = _places(document, [])
        if not places:
            return case.pick(VALUES)
        holder, key = case.pick(places)
        way = int(rng.integers(12))
        if way <= 5:
            holder[key] = copy.deepcopy(case.pick(VALUES))
        elif way == 6 and isinstance(holder[key], int | float) and not isinstance(holder[key], bool):
            factor = case.pick([-1, 0, 1e3, 1e-3, 1e30, 1e-30])
            holder[key] = holder[key] * (factor if abs(holder[key]) < 1e300 else -1)  # 10**400 is no float
        elif way == 7:
            del holder[key]
        elif way == 8 and isinstance(holder, list):
            holder[:] = holder * int(rng.integers(0, 4))
        elif way == 9 and isinstance(holder, dict):
            holder[case.pick(["", "x", key + " ", "schema", "golden"])] = copy.deepcopy(holder[key])
        elif way == 10:
            depth = int(rng.choice([1, 40, 400]))
            for _ in range(depth):
                holder[key] = [holder[key]]
            if depth == 400:  # no more mutations: Python could not copy what is nested twice as deep
                break
        else:
            other, name = case.pick(places)
            holder[key] = copy.deepcopy(other[name]) if len(json.dumps(other[name], default=str)) < 10**5 else None
    return document


def mutated_json(document: Any, case: Case) -> bytes:
    """The text of a mutated document; in a quarter of the cases its bytes are mutated as well."""
    changed = mutated_document(document, case) if case.chance(0.8) else document
    try:
        text = json.dumps(changed).encode("utf-8", "surrogatepass")
    except (RecursionError, ValueError):
        text = json.dumps(document).encode()
    if case.chance(0.05):
        digits = b"9" * int(case.pick([400, 5000]))
        text = text.replace(b"1", digits, 1)
    if case.chance(0.25):
        text = mutated_bytes(text, case, 3)
    if case.chance(0.02):
        text = b"[" * int(case.pick([1000, 200_000])) + text
    return text


def noise(case: Case, most: int = 4096) -> bytes:
    """Any bytes."""
    return bytes(case.rng.bytes(int(most ** case.rng.random())))
