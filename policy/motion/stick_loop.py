"""Converts sticks to thrust and body rates: closes attitude and climb loops at the action rate.

The built-in networks compute sticks, even if their contract says rates: lean, yaw rate and climb as
for an autopilot mode that holds the height, with full stick by the contract. In such a mode the
autopilot closes the loops; with rates, this module does, from the newest state. So the image
decides the direction, and the attitude never waits for it. A network trained on thrust and rates
directly copied the vehicle's own rates and flew into the first gates; see ``docs/dev/log.md``.
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from policy.contract import QUATERNION, RATE, SPECIFIC_FORCE, VELOCITY, Contract, FloatArray
from policy.errors import ContractError
from policy.motion.rotation import (
    Array,
    Quaternion,
    Vector,
    conjugate,
    level_heading,
    matrix_columns,
    multiply,
    rotate,
)
from policy.protocol import PolicyRunner

GRAVITY_MPS2 = 9.80665
TILT_GAIN_PER_S = 8.0
"""Body rate per tilt error [1/s]; the gain of the expert that demonstrates."""
CLIMB_GAIN_PER_S = 4.0
LAG_S = 0.06
"""Lag from rate command to rate: motors and rate controller."""
MAX_TILT_RATE_RADPS = math.radians(200.0)
UP_FORCE_MPS2 = (3.0, 21.0)
"""Least and largest vertical specific force."""
MIN_COS_TILT = 0.35
"""Cosine of the lean beyond which the thrust no longer holds the height."""
SOLVES = (40, 100)
"""Solves that thrust, force and drag are averaged over: at first, and later (1 s at 100 Hz)."""
LEAST_SPEED_MPS = 1.0
"""Speed that only a vehicle in the air reaches: on the ground, thrust changes no force."""
THRUST_GAINS = (0.6, 1.6)
"""Least and largest factor on thrust."""
RATES_FULL_LEAN_DEG = 65.0
RATES_FULL_YAW_RATE_DEGPS = 115.0
RATES_FULL_CLIMB_MPS = 6.0
"""Motion at full stick of a network that learns from flights by rates."""


class StickMotion(NamedTuple):
    """Motion that sticks demand; leans are forward and to the right."""

    climb_mps: float
    yaw_rate_radps: float
    forward_rad: float
    right_rad: float


def motion_of_sticks(
    contract: Contract, throttle: float, yaw: float, pitch: float, roll: float
) -> StickMotion:
    """Return the motion that sticks in [-1, 1] demand by the contract's ranges and dead zones."""
    climb = _beyond(throttle, contract.throttle_dead_zone)
    lean_rad = math.radians(contract.full_lean_deg)
    return StickMotion(
        climb * (contract.full_climb_mps if climb > 0 else contract.full_descent_mps),
        math.radians(contract.full_yaw_rate_degps) * _beyond(yaw, contract.yaw_dead_zone),
        lean_rad * _beyond(pitch, contract.lean_dead_zone),
        lean_rad * _beyond(roll, contract.lean_dead_zone),
    )


def by_rates(contract: Contract) -> Contract:
    """Return the contract of a network of sticks that is flown by thrust and body rates."""
    return contract if contract.action == "rates" else replace(contract, action="rates", modes=())


def rates_contract(contract: Contract) -> Contract:
    """Return the contract of a network that learns from flights by rates."""
    return replace(
        by_rates(contract),
        full_lean_deg=RATES_FULL_LEAN_DEG,
        full_yaw_rate_degps=RATES_FULL_YAW_RATE_DEGPS,
        full_climb_mps=RATES_FULL_CLIMB_MPS,
        full_descent_mps=RATES_FULL_CLIMB_MPS,
        lean_dead_zone=0.0,
        yaw_dead_zone=0.0,
        throttle_dead_zone=0.0,
    )


