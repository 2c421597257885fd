"""Where a rollout starts: the first frames, states and sticks of a recorded flight."""

from bisect import bisect_right
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mavbridge.core.clock import NS_PER_S
from mavbridge.core.errors import UserError
from mavbridge.core.records import FloatArray, ImageArray, Sticks
from mavbridge.recording.flight_folder import RecordedFlight
from mavbridge.recording.rows import TickRow
from policy.preprocess import resize
from policy.world_model.config import WorldModelConfig

MAX_STATE_AGE_NS = 100_000_000
"""A frame whose last state is older starts nothing."""
MAX_HISTORY_S = 10.0
"""Sticks that were sent longer before the start are in no policy's history."""


@dataclass(frozen=True, kw_only=True)
class Start:
    """The observed past of a rollout, oldest first; the newest frame is its time zero."""

    images: NDArray[np.uint8]
    """[context_frames, H, W, 3] at the world model's size."""
    states: FloatArray
    """[context_frames, 13]"""
    newest_ns: int
    """Exposure of the newest frame, on the flight's clock."""
    sent: tuple[tuple[int, Sticks | None], ...]
    """What was sent before it, and when; None = released."""


def read_start(flight: RecordedFlight, config: WorldModelConfig, start_s: float) -> Start:
    """The context that a world model needs to go on from.

    Args:
        flight: from ``open_flight``.
        config: of the world model.
        start_s: of the first frame, since the first one that has a state.

    Raises:
        UserError: the flight is too short, has no states, or they are in another frame.
        VideoError: its video is damaged.
    """
    _require_state_frame(flight, config)
    captured_ns = flight.frames["captured_ns"].to_pylist()
    ticks = [row for row in flight.tick_rows() if row.tick.state is not None]
    if not captured_ns or not ticks:
        lacks = "no frames" if not captured_ns else "no state of the vehicle"
        raise UserError(f"--start {flight.folder} holds {lacks}: name a flight that was flown")
    stamps_ns = [_state_ns(row) for row in ticks]
    first_ns = next((at for at in captured_ns if at >= stamps_ns[0]), captured_ns[-1] + 1)
    first_ns += round(start_s * NS_PER_S)
    wanted_ns = [
        first_ns + round(k * config.frame_dt_s * NS_PER_S) for k in range(config.context_frames)
    ]
    half_ns = round(config.frame_dt_s * NS_PER_S / 2)
    if wanted_ns[-1] > captured_ns[-1] + half_ns:
        raise UserError(
            f"--start {flight.folder} is too short: {config.context_frames} frames "
            f"{config.frame_dt_s:g} s apart are needed from {start_s:g} s after its first state "
            f"on, its frames end {(captured_ns[-1] - first_ns) / NS_PER_S + start_s:.2f} s after it"
        )
    chosen = [_nearest(captured_ns, at_ns) for at_ns in wanted_ns]
    newest_ns = captured_ns[chosen[-1]]
    return Start(
        images=_images(flight, chosen, config.image_size),
        states=np.stack([_state_at(ticks, stamps_ns, captured_ns[k], flight) for k in chosen]),
        newest_ns=newest_ns,
        sent=_sent_before(flight, newest_ns),
    )


def _require_state_frame(flight: RecordedFlight, config: WorldModelConfig) -> None:
    contract, wanted = flight.meta.contract, config.contract.state_frame
    if contract is None or contract.state_frame != wanted:
        found = "an unknown frame" if contract is None else contract.state_frame
        raise UserError(
            f"--start {flight.folder} has its states in {found}, the world model takes {wanted}: "
            "name a flight of that kind, or a world model that was trained on this one"
        )


def _state_ns(row: TickRow) -> int:
    if row.tick.state is None:
        raise ValueError("a tick without a state has no stamp of one")
    return row.tick.state.attitude_ns


def _state_at(
    ticks: list[TickRow], stamps_ns: list[int], at_ns: int, flight: RecordedFlight
) -> FloatArray:
    """The last state that was known at an exposure."""
    place = bisect_right(stamps_ns, at_ns) - 1
    if place < 0 or at_ns - stamps_ns[place] > MAX_STATE_AGE_NS:
        raise UserError(
            f"--start {flight.folder} has no state of the vehicle there, at "
            f"{(at_ns - stamps_ns[0]) / NS_PER_S:.2f} s: choose another --start-at"
        )
    state = ticks[place].tick.state
    if state is None:
        raise ValueError("only ticks with a state were kept")
    return state.values


def _sent_before(flight: RecordedFlight, now_ns: int) -> tuple[tuple[int, Sticks | None], ...]:
    since_ns = now_ns - round(MAX_HISTORY_S * NS_PER_S)
    return tuple(
        (row.tick.sent_ns, row.tick.sent)
        for row in flight.tick_rows()
        if since_ns <= row.tick.sent_ns < now_ns
    )


def _images(flight: RecordedFlight, chosen: list[int], size: int) -> NDArray[np.uint8]:
    wanted = set(chosen)
    found: dict[int, ImageArray] = {}
    for index, rgb in enumerate(flight.images()):
        if index in wanted:
            found[index] = resize(rgb, size, size)
        if index >= chosen[-1]:
            break
    return np.stack([found[index] for index in chosen])


def _nearest(stamps_ns: list[int], at_ns: int) -> int:
    """Index of the stamp nearest to a time."""
    after = min(bisect_right(stamps_ns, at_ns), len(stamps_ns) - 1)
    before = max(after - 1, 0)
    return before if at_ns - stamps_ns[before] <= stamps_ns[after] - at_ns else after


class RealFrames:
    """What the flight's camera really saw after the start, at the world model's times and size.

    Decodes forward only, and keeps no more than a window, so that it serves segments that overlap.
    """

    def __init__(self, flight: RecordedFlight, config: WorldModelConfig, newest_ns: int) -> None:
        self._captured_ns: list[int] = flight.frames["captured_ns"].to_pylist()
        self._images: Iterator[ImageArray] = flight.images()
        self._config = config
        self._newest_ns = newest_ns
        self._decoded = 0
        self._window: deque[tuple[int, ImageArray]] = deque(maxlen=config.frames)
        """(step, image), the newest last."""

    def at(self, step: int) -> ImageArray | None:
        """The frame ``step`` times ``frame_dt_s`` after the start; None once the flight is over.

        Raises:
            ValueError: it has left the window: steps may go back by one segment at most.
            VideoError: the video is damaged.
        """
        next_step = self._window[-1][0] + 1 if self._window else 1
        for missing in range(next_step, step + 1):
            rgb = self._decode(missing)
            if rgb is None:
                return None
            self._window.append((missing, rgb))
        for known, rgb in self._window:
            if known == step:
                return rgb
        raise ValueError(f"step {step} has left the window")

    def _decode(self, step: int) -> ImageArray | None:
        at_ns = self._newest_ns + round(step * self._config.frame_dt_s * NS_PER_S)
        if at_ns > self._captured_ns[-1]:
            return None
        index = _nearest(self._captured_ns, at_ns)
        rgb = None
        while self._decoded <= index:
            rgb = next(self._images)
            self._decoded += 1
        # Two steps that share a frame: only a camera slower than the world model has them.
        size = self._config.image_size
        return self._window[-1][1] if rgb is None else resize(rgb, size, size)
