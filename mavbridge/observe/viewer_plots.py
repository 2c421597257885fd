"""Plots over time, sent in columns of values; fast signals are reduced to their spread."""

import math
from bisect import bisect_left
from collections.abc import Iterable, Sequence
from itertools import groupby, pairwise
from operator import itemgetter
from statistics import median
from typing import Any

import numpy as np
import rerun as rr

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.records import Tick, VisionTick
from mavbridge.core.vehicle import Action, Sticks
from mavbridge.observe import viewer_layout as layout
from mavbridge.observe.timing import FlownChunks
from mavbridge.observe.viewer_layout import Plot, ViewedFlight

WINDOW_NS = NS_PER_S // 4


class Columns:
    """Sends values to one recording on the timeline ``time``, which starts at ``start_ns``.

    Rows of plots are collected until ``flush``, because one call of the SDK costs as much as a
    hundred rows.
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
        """Keep a row for each stamp, with a value for each series; NaN is a gap in its line."""
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
    """Minimum, maximum and median of one quantity per window of ``WINDOW_NS``, beside a bound.

    In a plot of a minute, a quantity that jumps with every tick would be a solid block.
    """

    def __init__(self, columns: Columns, plot: Plot, bound_ns: float | None) -> None:
        self._columns = columns
        self._plot = plot
        self._bound_ms = np.nan if bound_ns is None else bound_ns / NS_PER_MS
        self._values_ns: list[tuple[int, float]] = []
        """Stamps and values that no completed window has shown yet."""

    def extend(self, values_ns: Iterable[tuple[int, float]]) -> None:
        """Add stamps with their values, and show the completed windows."""
        self._values_ns += values_ns
        if self._values_ns:
            start_ns = self._columns.start_ns
            elapsed_ns = self._values_ns[-1][0] - start_ns
            self._show(until_ns=start_ns + elapsed_ns // WINDOW_NS * WINDOW_NS)

    def close(self) -> None:
        """Show the unfinished window."""
        if self._values_ns:
            self._show(until_ns=self._values_ns[-1][0] + 1)

    def _show(self, until_ns: int) -> None:
        count = bisect_left(self._values_ns, until_ns, key=itemgetter(0))
        shown_ns = self._values_ns[:count]
        del self._values_ns[:count]
        start_ns = self._columns.start_ns
        for _, window in groupby(shown_ns, key=lambda pair: (pair[0] - start_ns) // WINDOW_NS):
            stamps, values = zip(*window, strict=True)
            row = [value / NS_PER_MS for value in (min(values), max(values), median(values))]
            self._columns.plot(self._plot, stamps[-1:], [[*row, self._bound_ms]])


ALLOWED_SHARE = 0.001
"""Our criterion: share of slots and of images that a minute at full rate is allowed to lose."""
_GAP = Sticks(math.nan, math.nan, math.nan, math.nan)


class TimingPlots:
    """Plots of the page ``Timing``; images are those of the first camera."""

    def __init__(self, columns: Columns, flight: ViewedFlight, *, is_live: bool) -> None:
        self._columns = columns
        self._is_live = is_live
        slot_ns, chunk_ns = NS_PER_S / flight.stick_hz, NS_PER_S / flight.chunk_hz
        self._slot_ns, self._vision_ns = slot_ns, NS_PER_S / flight.vision_hz
        bounds_ns = {
            layout.IMAGE_AGE: flight.max_feature_age_ns,
            layout.ATTITUDE_AGE: flight.max_state_age_ns,
            layout.LATENESS: slot_ns,
            layout.CHUNK_PERIOD: chunk_ns,
            layout.PREDICT: chunk_ns,
            layout.VISION_JITTER: self._vision_ns,
            layout.VISION_PERIOD: self._vision_ns,
            layout.ENCODE: self._vision_ns,
        }
        self._spreads = {
            plot: Spread(columns, plot, bound_ns) for plot, bound_ns in bounds_ns.items()
        }
        self._chunks = FlownChunks()
        self._last_started_ns: int | None = None
        self._missed_slots = self._images = 0
        self._first_dropped: int | None = None

    def show_ticks(self, ticks: Sequence[Tick]) -> None:
        """Plot the ages, and the lateness of the sends in slots."""
        self._spreads[layout.IMAGE_AGE].extend(
            (tick.sent_ns, tick.sent_ns - tick.feature_captured_ns)
            for tick in ticks
            if tick.feature_captured_ns is not None
        )
        self._spreads[layout.ATTITUDE_AGE].extend(
            (tick.sent_ns, tick.sent_ns - tick.state.attitude_ns)
            for tick in ticks
            if tick.state is not None
            # Without a chunk the state is the newest when the tick is read, perhaps a later one.
            and (tick.trace is not None or tick.state.attitude_ns <= tick.sent_ns)
        )
        self._spreads[layout.LATENESS].extend(
            (tick.sent_ns, max(0, tick.sent_ns - tick.due_ns))
            for tick in ticks
            if tick.is_slot and tick.trace is not None
        )
        self._show_chunks(ticks)
        self._missed_slots += sum(tick.missed_slots for tick in ticks)
        last_ns = ticks[-1].woke_ns
        slots = (last_ns - self._columns.start_ns) / self._slot_ns
        self._count(layout.MISSED, last_ns, self._missed_slots, slots)

    def _show_chunks(self, ticks: Sequence[Tick]) -> None:
        """Plot the periods and the computing times of the flown chunks."""
        for tick in ticks:
            newest, last = self._chunks.add(tick)
            if newest is not None and last is not None:
                period_ns = newest.period_ns(last)
                self._spreads[layout.CHUNK_PERIOD].extend([(tick.sent_ns, period_ns)])
            if newest is not None and tick.predict_ns is not None:
                self._spreads[layout.PREDICT].extend([(tick.sent_ns, tick.predict_ns)])

    def show_visions(self, visions: Sequence[VisionTick]) -> None:
        """Plot the images of one camera; of a recording, only their periods."""
        started_ns = [vision.started_ns for vision in visions]
        if self._last_started_ns is not None:
            started_ns.insert(0, self._last_started_ns)
        self._last_started_ns = started_ns[-1]
        periods_ns = [(after, after - before) for before, after in pairwise(started_ns)]
        self._spreads[layout.VISION_PERIOD].extend(periods_ns)
        jitter_ns = [(stamp, abs(period - self._vision_ns)) for stamp, period in periods_ns]
        self._spreads[layout.VISION_JITTER].extend(jitter_ns)
        if not self._is_live:
            return
        encode_ns = [(each.ready_ns, each.ready_ns - each.started_ns) for each in visions]
        self._spreads[layout.ENCODE].extend(encode_ns)
        if self._first_dropped is None:
            self._first_dropped = visions[0].dropped_frames
        dropped = visions[-1].dropped_frames - self._first_dropped
        self._images += len(visions)
        self._count(layout.DROPPED, visions[-1].ready_ns, dropped, self._images + dropped)

    def _count(self, plot: layout.Plot, stamp_ns: int, count: int, of_all: float) -> None:
        self._columns.plot(plot, [stamp_ns], [(of_all * ALLOWED_SHARE, count)])

    def close(self) -> None:
        """Show the unfinished windows."""
        for spread in self._spreads.values():
            spread.close()


class ActionPlots:
    """Plots of each number of the actions: as output by the policy, as sent, and as echoed."""

    def __init__(self, columns: Columns, flight: ViewedFlight) -> None:
        self._columns = columns
        self._is_sticks = flight.contract.action == "sticks"
        self._plots = layout.action_plots(flight.contract.action)

    def show(self, ticks: Sequence[Tick]) -> None:
        """Plot all ticks."""
        stamps_ns = [tick.woke_ns for tick in ticks]
        rows = [list(zip(*self._stages(tick), strict=True)) for tick in ticks]
        for axis, plot in enumerate(self._plots):
            self._columns.plot(plot, stamps_ns, [row[axis] for row in rows])

    def _stages(self, tick: Tick) -> tuple[Action, ...]:
        echo: Action = (tick.rc_sticks if self._is_sticks else None) or _GAP
        return echo, _GAP if tick.trace is None else tick.trace.raw, tick.sent or _GAP
