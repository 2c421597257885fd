"""Tables that survive a crash: Arrow IPC streams while they grow, Parquet when complete."""

import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, TypeAlias

import pyarrow as pa
import pyarrow.parquet as pq

Row: TypeAlias = dict[str, object]
"""Values by column."""
FLUSH_NS = 500_000_000
"""Longest span of events that a crash can lose."""
_ROWS_AT_ONCE = 4_096
_GROUP_ROWS = 2_048
"""Rows per Parquet row group: twenty seconds of ticks. Encoding 16,384 rows at once took 27 MB."""


class TableWriter:
    """Appends rows to ``STEM.arrows``; ``finish`` converts it to ``STEM.parquet``.

    Methods raise OSError if a file cannot be written; everything written before stays readable.
    """

    def __init__(self, stem: Path, schema: pa.Schema) -> None:
        """Create the stream. ``stem`` is a path without a suffix; no stream may exist there."""
        self._stream = stem.with_suffix(".arrows")
        self._parquet = stem.with_suffix(".parquet")
        self._schema = schema
        self._stream.open("xb").close()
        self._sink = pa.OSFile(os.fsencode(self._stream), "wb")  # unbuffered
        self._writer = pa.ipc.new_stream(self._sink, schema)
        self._waiting: list[Row] = []
        self.rows = 0
        self._write([])  # imports the modules of the first conversion now, not in flight

    def add(self, row: Row) -> None:
        """Keep a row for ``flush``. Keys without a column are ignored; a missing one is null."""
        self._waiting.append(row)
        self.rows += 1

    def flush(self) -> None:
        """Hand all rows to the kernel. Rows that cannot be written are not retried."""
        if self._waiting:
            waiting, self._waiting = self._waiting, []
            self._write(waiting)

    def _write(self, rows: list[Row]) -> None:
        self._writer.write_batch(pa.RecordBatch.from_pylist(rows, schema=self._schema))

    def finish(self) -> None:
        """Close the stream and replace it by Parquet, in constant memory.

        If that cannot be written, the stream stays.
        """
        self.flush()
        self._writer.close()
        self._sink.close()
        part = self._parquet.with_suffix(".parquet.part")
        try:
            with self._stream.open("rb") as file:
                self._write_parquet(pa.ipc.open_stream(file), part)
            part.replace(self._parquet)
        except OSError:
            part.unlink(missing_ok=True)
            raise
        self._stream.unlink()

    def _write_parquet(self, batches: Iterable[pa.RecordBatch], path: Path) -> None:
        """Join small batches: a row group each would make the file larger than the stream."""
        options: dict[str, Any] = {"compression": "zstd", "write_page_checksum": True}
        group: list[pa.RecordBatch] = []
        with path.open("wb") as file, pq.ParquetWriter(file, self._schema, **options) as writer:
            for batch in batches:
                group.append(batch)
                if sum(each.num_rows for each in group) >= _GROUP_ROWS:
                    writer.write_table(pa.Table.from_batches(group).combine_chunks())
                    group.clear()
            if group:
                writer.write_table(pa.Table.from_batches(group).combine_chunks())

    def abandon(self) -> None:
        """Leave the stream as it is, after an error."""
        self._sink.close()


def table_rows(table: pa.Table, arrays: tuple[str, ...] = ()) -> Iterator[dict[str, Any]]:
    """Yield rows by column; ``arrays`` name those of numbers, which become read-only arrays.

    Whole columns are never converted to Python objects at once.
    """
    for batch in table.to_batches(max_chunksize=_ROWS_AT_ONCE):
        plain = batch.drop_columns(list(arrays)).to_pylist()
        for number, row in enumerate(plain):
            for name in arrays:
                values = batch.column(name)[number].values
                row[name] = None if values is None else values.to_numpy()  # read-only
            yield row
