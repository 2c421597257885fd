"""One flight as arrays, independent of its file format.

All data keep their own timestamps, so the rates of camera, telemetry and sticks need not match.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from policy.contract import QUATERNION, STATE_NAMES, STICK_TERMS, Contract, FloatArray
from policy.errors import DatasetError
from policy.preprocess import STATE_SCALE

Nanoseconds = NDArray[np.int64]
ImageArray = NDArray[np.uint8]

GATE_DIM = 7
"""Centre of the next gate in FRD body axes [3] m, heading of its passage rad, centre of the gate
after it [3] m; all at the exposure, NaN if unknown."""

MAX_STATE_SCALES = 30.0
"""A state this many times its usual size has another unit: 150 m/s, or milli-g for m/s^2."""


@dataclass(frozen=True, kw_only=True)
class FlightData:
    """One flight; all stamps are of one monotonic clock and never decrease."""

    name: str
    """For messages, e.g. the folder."""
    tick_ns: Nanoseconds
    """[T] decisions of the policy: image age and action history are relative to these."""
    state: FloatArray
    """[T, 13] state as flown; NaN if it is unknown or must not be imitated."""
    attitude_ns: Nanoseconds
    """[T] measurement of the attitude: the first action of a chunk acts then."""
    velocity_ns: Nanoseconds
    """[T] measurement of the velocity."""
    target_ns: Nanoseconds
    target: FloatArray
    """[M, 4] sticks to imitate, at ``target_ns`` [M]; for a flight by rates, the sticks that
    ``policy.motion.stick_loop`` would have converted to the same rates."""
    sent_ns: Nanoseconds
    sent: FloatArray
    """[S, 4] sticks that flew, each until the next; centred if none, and in flights by rates."""
    age_ns: Nanoseconds
    """[A] measured ages of the image at a decision; may be empty."""
    captured_ns: Nanoseconds
    """[N] exposures."""
    gate: FloatArray
    """[N, 7], see ``GATE_DIM``."""
    decode: Callable[[], Iterator[ImageArray]]
    """Yields the images [H, W, 3] uint8 RGB in the order of ``captured_ns``."""
    contract: Contract
    """Contract by which it was flown; of a dataset, the state's frame and ``STICK_TERMS``, by
    default those of ``Contract``."""
    course_seed: int | None = None
    """Seed of the simulated course; its flights are held out together. None: unknown."""
    damage: tuple[str, ...] = ()
    """Skipped parts of its files, in sentences for the user."""

    def __post_init__(self) -> None:
        for name in ("tick_ns", "target_ns", "sent_ns", "captured_ns"):
            if (backwards := np.flatnonzero(np.diff(getattr(self, name)) < 0)).size:
                row = int(backwards[0]) + 1
                raise DatasetError(f"{self.name}: {name} runs backwards at row {row}")
        for name in ("target", "sent"):
            if not np.abs(getattr(self, name)).max(initial=0.0) <= 1.0:  # also for NaN
                raise DatasetError(f"{self.name}: {name} must be sticks in [-1, 1]")
        self._check_state()

    def _check_state(self) -> None:
        known = self.state[~np.isnan(self.state).all(axis=1)]
        if not np.isfinite(known).all():
            column = STATE_NAMES[int(np.flatnonzero(~np.isfinite(known).all(axis=0))[0])]
            raise DatasetError(f"{self.name}: the state holds NaN or infinity in {column}")
        if len(known) == 0:
            return
        high = np.quantile(np.abs(known), 0.99, axis=0) / np.asarray(STATE_SCALE)
        if high.max() > MAX_STATE_SCALES:
            worst = int(high.argmax())
            raise DatasetError(
                f"{self.name}: {STATE_NAMES[worst]} reaches {high[worst] * STATE_SCALE[worst]:g}, "
                "which no flight does: is it in another unit?"
            )
        length = np.linalg.norm(known[:, QUATERNION], axis=1)
        if np.abs(length - 1.0).max() > 0.01:
            raise DatasetError(f"{self.name}: the attitude is not a unit quaternion")


def common_contract(flights: Sequence[FlightData]) -> Contract:
    """Return the contract of flights of one state frame and one meaning of the action.

    It has the largest of their tilts, and stops at the end if all flights do.
    """
    first, name = flights[0].contract, flights[0].name
    stick_terms = STICK_TERMS if first.action == "sticks" else ()
    terms = ("state_frame", "action", "hover_thrust", *stick_terms)
    for flight, term in product(flights, terms):
        if (here := getattr(first, term)) != (there := getattr(flight.contract, term)):
            raise DatasetError(
                f"{name} was flown by a contract with {term} {here}, {flight.name} with {there}: "
                "train on one kind at a time"
            )
    contracts = [flight.contract for flight in flights]
    tilts_deg = [each.max_tilt_deg for each in contracts if each.max_tilt_deg is not None]
    return replace(
        first,
        max_tilt_deg=max(tilts_deg, default=None),
        stops_at_end=all(each.stops_at_end for each in contracts),
    )


def hold_out(
    flights: Sequence[FlightData], fraction: float, seed: int
) -> tuple[list[int], list[int]]:
    """Return the indices of the flights for training and for validation.

    The flights of one course seed stay together. With two courses or more and a fraction above 0,
    at least one course is held out and one is kept; a flight without a seed is a course of its own.
    """
    courses = [
        ("flight", index) if flight.course_seed is None else ("seed", flight.course_seed)
        for index, flight in enumerate(flights)
    ]
    groups = list(dict.fromkeys(courses))
    order = np.random.default_rng([seed, 1]).permutation(len(groups)).tolist()
    count = min(max(1, round(fraction * len(groups))), len(groups) - 1) if fraction > 0 else 0
    chosen = {groups[number] for number in order[:count]}
    held = [index for index, course in enumerate(courses) if course in chosen]
    return [index for index in range(len(flights)) if index not in held], held
