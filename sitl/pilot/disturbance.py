"""Perturbed demonstrations, which contain recoveries: disturbed actions and airborne starts.

The disturbed actions are flown while the expert's remain the label, so that the data show the way
back from a mistake (Laskey et al., "DART: Noise Injection for Robust Imitation Learning", 2017).
All randomness follows from a seed.
"""

import math
from typing import Literal, NamedTuple, TypeAlias, TypeVar

import numpy as np

from sitl.course import LOOP_SEEDS, RACE_SEEDS, AirborneStart, Course
from sitl.pilot.demonstrator import RateCommand, StickPositions
from sitl.vehicle.dynamics import clamp
from sitl.vehicle.rotation import from_euler

Numbers: TypeAlias = tuple[float, ...]
Commanded = TypeVar("Commanded", StickPositions, RateCommand)

QUIET_S = (1.0, 5.0)
NOISY_S = (0.5, 2.0)
PULSE_S = (0.15, 0.5)
NOISE_TIME_S = 0.25  # correlation time of the noise: about that of a thumb
START_AWAY_M = (3.0, 5.5)
"""Distance before a gate of an easy course: past the previous gate, as legs are at least 7 m."""
RACE_START_AWAY_M = (4.0, 8.5)  # before a gate of a race course, whose legs are at least 10 m
LATE_CHANCE = 0.3
LATE_S = (0.2, 2.0)


ZEROS: Numbers = (0.0,) * 4  # no offset; as an action, by sticks or rates, a no-op on the ground


class Strengths(NamedTuple):
    """Disturbance of one kind of action, by action number."""

    noise_rms: Numbers
    pulse_max: Numbers
    low: Numbers
    high: Numbers


STICK_STRENGTHS = Strengths(
    noise_rms=(0.25, 0.12, 0.25, 0.25),
    pulse_max=(0.6, 0.4, 0.6, 0.6),
    low=(-1.0,) * 4,
    high=(1.0,) * 4,
)
RATE_STRENGTHS = Strengths(
    noise_rms=(0.06, 1.0, 1.0, 0.4),
    pulse_max=(0.15, 2.5, 2.5, 1.0),
    low=(0.0, -4.0, -4.0, -2.1),
    high=(0.9, 4.0, 4.0, 2.1),
)


class _Stretch(NamedTuple):
    kind: Literal["quiet", "noise", "pulse", "late"]
    end_s: float
    offset: Numbers


class Disturbance:
    """Stretches of correlated noise and held pulses on the actions, with quiet ones in between.

    ``strength`` scales amplitudes; 0 never disturbs. Use one instance per flight and call `flown`
    at every tick, in order of time. Some flights from the ground start late.
    """

    def __init__(
        self,
        seed: int,
        *,
        strength: float = 1.0,
        from_ground: bool = True,
        strengths: Strengths = STICK_STRENGTHS,
    ) -> None:
        self._strengths = strengths
        self._random = np.random.Generator(np.random.PCG64(seed))
        self._strength = strength
        self._start_s: float | None = None
        self._last_s = 0.0
        self._noise = np.zeros(4)
        late = from_ground and self._random.random() < LATE_CHANCE * strength
        end_s = float(self._random.uniform(*(LATE_S if late else QUIET_S)))
        self._stretch = _Stretch("late" if late else "quiet", end_s, ZEROS)

    @property
    def active(self) -> bool:
        """True if the last call of `flown` disturbed the action."""
        return self._strength > 0.0 and self._stretch.kind != "quiet"

    def flown(self, wanted: Commanded, t_s: float) -> Commanded:
        """Return the action to fly at ``t_s`` for the expert's ``wanted``, within the bounds."""
        if self._start_s is None:
            self._start_s = t_s
        t_s -= self._start_s
        dt_s, self._last_s = t_s - self._last_s, t_s
        while t_s >= self._stretch.end_s:
            self._stretch = self._next(self._stretch)
        # Ornstein-Uhlenbeck process, exact for any step.
        kept = math.exp(-max(dt_s, 0.0) / NOISE_TIME_S)
        fresh = math.sqrt(1.0 - kept * kept) * self._random.standard_normal(4)
        self._noise = kept * self._noise + fresh * np.array(self._strengths.noise_rms)
        if not self.active:
            return wanted
        if self._stretch.kind == "late":
            return type(wanted)(*ZEROS)
        offset = self._noise if self._stretch.kind == "noise" else self._stretch.offset
        bounds = zip(wanted, offset, self._strengths.low, self._strengths.high, strict=True)
        disturbed = [
            max(low, min(high, number + self._strength * float(off)))
            for number, off, low, high in bounds
        ]
        return type(wanted)(*disturbed)

    def _next(self, ended: _Stretch) -> _Stretch:
        if ended.kind != "quiet":
            return _Stretch("quiet", ended.end_s + float(self._random.uniform(*QUIET_S)), ZEROS)
        if self._random.random() < 0.5:
            self._noise[:] = 0.0
            return _Stretch("noise", ended.end_s + float(self._random.uniform(*NOISY_S)), ZEROS)
        # A pulse acts on one or two numbers, like a slip of the thumb.
        held = self._random.uniform(-1.0, 1.0, 4) * np.array(self._strengths.pulse_max)
        held *= self._random.permutation([1.0, 1.0, 0.0, 0.0])
        length_s = float(self._random.uniform(*PULSE_S))
        return _Stretch("pulse", ended.end_s + length_s, tuple(held.tolist()))


def random_start(course: Course, seed: int, *, speed_mps: float) -> AirborneStart:
    """Draw a start before a random gate, off its axis, moving and facing roughly along it."""
    random = np.random.Generator(np.random.PCG64(seed))
    gate = course.gates[int(random.integers(len(course.gates)))]
    is_race = RACE_SEEDS <= course.seed < LOOP_SEEDS
    away_m = float(random.uniform(*(RACE_START_AWAY_M if is_race else START_AWAY_M)))
    side_m = clamp(float(random.normal(0.0, 1.2)), 0.4 * away_m)
    up_m = float(random.normal(0.0, 0.5))
    heading_rad = gate.yaw_rad + float(random.normal(0.0, 0.2))
    track_rad = gate.yaw_rad + float(random.normal(0.0, 0.25))
    pace_mps = speed_mps * float(random.uniform(0.2, 1.0))
    lean_rad = random.normal(0.0, 0.12, 2).tolist()
    north_m, east_m, down_m = gate.center_ned_m
    cos_yaw, sin_yaw = math.cos(gate.yaw_rad), math.sin(gate.yaw_rad)
    return AirborneStart(
        position_ned_m=(
            north_m - away_m * cos_yaw - side_m * sin_yaw,
            east_m - away_m * sin_yaw + side_m * cos_yaw,
            min(-1.2, down_m - up_m),
        ),
        velocity_ned_mps=(
            pace_mps * math.cos(track_rad),
            pace_mps * math.sin(track_rad),
            float(random.normal(0.0, 0.5)),
        ),
        ned_from_body_wxyz=from_euler(lean_rad[0], lean_rad[1] - 0.05, heading_rad),
        next_gate=gate.index,
    )
