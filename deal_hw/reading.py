"""Reads files that may be damaged or hostile, with a size limit and one-line errors.

Every reader of JSON, YAML and NPZ uses this module, so that each limit has one place and a parser's exception
never reaches the user as a traceback. The caller defines the meaning of a file: of JSON by a dataclass, see
:mod:`deal_hw.schema`, of others inside :func:`reading`.
"""

from __future__ import annotations

import contextlib
import io
import math
import os
import stat
import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import IO, Any, Final, TypeVar

import numpy as np

from deal_hw import schema
from deal_hw.errors import (
    LONGEST,
    ConfigurationError,
    DatasetError,
    DealHwError,
    MissingExtraError,
    short,
    shown,
)
from deal_hw.types import FloatArray

T = TypeVar("T")

MIB: Final = 1 << 20
JSON_BYTES: Final = 16 * MIB
"""Largest JSON file; the values take up to thirty times that in memory."""
YAML_BYTES: Final = MIB
"""Largest YAML file. The longest hand-written one is a hundredth of that."""
YAML_NODES: Final = 100_000
"""Most values of a YAML file; values behind an alias count at each reference."""
YAML_TEXT: Final = 10_000
"""Longest single text of a YAML file [characters]."""
RECORDING_BYTES: Final = 1024 * MIB
"""Largest file of a foreign recording."""
NUMBERS: Final = 1 << 27
"""Most numbers of one recording: 1 GiB, as 30 joints with five quantities at 1 kHz give in 15 minutes."""
NAMES: Final = 4096
"""Most columns of a table, and most names of a list."""
_DIRECTORY_BYTES: Final = 16 * MIB
"""Largest table of contents of an NPZ file."""


@contextlib.contextmanager
def reading(
    path: object, what: str, advice: str = "", *, error: type[DealHwError] = DatasetError
) -> Iterator[None]:
    """Turn any error inside the block into one line that names the file.

    Parsers of damaged bytes raise nearly anything (`struct.error`, `zlib.error`, `RecursionError`,
    `MemoryError`, ...), and so does code that walks values of another structure than expected. Our own errors
    keep their class; the path is put in front and the advice behind. ``--traceback`` shows the origin.

    Args:
        path: The file's name in messages.
        what: Its expected kind, such as "CSV" or "a calibration result".
        advice: What to do instead, such as "`deal-hw calibrate` writes one".
        error: The error to raise.
    """
    then = f"; {advice}" if advice else ""
    try:
        yield
    except MissingExtraError:
        raise
    except DealHwError as err:
        text = str(err) if str(path) in str(err) else f"{path}: {err}"
        # Our own message may list the names in a file.
        text = short(text, LONGEST + len(str(path)))
        err.args = (text if advice in text else text + then,)
        raise
    except FileNotFoundError as err:
        raise error(f"{path} cannot be read: there is no such file{then}") from err
    except OSError as err:
        raise error(f"{path} cannot be read: {err.strerror or short(err)}{then}") from err
    except Exception as err:
        raise error(f"{path} cannot be read as {what}: {_reason(err)}{then}") from err


def _reason(err: Exception) -> str:
    if isinstance(err, KeyError):
        return f"{short(str(err))} is missing"
    if isinstance(err, RecursionError):
        return "its parts are nested too deep"
    if isinstance(err, MemoryError):
        return "it needs more memory than there is"
    if isinstance(err, UnicodeDecodeError):
        return f"byte {err.start} is no UTF-8 text"
    return short(err) or type(err).__name__


def check_size(path: Path, most: int) -> None:
    """Check that a path is an ordinary file of a bounded size; to be called inside :func:`reading`.

    Raises:
        OSError: There is none, or it cannot be accessed.
        ValueError: It is a folder or a device, or too large.
    """
    status = os.stat(path)
    if not stat.S_ISREG(status.st_mode):
        # A pipe or a device could block the reader, or send data, for ever.
        kind = "a folder" if stat.S_ISDIR(status.st_mode) else "a pipe or a device"
        raise ValueError(f"it is {kind}; name an ordinary file")
    if status.st_size > most:
        raise ValueError(
            f"it has {status.st_size / MIB:.1f} MiB; files of this kind may have {most / MIB:g} MiB"
        )


def read_bytes(path: Path, most: int) -> bytes:
    """Return a file's bytes; errors as :func:`check_size`."""
    check_size(path, most)
    with open(path, "rb") as file:
        return file.read(most)