def flown_by_rates(runner: PolicyRunner) -> PolicyRunner:
    """Wrap a runner whose chunks are sticks, so that it flies by thrust and body rates.

    Its network gets a history of centred sticks, because the sent actions are rates.
    """
    loop = StickLoop(by_rates(runner.contract))
    gain, newest = ThrustGain(loop.contract.hover_thrust), loop.contract.history_len - 1
    centred = np.zeros((1, *runner.contract.history_shape), np.float32)

    def act(encoded: FloatArray, state: FloatArray, history: FloatArray) -> FloatArray:
        gain.update(history[0, newest, 0].item(), state[0])
        return loop.to_rates(runner.act(encoded, state, centred), state, gain.value)

    def reset() -> None:
        gain.reset()
        runner.reset()

    return replace(runner, contract=loop.contract, act=act, reset=reset)


class ThrustGain:
    """Thrust that this vehicle needs for a force, over the thrust that it needed in training.

    Measured from the sent thrust and the specific force along it, for weight and battery. Drag is
    left to the network, whose training had it: it counts as proportional to the velocity, with the
    factor by which the vehicle brakes across the thrust.
    """

    def __init__(self, hover_thrust: float) -> None:
        self._hover_thrust = hover_thrust
        self.reset()

    def reset(self) -> None:
        """Start from the vehicle of training."""
        self._thrust, self._up_mps2 = self._hover_thrust, GRAVITY_MPS2
        self._braking_wpkg = self._across_m2ps2 = 0.0
        self._solves, self._is_flying = SOLVES[0], False

    def update(self, thrust: float, state: FloatArray) -> None:
        """Add the newest sent thrust in [0, 1], and a state [state_dim]."""
        numbers: list[float] = state.tolist()
        w, i, j, k = numbers[QUATERNION]
        north, east, down = numbers[VELOCITY]
        vx, vy, vz = rotate(conjugate((w, i, j, k)), (north, east, down))
        fx, fy, fz = numbers[SPECIFIC_FORCE]
        self._is_flying |= math.hypot(vx, vy, vz) > LEAST_SPEED_MPS
        if not self._is_flying:
            return
        share = 1.0 / self._solves
        self._solves = min(self._solves + 1, SOLVES[1])
        self._braking_wpkg -= share * (fx * vx + fy * vy + self._braking_wpkg)
        self._across_m2ps2 += share * (vx * vx + vy * vy - self._across_m2ps2)
        drag_per_s = max(self._braking_wpkg / max(self._across_m2ps2, 1.0), 0.0)
        self._thrust += share * (thrust - self._thrust)
        self._up_mps2 += share * (-fz - drag_per_s * vz - self._up_mps2)

    @property
    def value(self) -> float:
        """Factor on thrusts."""
        expected_mps2 = self._thrust / self._hover_thrust * GRAVITY_MPS2
        least, most = THRUST_GAINS
        return min(max(expected_mps2 / max(self._up_mps2, 1.0), least), most)


