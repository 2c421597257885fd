"""Bring-up policies that fly a fixed program by feedback on velocity: no weights, no torch.

They speak the whole dual-rate protocol, so both loops, the link and the vehicle can be tried before
anything is trained. They fly an autopilot that holds altitude at mid-stick (ArduPilot ALT_HOLD,
PX4 ALTCTL): the throttle stick is a climb rate, pitch and roll are lean angles, yaw is a yaw rate.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from policy.contract import ACTION_DIM, QUATERNION, RATE, STATE_DIM, VELOCITY, Contract, FloatArray
from policy.errors import PolicyError

FEATURE_DIM = 8
DEFAULT_CONTRACT = Contract()

# ArduCopter at full stick, default parameters; and the dead zone of its throttle.
FULL_CLIMB_MPS = 2.5
FULL_LEAN_ACCEL_MPS2 = 9.80665 * math.tan(math.radians(30.0))
FULL_YAW_RATE_RADPS = math.radians(202.5)
THROTTLE_DEADZONE = 0.2
"""Stick within this of the middle holds altitude."""

TAKEOFF_ALTITUDE_M = 3.0
TAKEOFF_CLIMB_MPS = 1.5
TAKEOFF_TOLERANCE_M = 0.2
HOLD_TOLERANCE_M = 0.15
"""Within it the stick is centred and the autopilot holds altitude by itself."""
SETTLE_S = 2.0
"""Between reaching the altitude and the start of the program."""

CLIMB_PER_ALTITUDE = 1.0  # 1/s
CLIMB_RATE_GAIN = 0.5  # m/s of command for each m/s short of the wanted climb
LEAN_PER_MPS = 0.3  # stick for each m/s of error: closes in 0.6 s, slower than a lean builds up
LEAN_PER_WANTED_MPS = 0.04  # against drag
YAW_RATE_GAIN = 0.3
MAX_LEAN_STICK = 0.6
LEG_S, LEG_MPS = 4.0, 1.5
YAW_RATE_RADPS = math.radians(30.0)
MAX_STEP_S = 0.2
"""Longest time over which one climb-rate reading is integrated."""


class Motion(NamedTuple):
    """Motion that the program demands, in the horizontal frame that turns with the nose."""

    forward_mps: float = 0.0
    right_mps: float = 0.0
    yaw_rate_radps: float = 0.0


class _Measured(NamedTuple):
    forward_mps: float
    right_mps: float
    climb_mps: float
    yaw_rate_radps: float


_LEGS = (Motion(LEG_MPS), Motion(0.0, LEG_MPS), Motion(-LEG_MPS), Motion(0.0, -LEG_MPS))
_PROGRAMS: dict[str, Callable[[float], Motion]] = {
    "hover": lambda _: Motion(),
    "square": lambda time_s: _LEGS[int(time_s / LEG_S) % len(_LEGS)],
    "circle": lambda _: Motion(forward_mps=LEG_MPS, yaw_rate_radps=YAW_RATE_RADPS),
    "yaw": lambda _: Motion(yaw_rate_radps=YAW_RATE_RADPS),
}
PROGRAM_NAMES = tuple(_PROGRAMS)


class ScriptedPolicy:
    """Takes off to 3 m from where it is first asked, or was reset, then flies ``program`` for ever.

    The state has no position: altitude is the integral of the measured climb rate, so a ground that
    is left late costs nothing, and it drifts as the vehicle's own velocity estimate does. Used by
    one thread.

    Raises:
        PolicyError: the program is unknown.
    """

    def __init__(
        self, program: str, now_s: Callable[[], float], *, contract: Contract = DEFAULT_CONTRACT
    ) -> None:
        if program not in _PROGRAMS:
            raise PolicyError(
                f"scripted program {program!r} is unknown; use one of {list(PROGRAM_NAMES)}"
            )
        self.contract = replace(contract, feature_dim=FEATURE_DIM, arrays="numpy")
        self._program = _PROGRAMS[program]
        self._now_s = now_s
        self._last_s: float | None = None
        self._altitude_m = 0.0
        self._program_start_s: float | None = None

    def reset(self) -> None:
        """Begin again: the altitude of now is the ground."""
        self._last_s = self._program_start_s = None
        self._altitude_m = 0.0

    def encode_visual(self, image: FloatArray) -> FloatArray:
        """Image [1, 3, H, W] -> mean and deviation of each channel, zeros: [1, 8]."""
        sparse = image[:, :, ::4, ::4]
        feature = np.zeros((image.shape[0], FEATURE_DIM), np.float32)
        feature[:, :3] = sparse.mean(axis=(2, 3))
        feature[:, 3:6] = sparse.std(axis=(2, 3))
        return feature

    def predict(
        self,
        image: FloatArray,
        state: FloatArray,
        action_history: FloatArray,
        num_diffusion_steps: int,
    ) -> FloatArray:
        """``encode_visual``, then ``predict_fast``."""
        feature = self.encode_visual(image)
        return self.predict_fast(feature, state, action_history, num_diffusion_steps)

    def predict_fast(
        self,
        feature: FloatArray,
        state: FloatArray,
        action_history: FloatArray,
        num_diffusion_steps: int,
    ) -> FloatArray:
        """State [1, 13] in ``ned_frd`` -> chunk [1, 16, 4]; the other arguments are not used.

        Each action is the program's motion at its own time with the feedback of now.

        Raises:
            PolicyError: the state is not [1, 13].
        """
        if state.shape != (1, STATE_DIM):
            raise PolicyError(f"state must be [1, {STATE_DIM}], got {list(state.shape)}")
        now_s = self._now_s()
        measured = _measure(state[0])
        self._follow(now_s, measured)
        throttle = self._throttle(measured)
        chunk = np.zeros((1, self.contract.horizon, ACTION_DIM), np.float32)
        for index in range(self.contract.horizon):
            wanted = self._wanted(now_s + index * self.contract.chunk_dt_s)
            chunk[0, index] = (throttle, *_lean_and_yaw(wanted, measured))
        return chunk

    def _follow(self, now_s: float, measured: _Measured) -> None:
        """Integrate altitude, and start the program once it is reached."""
        if self._last_s is not None:
            step_s = min(max(now_s - self._last_s, 0.0), MAX_STEP_S)
            self._altitude_m += measured.climb_mps * step_s
        self._last_s = now_s
        up = self._altitude_m > TAKEOFF_ALTITUDE_M - TAKEOFF_TOLERANCE_M
        if up and self._program_start_s is None:
            self._program_start_s = now_s + SETTLE_S

    def _wanted(self, time_s: float) -> Motion:
        start_s = self._program_start_s
        if start_s is None or time_s < start_s:
            return Motion()
        return self._program(time_s - start_s)

    def _throttle(self, measured: _Measured) -> float:
        error_m = TAKEOFF_ALTITUDE_M - self._altitude_m
        if self._program_start_s is not None and abs(error_m) < HOLD_TOLERANCE_M:
            return 0.0
        wanted = _clip(CLIMB_PER_ALTITUDE * error_m, TAKEOFF_CLIMB_MPS)
        command = wanted + CLIMB_RATE_GAIN * (wanted - measured.climb_mps)
        beyond_deadzone = (1 - THROTTLE_DEADZONE) * command / FULL_CLIMB_MPS
        return _clip(math.copysign(THROTTLE_DEADZONE, command) + beyond_deadzone, 1.0)


def _measure(state: FloatArray) -> _Measured:
    """Velocities in the heading frame from the 13-D state in ``ned_frd``."""
    north, east, down = (float(v) for v in state[VELOCITY])
    w, x, y, z = (float(q) for q in state[QUATERNION])
    # Heading of the nose: yaw of the Z-Y-X Euler angles of a unit quaternion.
    heading = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    cos, sin = math.cos(heading), math.sin(heading)
    return _Measured(
        forward_mps=cos * north + sin * east,
        right_mps=cos * east - sin * north,
        climb_mps=-down,
        yaw_rate_radps=float(state[RATE][2]),
    )


def _lean_and_yaw(wanted: Motion, measured: _Measured) -> tuple[float, float, float]:
    """Sticks yaw, pitch, roll: +pitch leans forward, +roll leans right."""
    pitch = LEAN_PER_WANTED_MPS * wanted.forward_mps
    pitch += LEAN_PER_MPS * (wanted.forward_mps - measured.forward_mps)
    roll = LEAN_PER_WANTED_MPS * wanted.right_mps
    roll += LEAN_PER_MPS * (wanted.right_mps - measured.right_mps)
    # A turn at speed v needs the sideways acceleration v * yaw_rate.
    roll += wanted.forward_mps * wanted.yaw_rate_radps / FULL_LEAN_ACCEL_MPS2
    yaw_rate = wanted.yaw_rate_radps
    yaw_rate += YAW_RATE_GAIN * (wanted.yaw_rate_radps - measured.yaw_rate_radps)
    return (
        _clip(yaw_rate / FULL_YAW_RATE_RADPS, 1.0),
        _clip(pitch, MAX_LEAN_STICK),
        _clip(roll, MAX_LEAN_STICK),
    )


def _clip(value: float, limit: float) -> float:
    return max(-limit, min(limit, value))