def read_json(
    path: Path,
    kind: type[T],
    what: str = "JSON",
    advice: str = "",
    *,
    error: type[DealHwError] = DatasetError,
    most: int = JSON_BYTES,
) -> T:
    """Return the dataclass, or plain values, that a JSON file describes.

    Args:
        path: The file.
        kind: The dataclass, or a type such as ``dict[str, Any]``.
        what: As for :func:`reading`.
        advice: As for :func:`reading`.
        error: What to raise.
        most: Largest size [B].

    Raises:
        DealHwError: The file cannot be read, is too large or nested too deep, is no JSON, or a field is
            wrong; of the given class, with the names of file and fields.
    """
    with reading(path, what, advice, error=error):
        try:
            return schema.read_json(kind, read_bytes(path, most))
        except ConfigurationError as err:
            then = f"; {advice}" if advice else ""
            raise error(f"{path} cannot be read as {what}: {err}{then}") from err


def read_yaml(path: Path, tags: Mapping[str, Callable[[Any], Any]] | None = None) -> Any:
    """Return the values of a YAML file; to be called inside :func:`reading`."""
    return parse_yaml(read_bytes(path, YAML_BYTES).decode("utf-8"), tags)


def parse_yaml(text: str, tags: Mapping[str, Callable[[Any], Any]] | None = None) -> Any:
    """Return the plain values of YAML text; to be called inside :func:`reading`.

    A key that is written twice in one mapping is refused. YAML forbids it, but PyYAML takes the last value
    without a word, and a limit further up in the file would not hold.

    Args:
        text: The text.
        tags: Functions of a YAML node for tags beyond the plain ones, by the tag's full name. All others are
            refused: no object is made.
    """
    # Imported here, since control processes read no YAML.
    import yaml

    class Loader(yaml.SafeLoader):
        def get_single_node(self) -> Any:
            node = super().get_single_node()
            if node is not None:
                _weigh(node, {})
            return node

    if len(text) > YAML_BYTES:
        raise ConfigurationError(f"{len(text)} characters of YAML; {YAML_BYTES} are allowed")
    for tag, construct in (tags or {}).items():
        Loader.add_constructor(tag, _constructor(construct))
    return yaml.load(text, Loader)


def _constructor(construct: Callable[[Any], Any]) -> Callable[[Any, Any], Any]:
    return lambda loader, node: construct(node)


def _weigh(node: Any, weights: dict[int, float]) -> float:
    """Return the number of values behind a YAML node.

    Eight lists of one line each, where each names the one before nine times, are 43 million values: merging
    or printing them would not end. A node inside itself counts as infinite.
    """
    known = weights.get(id(node))
    if known is not None:
        return known
    weights[id(node)] = math.inf
    value, weight = node.value, 1.0
    if isinstance(value, str):
        if len(value) > YAML_TEXT:
            raise ValueError(f"a text of {len(value)} characters; {YAML_TEXT} are allowed")
    else:
        _refuse_double_keys(value)
        for entry in value:
            weight += sum(_weigh(n, weights) for n in (entry if isinstance(entry, tuple) else (entry,)))
    if weight > YAML_NODES:
        raise ValueError(f"more than {YAML_NODES} values; aliases count each time")
    weights[id(node)] = weight
    return weight


def _refuse_double_keys(entries: list[Any]) -> None:
    """Raise if a key of a YAML mapping is written twice; keys of a merge (``<<``) may be overridden.

    Args:
        entries: Pairs of nodes of a mapping; nodes of a list pass.

    Raises:
        ConfigurationError: The message names the key and both lines.
    """
    lines: dict[tuple[str, str], int] = {}
    for entry in entries:
        key = entry[0] if isinstance(entry, tuple) else None
        if key is None or not isinstance(key.value, str):
            continue
        line, known = key.start_mark.line + 1, lines.get((key.tag, key.value))
        if known is not None:
            where = f"lines {known} and {line}" if known != line else f"line {line}"
            raise ConfigurationError(
                f"key {shown(key.value)} is written twice, in {where}; keep one of the two"
            )
        lines[key.tag, key.value] = line


class _Sipped(io.FileIO):
    """A file with a limit on each read, since the ZIP reader trusts a table's announced size."""

    def read(self, size: int | None = -1, /) -> bytes:
        if size is not None and size > _DIRECTORY_BYTES:
            raise ValueError(f"a table of contents of {size / MIB:.0f} MiB")
        return super().read(-1 if size is None else size) or b""


