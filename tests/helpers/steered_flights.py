"""Invented flights whose sticks steer the camera's view and the vehicle's motion."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from helpers.factories import about_z
from helpers.flight_folders import spot
from policy.contract import QUATERNION, RATE, SPECIFIC_FORCE, VELOCITY, Contract
from policy.data.flight_data import FlightData

MS = 1_000_000
YAW_RATE_RADPS = 2.0
ACCELERATION_MPS2 = 6.0
FIELD_OF_VIEW_RAD = 2.0


def steered_flight(seed: int, *, seconds: float = 3.0) -> FlightData:
    """Write a flight: yaw turns the view past a far bright spot; pitch accelerates along it.

    Ticks at 100 Hz, frames at 30 Hz. The expert's labels differ from the sent sticks.
    """
    random = np.random.default_rng(seed)
    start_ns, ticks = 10**9 * (seed + 1), round(100 * seconds)
    tick_ns = start_ns + 10 * MS * np.arange(ticks)
    sent = np.zeros((ticks, 4))
    for stick in (1, 2):  # a new position every 200 ms
        sent[:, stick] = np.repeat(random.uniform(-1, 1, ticks // 20 + 1), 20)[:ticks]
    before = np.concatenate([np.zeros((1, 4)), sent[:-1]])
    heading = random.uniform(-0.5, 0.5) + np.cumsum(before[:, 1]) * 0.01 * YAW_RATE_RADPS
    state = np.zeros((ticks, 13), np.float32)
    ahead = np.stack([np.cos(heading), np.sin(heading)], axis=1)
    change_mps = before[:, 2:3] * 0.01 * ACCELERATION_MPS2 * ahead
    state[:, VELOCITY.start : VELOCITY.start + 2] = np.cumsum(change_mps, axis=0)
    state[:, QUATERNION] = about_z(heading)
    state[:, QUATERNION] *= np.where(state[:, 3:4] < 0, -1, 1)
    state[:, RATE.stop - 1] = before[:, 1] * YAW_RATE_RADPS
    state[:, SPECIFIC_FORCE.stop - 1] = -9.8
    captured_ns = start_ns + np.arange(0, round(1000 * seconds), 33) * MS
    seen_at = np.interp(captured_ns, tick_ns, heading)

    def decode() -> Iterator[NDArray[np.uint8]]:
        for angle in seen_at:
            across = -2 * np.arctan2(np.sin(angle), np.cos(angle)) / FIELD_OF_VIEW_RAD
            yield spot(32, float(across)) if abs(across) <= 1 else spot(32, -9.0)

    return FlightData(
        name=f"steered {seed}",
        contract=Contract(),
        tick_ns=tick_ns,
        state=state,
        attitude_ns=tick_ns,
        velocity_ns=tick_ns,
        target_ns=tick_ns,
        target=np.zeros((ticks, 4), np.float32),
        sent_ns=tick_ns,
        sent=sent.astype(np.float32),
        age_ns=np.zeros(0, np.int64),
        captured_ns=captured_ns,
        gate=np.full((len(captured_ns), 7), np.nan, np.float32),
        decode=decode,
    )
