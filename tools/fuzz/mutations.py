"""Ways to damage an input, all drawn from a seeded generator."""

from __future__ import annotations

import copy
import json
import random
import struct
from collections.abc import Callable, Sequence
from typing import Any

_ODD_INTEGERS = (0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF, (1 << 63) - 1, (1 << 64) - 1)
_MOST_BYTES = 1 << 16


def flip(rng: random.Random, data: bytearray, others: Sequence[bytes]) -> None:
    """Flip a bit."""
    data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)


def overwrite(rng: random.Random, data: bytearray, others: Sequence[bytes]) -> None:
    """Write an integer at a limit of its type."""
    layout = rng.choice(("<B", "<H", "<I", "<Q"))
    size = struct.calcsize(layout)
    at = rng.randrange(len(data))
    data[at : at + size] = struct.pack(layout, rng.choice(_ODD_INTEGERS) & ((1 << 8 * size) - 1))


def zero(rng: random.Random, data: bytearray, others: Sequence[bytes]) -> None:
    """Write zeros over a part, as a lost writeback does."""
    at, size = _part(rng, data)
    data[at : at + size] = bytes(size)


def cut(rng: random.Random, data: bytearray, others: Sequence[bytes]) -> None:
    """Cut the end off."""
    del data[rng.randrange(len(data)) :]


def delete(rng: random.Random, data: bytearray, others: Sequence[bytes]) -> None:
    """Leave a part out."""
    at, size = _part(rng, data)
    del data[at : at + size]


def duplicate(rng: random.Random, data: bytearray, others: Sequence[bytes]) -> None:
    """Repeat a part, elsewhere or directly behind itself."""
    at, size = _part(rng, data)
    to = rng.choice((at + size, rng.randrange(len(data) + 1)))
    data[to:to] = data[at : at + size]


def insert(rng: random.Random, data: bytearray, others: Sequence[bytes]) -> None:
    """Insert zeros or noise."""
    size = 1 << rng.randrange(12)
    at = rng.choice((len(data), rng.randrange(len(data) + 1)))
    data[at:at] = bytes(size) if rng.random() < 0.5 else rng.randbytes(size)


def splice(rng: random.Random, data: bytearray, others: Sequence[bytes]) -> None:
    """Continue with the end of another input."""
    other = rng.choice(others)
    data[rng.randrange(len(data)) :] = other[rng.randrange(len(other) + 1) :]


def damage_bytes(rng: random.Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Apply one to four of the ways above."""
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 3, 4))):
        if not out:
            break
        rng.choice((flip, overwrite, zero, cut, delete, duplicate, insert, splice))(rng, out, others)
    return bytes(out[: len(data) + _MOST_BYTES])


def _part(rng: random.Random, data: bytearray) -> tuple[int, int]:
    at = rng.randrange(len(data))
    return at, rng.randint(1, max(1, min(len(data) - at, rng.choice((4, 64, 1024, len(data))))))


_DEEP = "@deep@"
"""Stands for 100,000 nested lists, which json.dumps cannot write."""
_ODD_VALUES: tuple[Any, ...] = (
    None,
    True,
    False,
    "",
    "x",
    "\ud800",
    "\0",
    "a\nb\x1b[31m",
    0,
    -1,
    1e308,
    float("nan"),
    float("inf"),
    -0.0,
    1 << 63,
    10**30,
    [],
    {},
    [[]],
    [None],
    {"": None},
    [1.0, "x"],
    "1.0",
    "../../etc/passwd",
    _DEEP,
)


def damage_json(rng: random.Random, data: bytes, others: Sequence[bytes]) -> bytes:
    """Replace, leave out, repeat or retype one to three values of a JSON text."""
    values = json.loads(data)
    for _ in range(rng.choice((1, 1, 2, 3))):
        values = damage_values(rng, values)
    # A few times only: a hundred repetitions of a hundred would make an input of 2 GB.
    return json.dumps(values).replace(f'"{_DEEP}"', "[" * 100_000 + "]" * 100_000, 20).encode()


def damage_values(rng: random.Random, values: Any) -> Any:
    """Replace one value anywhere inside plain values, in place, and return them."""
    holder, key = _somewhere(rng, values)
    if holder is None:
        return copy.deepcopy(rng.choice(_ODD_VALUES))
    way = rng.randrange(6)
    if way == 0:
        del holder[key]
    elif way == 1 and isinstance(holder, dict):
        holder[f"{key}{rng.choice(('_', 's', ''))}"] = holder.pop(key)
    elif way == 1:
        holder.insert(key, holder[key])
    elif way == 2:
        holder[key] = _retyped(holder[key])
    elif way == 3:
        holder[key] = [copy.deepcopy(holder[key]) for _ in range(rng.choice((1, 2, 100)))]
    else:
        holder[key] = copy.deepcopy(rng.choice(_ODD_VALUES))
    return values


def _somewhere(rng: random.Random, values: Any) -> tuple[Any, Any]:
    """Return a container inside some values and one of its keys; (None, None) for the values themselves."""
    holder, key = None, None
    inside = values
    while isinstance(inside, (dict, list)) and inside and rng.random() < 0.85:
        holder = inside
        key = rng.choice(list(inside)) if isinstance(inside, dict) else rng.randrange(len(inside))
        inside = holder[key]
    return holder, key


def _retyped(value: Any) -> Any:
    if isinstance(value, dict):
        return list(value.items())
    if isinstance(value, list):
        return {str(i): entry for i, entry in enumerate(value)}
    if isinstance(value, str):
        return len(value)
    return str(value)


def mended(damage: Callable[..., bytes], mend: Callable[[bytes], bytes]) -> Callable[..., bytes]:
    """Return a mutation whose result has a correct checksum, so that it passes the check."""

    def mutate(rng: random.Random, data: bytes, others: Sequence[bytes]) -> bytes:
        return mend(damage(rng, data, others))

    return mutate
