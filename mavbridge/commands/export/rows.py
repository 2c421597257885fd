"""From flights, where everything has its own rate, to rows: one a camera frame.

A row holds what was known at the exposure of its image: the state of the newest tick all of whose
messages had arrived by then, and the newest sticks to imitate of then or before. Nothing is
interpolated; how late each of them was, the stamps say.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise

import numpy as np

from mavbridge.core.clock import NS_PER_S
from mavbridge.core.errors import UserError
from policy.contract import ACTION_DIM, FloatArray
from policy.data.flight_data import FlightData, Nanoseconds
from policy.data.interpolation import MAX_GAP_NS

MAX_HELD_NS = MAX_GAP_NS
"""A state or sticks older than this are not those of a frame any more."""
MAX_MISSING_FRAMES = 1
"""In a row; where more are missing, a new episode begins, for rows are taken to be even in time."""
MIN_ROWS = 2
"""Less is no motion."""
MAX_RATE_OFF = 0.2
"""Of the common rate; flights further from it than this are of another one."""


@dataclass(frozen=True, kw_only=True)
class Stretch:
    """Consecutive frames of a flight, in each of which somebody flew: one episode of LeRobot."""

    episode: FlightData
    first_frame: int
    """Of the flight's frames."""
    captured_ns: Nanoseconds
    """[N] exposures."""
    tick_ns: Nanoseconds
    """[N] when a policy looked at the state."""
    attitude_ns: Nanoseconds
    """[N] arrival of its attitude."""
    velocity_ns: Nanoseconds
    """[N] arrival of its velocity."""
    state: FloatArray
    """[N, 13]"""
    action_ns: Nanoseconds
    """[N]"""
    action: FloatArray
    """[N, 4] sticks to imitate."""
    sent_ns: Nanoseconds
    """[N] the exposure, where nothing had been sent yet."""
    sent: FloatArray
    """[N, 4] sticks that flew; zeros where they were released."""

    def __len__(self) -> int:
        return len(self.captured_ns)

    def part(self, rows: slice) -> "Stretch":
        """Some consecutive rows of it."""
        start, _, step = rows.indices(len(self))
        if step != 1:
            raise ValueError("consecutive rows")
        changes = {
            f.name: getattr(self, f.name)[rows]
            for f in fields(self)
            if f.name not in ("episode", "first_frame")
        }
        return replace(self, first_frame=self.first_frame + start, **changes)


def stretches(episode: FlightData) -> list[Stretch]:
    """Align a flight to its frames, and cut out those that nobody flew.

    Args:
        episode: as ``policy.data.flight_folders.read_flight`` gives it.
    """
    captured_ns = episode.captured_ns
    arrived_ns = np.maximum.accumulate(np.maximum(episode.attitude_ns, episode.velocity_ns))
    tick = _newest(arrived_ns, captured_ns)
    target = _newest(episode.target_ns, captured_ns)
    sent = _newest(episode.sent_ns, captured_ns)
    is_known = (tick >= 0) & (target >= 0)
    is_known &= captured_ns - arrived_ns[tick] <= MAX_HELD_NS
    is_known &= captured_ns - episode.target_ns[target] <= MAX_HELD_NS
    is_known &= np.isfinite(episode.state[tick]).all(axis=1)
    nothing_sent = sent < 0
    none = np.zeros((1, ACTION_DIM), np.float32)
    # Index -1 is the row appended.
    sent_sticks = np.concatenate([episode.sent, none])[sent]
    sent_ns = np.where(nothing_sent, captured_ns, np.append(episode.sent_ns, 0)[sent])
    whole = Stretch(
        episode=episode,
        first_frame=0,
        captured_ns=captured_ns,
        tick_ns=episode.tick_ns[tick],
        attitude_ns=episode.attitude_ns[tick],
        velocity_ns=episode.velocity_ns[tick],
        state=episode.state[tick],
        action_ns=episode.target_ns[target],
        action=episode.target[target],
        sent_ns=sent_ns.astype(np.int64),
        sent=sent_sticks,
    )
    return [whole.part(rows) for rows in _runs(captured_ns, is_known)]


def _newest(stamps_ns: Nanoseconds, at_ns: Nanoseconds) -> np.ndarray:
    """[N] index of the newest stamp at or before each time; -1 where there is none."""
    return np.searchsorted(stamps_ns, at_ns, side="right") - 1


def _runs(captured_ns: Nanoseconds, is_known: np.ndarray) -> list[slice]:
    """Consecutive frames that are known and without a hole between them."""
    if len(captured_ns) < MIN_ROWS:
        return []
    periods = np.diff(captured_ns)
    longest = (MAX_MISSING_FRAMES + 1.5) * np.median(periods)
    is_cut = (periods > longest) | (is_known[1:] != is_known[:-1])
    edges = [0, *(np.flatnonzero(is_cut) + 1).tolist(), len(captured_ns)]
    runs = [slice(a, b) for a, b in pairwise(edges)]
    return [run for run in runs if is_known[run.start] and run.stop - run.start >= MIN_ROWS]


def common_fps(parts: Sequence[Stretch]) -> int:
    """The whole number of frames a second that LeRobot takes all of them to have.

    Raises:
        UserError: flights of several rates.
    """
    fps = max(1, round(_rate_hz(np.concatenate([np.diff(p.captured_ns) for p in parts]))))
    for part in parts:
        own = _rate_hz(np.diff(part.captured_ns))
        if abs(own / fps - 1.0) > MAX_RATE_OFF:
            raise UserError(
                f"{part.episode.name} has {own:.3g} frames a second, most of the rest {fps}: a "
                "LeRobot dataset has one rate, so export them apart"
            )
    return fps


def _rate_hz(periods_ns: Nanoseconds) -> float:
    """Mean rate, where no frame is missing."""
    whole = periods_ns[periods_ns <= 1.5 * np.median(periods_ns)]
    return NS_PER_S / float(np.maximum(whole.mean(), 1.0))


def worst_shift_ns(part: Stretch, fps: int) -> int:
    """How far a frame is at most from its place on LeRobot's even grid."""
    even_ns = np.round(np.arange(len(part)) * (NS_PER_S / fps)).astype(np.int64)
    return int(np.abs(part.captured_ns - part.captured_ns[0] - even_ns).max())
