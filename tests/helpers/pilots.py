"""PolicyRunners for simulated flights: constant sticks, and a pilot that knows the true state."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from mavbridge.simulation.flight import SimulatedFlight
from policy.contract import Contract, FloatArray
from policy.motion.controllers import LEAN_PER_MPS, LEAN_PER_WANTED_MPS, THROTTLE_DEADZONE
from policy.protocol import PolicyRunner

SPEED_MPS = 3.0
CONTRACT = Contract(feature_dim=1, arrays="numpy", image_height=32, image_width=32)


def steady(sticks: Callable[[], tuple[float, float, float, float]]) -> PolicyRunner:
    """Return a runner that calls ``sticks`` at every action and holds the result for the chunk."""

    def act(encoded: FloatArray, state: FloatArray, history: FloatArray) -> FloatArray:
        chunk = np.empty((1, CONTRACT.horizon, 4), np.float32)
        chunk[:] = sticks()
        return chunk

    return PolicyRunner(
        contract=CONTRACT,
        name="test",
        engine="numpy",
        dual_rate=True,
        encode=lambda rgb, camera=0: np.full((1, 1), rgb.mean(), np.float32),
        act=act,
    )


def single_rate(runner: PolicyRunner) -> PolicyRunner:
    return replace(runner, dual_rate=False)


def pursuit(flight: SimulatedFlight) -> PolicyRunner:
    """Return a runner that flies through the gates by the true state."""

    def sticks() -> tuple[float, float, float, float]:
        body = flight.vehicle.ap.truth
        north, east, down = body.position_ned_m
        gates = flight.course.gates
        gate = gates[min(len(flight.vehicle.log.gates_passed), len(gates) - 1)]
        cos, sin = math.cos(gate.yaw_rad), math.sin(gate.yaw_rad)
        gate_n, gate_e, gate_d = gate.center_ned_m
        ahead_m = (north - gate_n) * cos + (east - gate_e) * sin
        lead_m = 4.0 if ahead_m > -4.0 else -2.0  # first before the gate, then through it
        to_n, to_e = gate_n + lead_m * cos - north, gate_e + lead_m * sin - east
        scale = SPEED_MPS / max(math.hypot(to_n, to_e), 1e-3)
        w, x, y, z = body.ned_from_body_wxyz
        heading = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        turn = math.remainder(gate.yaw_rad - heading, math.tau)
        wanted = _to_heading(to_n * scale, to_e * scale, heading)
        measured = _to_heading(body.velocity_ned_mps[0], body.velocity_ned_mps[1], heading)
        forward, right = (
            min(max(LEAN_PER_WANTED_MPS * v + LEAN_PER_MPS * (v - m), -0.6), 0.6)
            for v, m in zip(wanted, measured, strict=True)
        )
        climb = min(max(0.6 * (down - gate_d), -0.5), 0.5)
        throttle = math.copysign(THROTTLE_DEADZONE, climb) + climb if abs(climb) > 0.03 else 0.0
        return throttle, min(max(0.5 * turn, -0.5), 0.5), forward, right

    return steady(sticks)


def _to_heading(north: float, east: float, heading: float) -> tuple[float, float]:
    cos, sin = math.cos(heading), math.sin(heading)
    return cos * north + sin * east, cos * east - sin * north
