"""Columns of values on the viewer's timeline, and what varies fast as its spread over windows."""

from bisect import bisect_left
from collections.abc import Sequence
from itertools import groupby
from typing import Any

import numpy as np
import rerun as rr

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.observe.viewer.layout import Plot

WINDOW_NS = NS_PER_S // 4


class Columns:
    """Sends values to one recording on the timeline ``time``, which starts at ``start_ns``.

    Rows of plots are collected until ``flush``: a call of the SDK costs as much as a hundred rows.
    """

    def __init__(self, stream: rr.RecordingStream) -> None:
        self.stream = stream
        self.start_ns = 0
        self._rows: dict[Plot, tuple[list[int], list[Sequence[float]]]] = {}

    def send(self, path: str, stamps_ns: Sequence[int], columns: Any) -> None:
        """Send one row for each stamp."""
        since_ns = np.array(stamps_ns, dtype=np.int64) - self.start_ns
        index = [rr.TimeColumn("time", duration=since_ns.astype("timedelta64[ns]"))]
        self.stream.send_columns(path, index, columns, strict=True)

    def plot(self, plot: Plot, stamps_ns: Sequence[int], rows: Sequence[Sequence[float]]) -> None:
        """Keep a row for each stamp, a value for each series; NaN is a gap in its line."""
        stamps, kept = self._rows.setdefault(plot, ([], []))
        stamps += stamps_ns
        kept += rows

    def flush(self) -> None:
        """Send the rows of all plots."""
        for plot, (stamps_ns, rows) in self._rows.items():
            if rows:
                values = np.array(rows, dtype=np.float64)
                self.send(plot.path, stamps_ns, rr.Scalars.columns(scalars=values))
        self._rows.clear()


class Spread:
    """Least, most and median of one quantity in each window of ``WINDOW_NS``, beside a bound.

    A quantity that jumps with every tick is a solid block in a plot of a minute.
    """

    def __init__(self, columns: Columns, plot: Plot, bound_ns: float | None) -> None:
        self._columns = columns
        self._plot = plot
        self._bound_ms = np.nan if bound_ns is None else bound_ns / NS_PER_MS
        self._stamps_ns: list[int] = []
        self._values_ns: list[float] = []

    def extend(self, stamps_ns: Sequence[int], values_ns: Sequence[float]) -> None:
        """Add values, and show the windows that have ended."""
        self._stamps_ns += stamps_ns
        self._values_ns += values_ns
        if self._stamps_ns:
            start_ns = self._columns.start_ns
            self._show(
                until_ns=start_ns + (self._stamps_ns[-1] - start_ns) // WINDOW_NS * WINDOW_NS
            )

    def close(self) -> None:
        """Show the window that has not ended."""
        if self._stamps_ns:
            self._show(until_ns=self._stamps_ns[-1] + 1)

    def _show(self, until_ns: int) -> None:
        count = bisect_left(self._stamps_ns, until_ns)
        stamps_ns, values_ns = self._stamps_ns[:count], self._values_ns[:count]
        del self._stamps_ns[:count], self._values_ns[:count]
        start_ns = self._columns.start_ns
        pairs = zip(stamps_ns, values_ns, strict=True)
        for _, window in groupby(pairs, key=lambda pair: (pair[0] - start_ns) // WINDOW_NS):
            stamps, values = zip(*window, strict=True)
            ordered = sorted(values)
            middle = (ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2]) / 2
            row = [value / NS_PER_MS for value in (ordered[0], ordered[-1], middle)]
            self._columns.plot(self._plot, stamps[-1:], [[*row, self._bound_ms]])
