"""Columns of values on the viewer's timeline, and what varies fast as its spread over windows."""

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.observe.rerun_layout import Plot

FloatColumn: TypeAlias = NDArray[np.float64]
WINDOW_NS = NS_PER_S // 4


class Columns:
    """Sends values to one recording on the timeline ``time``, which starts at ``start_ns``.

    Each call is one ``send_columns``, which costs a tenth of one ``log`` per value.
    """

    def __init__(self, stream: rr.RecordingStream) -> None:
        self.stream = stream
        self.start_ns = 0

    def send(self, path: str, stamps_ns: Sequence[int], columns: Any) -> None:
        """Send one row for each stamp."""
        since_ns = np.array(stamps_ns, dtype=np.int64) - self.start_ns
        index = [rr.TimeColumn("time", duration=since_ns.astype("timedelta64[ns]"))]
        self.stream.send_columns(path, index, columns, strict=True)

    def plot(self, plot: Plot, stamps_ns: Sequence[int], values: NDArray[Any]) -> None:
        """Send a value for each stamp and series; NaN is a gap in the line."""
        if len(stamps_ns):
            columns = rr.Scalars.columns(scalars=values.reshape(-1, len(plot.series)))
            self.send(plot.path, stamps_ns, columns)


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
        count = int(np.searchsorted(self._stamps_ns, until_ns))
        if not count:
            return
        stamps_ns = np.array(self._stamps_ns[:count])
        values_ms = np.array(self._values_ns[:count]) / NS_PER_MS
        del self._stamps_ns[:count], self._values_ns[:count]
        windows = (stamps_ns - self._columns.start_ns) // WINDOW_NS
        edges = np.flatnonzero(np.diff(windows)) + 1
        rows = [
            (part.min(), part.max(), np.median(part), self._bound_ms)
            for part in np.split(values_ms, edges)
        ]
        self._columns.plot(self._plot, stamps_ns[[*(edges - 1), -1]].tolist(), np.array(rows))
