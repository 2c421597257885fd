"""Missed slots and late chunks of a recorded flight, each with its cause."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mavbridge.config.flight import Limits
from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.errors import MavbridgeError
from mavbridge.core.records import Solve, Tick
from mavbridge.flight.settings import effective_freshness
from mavbridge.guard.chunks import FreshnessLimits
from mavbridge.observe.timing import LATE_PERIODS
from mavbridge.recording import replay_tables
from mavbridge.recording.folder import PACKETS, SOLVES
from mavbridge.recording.replay_tables import read_solves
from mavbridge.recording.settings import read_settings
from mavbridge.recording.tables import read_table
from policy.contract import Contract

Stamps: TypeAlias = NDArray[np.int64]
Cause = Literal[
    "the guard woke late",
    "sending took long",
    "the policy took long",
    "the attitude came late",
    "the policy loop began late",
    "the attitude or the policy loop was late",
]
"""The last cause covers recordings without arrivals, which would tell its two cases apart."""
ATTITUDES = (30, 31)
"""Message ids of ATTITUDE and ATTITUDE_QUATERNION (MAVLink, common.xml)."""


class Arrivals(NamedTuple):
    """Attitudes of the vehicle in the order of measurement."""

    happened_ns: Stamps
    """[K] measurement times, as in ``VehicleState.attitude_ns``."""
    arrived_ns: Stamps
    """[K] arrivals at this computer."""


@dataclass(frozen=True, kw_only=True)
class DelayEvent:
    """A late chunk, or consecutive missed slots."""

    at_ns: int
    what: Literal["late chunk", "missed slots"]
    count: int
    """Number of missed slots; 1 for a chunk."""
    delay_ms: float
    """Time beyond the period."""
    cause: Cause


class _Solve(NamedTuple):
    """Computation of the chunk that a tick flew."""

    serial: int
    started_ns: int
    computed_ns: int
    attitude_ns: int | None


def is_gap(last: Tick, tick: Tick) -> bool:
    """True if the recording lacks ticks between these two neighbours."""
    return tick.serial != last.serial + 1


def find_delays(
    ticks: Sequence[Tick], *, stick_hz: float, action_hz: float, arrivals: Arrivals | None = None
) -> tuple[DelayEvent, ...]:
    """Return missed slots and late chunks while the policy flew, in the order of time.

    Gaps in which the recorder lost ticks are left out.
    """
    slot_ns, chunk_ns = NS_PER_S / stick_hz, NS_PER_S / action_hz
    found = [*_missed_slots(ticks, slot_ns), *_late_chunks(ticks, chunk_ns, arrivals)]
    return tuple(sorted(found, key=lambda delay: delay.at_ns))


def _missed_slots(ticks: Sequence[Tick], slot_ns: float) -> Iterator[DelayEvent]:
    for last, tick in pairwise(ticks):
        is_flown = last.trace is not None and tick.trace is not None
        if not is_flown or not tick.missed_slots or is_gap(last, tick):
            continue
        is_slow_send = last.sent_ns - last.woke_ns > slot_ns / 2
        yield DelayEvent(
            at_ns=tick.woke_ns,
            what="missed slots",
            count=tick.missed_slots,
            delay_ms=max(0.0, tick.sent_ns - last.sent_ns - slot_ns) / NS_PER_MS,
            cause="sending took long" if is_slow_send else "the guard woke late",
        )


def _late_chunks(
    ticks: Sequence[Tick], chunk_ns: float, arrivals: Arrivals | None
) -> Iterator[DelayEvent]:
    """Yield chunks that came more than ``LATE_PERIODS`` after the one before."""
    before: Tick | None = None
    last: _Solve | None = None
    for tick in ticks:
        if before is not None and is_gap(before, tick):
            last = None
        before, solve = tick, _solve_of(tick)
        if solve is None or last is None or solve.serial <= last.serial:
            if solve is None or last is None or solve.serial < last.serial:
                last = solve
            continue
        # Chunks in between, overtaken by newer ones before any send, were not late.
        count = solve.serial - last.serial
        period_ns = (solve.computed_ns - last.computed_ns) / count
        if period_ns > LATE_PERIODS * chunk_ns:
            yield DelayEvent(
                at_ns=tick.woke_ns,
                what="late chunk",
                count=1,
                delay_ms=(period_ns - chunk_ns) / NS_PER_MS,
                cause=_cause(last, solve, chunk_ns, arrivals),
            )
        last = solve


def _solve_of(tick: Tick) -> _Solve | None:
    if tick.trace is None or tick.chunk_serial is None or tick.chunk_computed_ns is None:
        return None
    return _Solve(
        serial=tick.chunk_serial,
        started_ns=tick.chunk_computed_ns - (tick.predict_ns or 0),
        computed_ns=tick.chunk_computed_ns,
        attitude_ns=None if tick.state is None else tick.state.attitude_ns,
    )


def _cause(last: _Solve, solve: _Solve, chunk_ns: float, arrivals: Arrivals | None) -> Cause:
    """Return the stage that caused most of the delay.

    A solve can start one period after the last one, once that has ended and an attitude is new.
    """
    due_ns = last.started_ns + (solve.serial - last.serial) * chunk_ns
    free_ns = max(due_ns, last.computed_ns)
    longer_ns = (solve.computed_ns - solve.started_ns) - (last.computed_ns - last.started_ns)
    solving_ns = max(0, longer_ns) + free_ns - due_ns
    waiting_ns = max(0.0, solve.started_ns - free_ns)
    if solving_ns >= waiting_ns:
        return "the policy took long"
    arrived_ns = _arrival_ns(arrivals, last, solve, chunk_ns)
    if arrived_ns is None:
        return "the attitude or the policy loop was late"
    attitude_ns = min(waiting_ns, max(0.0, arrived_ns - free_ns))
    loop_ns = waiting_ns - attitude_ns
    if solving_ns >= max(attitude_ns, loop_ns):
        return "the policy took long"
    return "the attitude came late" if attitude_ns > loop_ns else "the policy loop began late"


def _arrival_ns(
    arrivals: Arrivals | None, last: _Solve, solve: _Solve, chunk_ns: float
) -> int | None:
    """Return the arrival of the first attitude that could have started a solve; None: not recorded.

    It is newer than the last solve's attitude by half a period: the loop takes one that comes a
    quarter of a period early, and its due time can follow a late solve by half a period.
    """
    if arrivals is None or last.attitude_ns is None or solve.attitude_ns is None:
        return None
    usable_ns = min(last.attitude_ns + round(chunk_ns / 2), solve.attitude_ns)
    number = int(np.searchsorted(arrivals.happened_ns, usable_ns))
    if number == len(arrivals.happened_ns):
        return None
    if int(arrivals.happened_ns[number]) > solve.attitude_ns:
        return None  # the attitude used is not in the table: its row was lost
    return int(arrivals.arrived_ns[number])


def flown_limits(folder: Path, contract: Contract | None) -> FreshnessLimits | None:
    """Return the age limits when a stick is sent: the recorded flags', else the contract's."""
    if contract is None:
        return None
    try:
        limits = effective_freshness(contract, read_settings(folder).config.limits)
    except MavbridgeError:  # no settings, or those of another version
        limits = effective_freshness(contract, Limits())
    return limits.while_played(round(contract.play_s * NS_PER_S))


def read_arrivals(folder: Path, damage: list[str]) -> Arrivals | None:
    """Return the attitudes that reached the flight process; None if there is no such table.

    A sentence about any loss is appended to ``damage``.

    Raises:
        MavbridgeError: the table is damaged.
    """
    if not _has(folder, PACKETS):
        return None
    table = read_table(folder / PACKETS, replay_tables.PACKETS, damage=damage)
    columns = {name: table.column(name).to_numpy() for name in table.column_names}
    rows = np.flatnonzero(np.isin(columns["message_id"], ATTITUDES))
    if not len(rows):
        return None
    rows = rows[np.argsort(columns["happened_ns"][rows], kind="stable")]
    return Arrivals(columns["happened_ns"][rows], columns["arrived_ns"][rows])


def recorded_solves(folder: Path, contract: Contract | None) -> Iterator[Solve]:
    """Return the policy's solves in the order of time; nothing if they were not recorded.

    Raises:
        MavbridgeError: the table is damaged.
    """
    if contract is not None and _has(folder, SOLVES):
        table = read_table(folder / SOLVES, replay_tables.SOLVES)
        yield from (row.solve for row in read_solves(table, contract))


def _has(folder: Path, stem: str) -> bool:
    return any((folder / stem).with_suffix(end).exists() for end in (".parquet", ".arrows"))