def read_arrays(
    source: Path | bytes, unwanted: Callable[[np.dtype[Any], tuple[int, ...]], str]
) -> tuple[dict[str, np.ndarray[Any, Any]], dict[str, str]]:
    """Return the arrays of an NPZ file; to be called inside :func:`reading`.

    Sizes are read from the table of contents and from each array's own header before any memory is taken: a
    file of 3 MB may announce terabytes. Nothing is unpickled.

    Args:
        source: The file, or its bytes.
        unwanted: Returns from kind and shape why not to read an array; "" to read it.

    Returns:
        The arrays by name, and the omitted ones with the reason.

    Raises:
        ValueError: It contains more than :data:`NUMBERS` numbers, or an array is shorter than announced.
        Exception: Errors of the ZIP and NPY readers.
    """
    if isinstance(source, Path):
        check_size(source, RECORDING_BYTES)
    opened: IO[bytes] = io.BytesIO(source) if isinstance(source, bytes) else _Sipped(source)
    arrays: dict[str, np.ndarray[Any, Any]] = {}
    left_out: dict[str, str] = {}
    budget = NUMBERS
    with opened, zipfile.ZipFile(opened) as archive:
        for entry in archive.infolist():
            name = entry.filename.removesuffix(".npy")
            with archive.open(entry) as member:
                shape, fortran, dtype = _header(member)
                count = math.prod(shape)
                if dtype.hasobject:
                    left_out[name] = "Python objects, which could run anything"
                elif reason := unwanted(dtype, shape):
                    left_out[name] = reason
                else:
                    budget -= count
                    size = count * dtype.itemsize
                    if budget < 0 or size > 8 * NUMBERS:
                        raise ValueError(f"more than {NUMBERS} numbers")
                    if size > entry.file_size:
                        raise ValueError(f"{short(name, 60)!r} is shorter than its shape {short(shape, 60)}")
                    flat = np.frombuffer(bytearray(member.read(size)), dtype, count)
                    arrays[name] = flat.reshape(shape, order="F" if fortran else "C")
    return arrays, left_out


def _header(member: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    version = np.lib.format.read_magic(member)
    read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in read:
        raise ValueError(f"an array of NPY version {version}; 1.0 and 2.0 are known")
    shape, fortran, dtype = read[version](member)
    if any(n < 0 for n in shape):
        raise ValueError(f"an array of shape {short(shape, 60)}")
    return shape, fortran, dtype


def object_of(values: Any, what: str = "an object") -> Mapping[str, Any]:
    """Return plain JSON values that must be an object.

    Raises:
        ConfigurationError: They are something else.
    """
    if not isinstance(values, Mapping):
        raise ConfigurationError(f"{what} was expected, got {short(values)}")
    return values


def texts(values: Any, what: str) -> tuple[str, ...]:
    """Return a list of texts; errors as :func:`object_of`."""
    if not isinstance(values, list | tuple) or not all(isinstance(v, str) for v in values):
        raise ConfigurationError(f"{what} must be a list of texts, got {short(values)}")
    return tuple(values)


def number(value: Any, what: str, low: float = -math.inf, high: float = math.inf) -> float:
    """Return a finite number in [low, high].

    Raises:
        ConfigurationError: It is something else.
    """
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ConfigurationError(f"{what} must be a number, got {shown(value)}")
    try:
        found = float(value)
    except OverflowError:
        found = math.inf
    if not (math.isfinite(found) and low <= found <= high):
        span = "" if (low, high) == (-math.inf, math.inf) else f" from {low:g} to {high:g}"
        raise ConfigurationError(f"{what} must be a finite number{span}, got {found:g}")
    return found


def numbers(values: Any, what: str, shape: tuple[int, ...], *, finite: bool = True) -> FloatArray:
    """Return nested lists of numbers as an array of a given shape.

    Raises:
        ConfigurationError: They have another shape, or a value is not a (finite) number.
    """
    try:
        found = np.asarray(values, dtype=float)
    except (TypeError, ValueError, OverflowError) as err:
        raise ConfigurationError(f"{what} must be numbers, got {short(values)}") from err
    if found.shape != shape:
        raise ConfigurationError(f"{what} has the shape {short(found.shape, 60)}; it must have {shape}")
    if finite and not np.isfinite(found).all():
        raise ConfigurationError(f"{what} contains a value that is not finite")
    return found