@dataclass(frozen=True, slots=True)
class StickLoop:
    """Conversion of sticks to the thrust and body rates that fly them, and back.

    Sticks are throttle, yaw, pitch, roll in [-1, 1], full stick by ``contract``; rates are thrust
    in [0, 1] and roll, pitch, yaw rate in rad/s about FRD axes.
    """

    contract: Contract
    tilt_gain_per_s: float = TILT_GAIN_PER_S

    def __post_init__(self) -> None:
        if self.contract.state_frame != "ned_frd":
            raise ContractError(
                "a network flies by rates with its state in ned_frd, not in "
                f"{self.contract.state_frame}: train it on flights of mavbridge demonstrate"
            )

    def to_rates(
        self, sticks: FloatArray, state: FloatArray, thrust_gain: float = 1.0
    ) -> FloatArray:
        """Convert sticks [1, horizon, 4] at a state [1, state_dim] to rates [1, horizon, 4].

        Each action assumes the attitude and climb that the actions before it bring about.
        """
        rates = np.empty_like(sticks)
        numbers: list[float] = state[0].tolist()
        w, x, y, z = numbers[QUATERNION]
        p, q, r = numbers[RATE]
        attitude = turned((w, x, y, z), (p, q, r), LAG_S)
        climb_mps = -numbers[VELOCITY][2]
        dt_s, hover = self.contract.chunk_dt_s, thrust_gain * self.contract.hover_thrust
        for step, positions in enumerate(sticks[0].tolist()):
            wanted = motion_of_sticks(self.contract, *positions)
            up_mps2, cos_tilt, rate = self.demand(wanted, attitude, climb_mps)
            rates[0, step] = (min(hover * up_mps2 / (GRAVITY_MPS2 * cos_tilt), 1.0), *rate)
            attitude = turned(attitude, rate, dt_s)
            climb_mps += (up_mps2 - GRAVITY_MPS2) * dt_s
        return rates

    def demand(
        self, wanted: StickMotion, attitude: Quaternion, climb_mps: float
    ) -> tuple[float, float, Vector]:
        """Return what brings a vehicle from an attitude and climb to a motion.

        Vertical specific force [m/s^2], the cosine of the tilt that the thrust is divided by, and
        body rates [rad/s].
        """
        body_from_ned: Quaternion = conjugate(attitude)
        down_body: Vector = rotate(body_from_ned, (0.0, 0.0, 1.0))
        up_mps2 = GRAVITY_MPS2 + CLIMB_GAIN_PER_S * (wanted.climb_mps - climb_mps)
        up_mps2 = min(max(up_mps2, UP_FORCE_MPS2[0]), UP_FORCE_MPS2[1])
        axis_body = rotate(body_from_ned, self._thrust_axis_ned(wanted, attitude))
        tilt_p, tilt_q = _tilt_rates(axis_body, self.tilt_gain_per_s)
        yaw_rate = wanted.yaw_rate_radps
        rate = (
            tilt_p + yaw_rate * down_body[0],
            tilt_q + yaw_rate * down_body[1],
            yaw_rate * down_body[2],
        )
        return up_mps2, max(down_body[2], MIN_COS_TILT), rate

    def thrust_gains(self, sent: FloatArray, state: FloatArray) -> FloatArray:
        """Return the factor on thrusts at each of N decisions of a flight, float32 [N].

        Args:
            sent: thrust sent at each decision [N], which the next one measures with; NaN: refused,
                so that the vehicle flies on by the one before.
            state: state at each decision [N, state_dim]; NaN where none is known.
        """
        flown = self.contract.hover_thrust
        gain, values = ThrustGain(flown), []
        for thrust, at in zip(sent.tolist(), state, strict=True):
            if np.isfinite(at).all():
                gain.update(flown, at)
            values.append(gain.value)
            flown = flown if math.isnan(thrust) else thrust
        return np.array(values, np.float32)

    def to_sticks(
        self, rates: FloatArray, state: FloatArray, thrust_gain: FloatArray | float = 1.0
    ) -> FloatArray:
        """Convert rates [N, 4] at states [N, state_dim] to the sticks [N, 4] behind them.

        ``thrust_gain`` is the factor on their thrusts [N]. Motion beyond full stick is clipped.
        """
        contract = self.contract
        attitude = np.stack(
            turned(tuple(state[:, QUATERNION].T), tuple(state[:, RATE].T), LAG_S), axis=-1
        ).astype(np.float64)
        down_body = rotate(conjugate(attitude), np.tile([0.0, 0.0, 1.0], (len(rates), 1)))
        cos_tilt = np.maximum(down_body[:, 2], MIN_COS_TILT)
        hover_thrust = thrust_gain * contract.hover_thrust
        up_mps2 = rates[:, 0] / hover_thrust * GRAVITY_MPS2 * cos_tilt
        climb_mps = -state[:, VELOCITY.stop - 1] + (up_mps2 - GRAVITY_MPS2) / CLIMB_GAIN_PER_S
        yaw_rate = rates[:, 3] / cos_tilt
        tilt_p = rates[:, 1] - yaw_rate * down_body[:, 0]
        tilt_q = rates[:, 2] - yaw_rate * down_body[:, 1]
        # Inverse of _tilt_rates: the turn of the thrust axis that leads to these rates.
        angle = np.hypot(tilt_p, tilt_q) / self.tilt_gain_per_s
        share = np.sinc(angle / np.pi) / self.tilt_gain_per_s
        wanted_body = np.stack([-share * tilt_q, share * tilt_p, -np.cos(angle)], axis=-1)
        north, east, down = rotate(attitude, wanted_body).T
        forward, _, _ = matrix_columns(*attitude.T)
        heading = np.arctan2(forward[1], forward[0])
        cosine, sine = np.cos(heading), np.sin(heading)
        ahead, right = cosine * north + sine * east, cosine * east - sine * north
        lean = np.arctan2(np.hypot(ahead, right), -down) / math.radians(contract.full_lean_deg)
        per_length = lean / np.maximum(np.hypot(ahead, right), 1e-9)
        full_climb = np.where(climb_mps > 0, contract.full_climb_mps, contract.full_descent_mps)
        deflections = (
            _deflection(climb_mps / full_climb, contract.throttle_dead_zone),
            _deflection(
                yaw_rate / math.radians(contract.full_yaw_rate_degps), contract.yaw_dead_zone
            ),
            _deflection(per_length * ahead, contract.lean_dead_zone),
            _deflection(per_length * right, contract.lean_dead_zone),
        )
        return np.clip(np.stack(deflections, axis=-1), -1.0, 1.0).astype(np.float32)

    def _thrust_axis_ned(self, wanted: StickMotion, attitude: Quaternion) -> Vector:
        """Return the unit vector along the thrust of this lean, for the heading of the attitude."""
        length_rad = math.hypot(wanted.forward_rad, wanted.right_rad)
        lean_rad = min(length_rad, math.radians(self.contract.full_lean_deg))
        share = math.sin(lean_rad) / max(length_rad, 1e-9)
        ahead, right = wanted.forward_rad, wanted.right_rad
        cosine, sine = level_heading(attitude)
        return (
            share * (cosine * ahead - sine * right),
            share * (sine * ahead + cosine * right),
            -math.cos(lean_rad),
        )


