"""Reads a Parquet file: a column per channel, numbers or lists of equal length in the cells."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np

from deal_hw.data.importing.arrays import channels_of_arrays
from deal_hw.data.importing.channels import Channels, as_floats, digest_of_file
from deal_hw.errors import MissingExtraError
from deal_hw.reading import NUMBERS, RECORDING_BYTES, check_size, reading
from deal_hw.types import FloatArray

_BATCH_ROWS: Final = 65_536


def read_parquet(path: Path) -> Channels:
    """Read all columns of numbers, of lists of numbers, and of dates, which become seconds.

    Raises:
        MissingExtraError: pyarrow is not installed.
        DatasetError: It cannot be read.
    """
    path = Path(path)
    _, pa = _pyarrow("formats")
    with reading(path, "Parquet"):
        digest = digest_of_file(path)
        left_out: dict[str, str] = {}

        def wanted(schema: Any) -> list[str]:
            left_out.update(
                {field.name: str(field.type) for field in schema if not _is_numbers(pa, field.type)}
            )
            return [name for name in schema.names if name not in left_out]

        arrays, units = columns_of(path, wanted, NUMBERS, "formats")
        return channels_of_arrays(path, "parquet", digest, arrays, left_out, units)


def columns_of(
    file: Path, wanted: Callable[[Any], list[str]], most: int, extra: str
) -> tuple[dict[str, FloatArray], dict[str, str]]:
    """Return columns of a Parquet file, (T,) or (T, K), and the units of times; inside ``reading``.

    Args:
        file: The file.
        wanted: Returns the names of the columns to read, from the file's Arrow schema.
        most: Most numbers.
        extra: The extra of deal-hw that the error names.

    Raises:
        MissingExtraError: pyarrow is not installed.
        ValueError: It has more numbers.
    """
    pq, pa = _pyarrow(extra)
    check_size(file, RECORDING_BYTES)
    with pq.ParquetFile(file) as opened:
        names = wanted(opened.schema_arrow)
        _check_extent(opened.metadata, len(names), most)
        batches, count = [], 0
        for batch in opened.iter_batches(batch_size=_BATCH_ROWS, columns=names):
            # Lists may have any length, which is known only now.
            count += batch.nbytes // 8
            if count > most:
                raise ValueError(f"more than {most} numbers")
            batches.append(batch)
        table = pa.Table.from_batches(batches, opened.schema_arrow.empty_table().select(names).schema)
    times = {name: table.column(name) for name in names if pa.types.is_temporal(table.column(name).type)}
    arrays = {name: _array(pa, table.column(name)) for name in names if name not in times}
    return arrays | _seconds(pa, times), dict.fromkeys(times, "s")


def _pyarrow(extra: str) -> tuple[Any, Any]:
    """Return the modules pyarrow.parquet and pyarrow."""
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError as error:
        raise MissingExtraError("pyarrow", extra) from error
    return pq, pa


def _is_numbers(pa: Any, kind: Any) -> bool:
    types = pa.types
    if _is_list(pa, kind):
        kind = kind.value_type
    elif types.is_timestamp(kind) or types.is_duration(kind) or types.is_time(kind):
        return True
    return bool(types.is_integer(kind) or types.is_floating(kind) or types.is_boolean(kind))


def _check_extent(metadata: Any, columns: int, most: int) -> None:
    """Check the announced size of a file's data, since a run of one value takes no bytes in it.

    The metadata of single columns are not read: pyarrow ends the process if these are damaged.
    """
    size = sum(metadata.row_group(group).total_byte_size for group in range(metadata.num_row_groups))
    if metadata.num_rows * columns > most or size > 8 * most:
        raise ValueError(f"more than {most} numbers")


def _array(pa: Any, column: Any) -> FloatArray:
    """Return a column, (T,) for numbers, (T, K) for lists of equal length."""
    whole = column.combine_chunks()
    if isinstance(whole, pa.ChunkedArray):
        whole = pa.concat_arrays(whole.chunks) if whole.num_chunks else pa.array([], whole.type.value_type)
    if _is_list(pa, whole.type):
        flat = as_floats(whole.flatten().to_numpy(zero_copy_only=False))
        return flat.reshape(len(whole), -1) if len(whole) else np.empty((0, 1))
    return as_floats(whole.to_numpy(zero_copy_only=False))


def _seconds(pa: Any, columns: dict[str, Any]) -> dict[str, FloatArray]:
    """Return columns of dates, since the first of all of them, of times of day or durations, (T,) each [s].

    Nanoseconds since 1970 would lose their last digits as floats.
    """
    found: dict[str, FloatArray] = {}
    zero_ns: int | None = None
    for name, column in columns.items():
        is_date = pa.types.is_timestamp(column.type)
        duration = pa.types.is_duration(column.type)
        kind = (
            pa.timestamp("ns", column.type.tz)
            if is_date
            else pa.duration("ns")
            if duration
            else pa.time64("ns")
        )
        ticks = column.cast(kind).cast(pa.int64())
        lost = np.asarray(ticks.is_null())
        whole = np.asarray(ticks.fill_null(0), dtype=np.int64)
        if is_date:
            if zero_ns is None and not lost.all():
                zero_ns = int(whole[~lost][0])
            whole = whole - (zero_ns or 0)
        found[name] = np.where(lost, np.nan, whole * 1e-9)
    return found


def _is_list(pa: Any, kind: Any) -> bool:
    types = pa.types
    return bool(types.is_list(kind) or types.is_fixed_size_list(kind) or types.is_large_list(kind))
