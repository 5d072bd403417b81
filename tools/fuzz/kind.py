"""Description of one kind of input for the fuzzer."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

Mutation = Callable[[random.Random, bytes, Sequence[bytes]], bytes]
"""Returns a damaged copy of some bytes; it may take parts of the other good inputs."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FileKind:
    """A file that a user may name.

    Attributes:
        make: Returns good files as bytes, given an empty folder to work in.
        read: Reads the file at a path as the product does.
        name: Name of the file while it is read; may contain folders ("episodes/000000.mcap").
        mutations: Ways to damage it; one is drawn for each input.
    """

    make: Callable[[Path], Sequence[bytes]]
    read: Callable[[Path], object]
    name: str
    mutations: Sequence[Mutation]


@dataclass(frozen=True, slots=True, kw_only=True)
class WireKind:
    """Bytes that arrive from a device or another process.

    Attributes:
        make: Returns good messages.
        read: Decodes the bytes as the product does.
        mutations: Ways to damage them; one is drawn for each input.
    """

    make: Callable[[], Sequence[bytes]]
    read: Callable[[bytes], object]
    mutations: Sequence[Mutation]


Kind = FileKind | WireKind