def _tilt_rates(wanted_body: Vector, gain_per_s: float) -> tuple[float, float]:
    """Return roll and pitch rate that turn the thrust, along -z, the short way to a unit vector.

    The tilt has its own loop, independent of the heading: the direction of thrust matters more
    (Brescianini and D'Andrea, "Tilt-Prioritized Quadrocopter Attitude Control", 2018).
    """
    x, y, z = wanted_body
    sine = math.hypot(x, y)
    rate = min(gain_per_s * math.atan2(sine, -z), MAX_TILT_RATE_RADPS)
    share = rate / sine if sine > 1e-6 else gain_per_s
    return share * y, -share * x


def turned(attitude: Quaternion, rate: Vector, dt_s: float) -> Quaternion:
    """Return the attitude after a turn at constant body rates; floats, or arrays of them."""
    half = dt_s / 2
    turn = (1.0, half * rate[0], half * rate[1], half * rate[2])
    w, x, y, z = multiply(attitude, turn)
    length = (w * w + x * x + y * y + z * z) ** 0.5
    return (w / length, x / length, y / length, z / length)


def _beyond(stick: float, dead_zone: float) -> float:
    """Return the share of full motion that a stick demands, with its sign."""
    beyond = max(abs(stick) - dead_zone, 0.0) / (1.0 - dead_zone)
    return math.copysign(min(beyond, 1.0), stick)


def _deflection(share: Array, dead_zone: float) -> Array:
    """Return the stick for a share of full motion: inverts ``_beyond``; 0 gives the centre."""
    deflection: Array = np.sign(share) * (dead_zone + (1.0 - dead_zone) * np.abs(share))
    return deflection
