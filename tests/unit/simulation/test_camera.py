"""The simulated camera: frames arrive after their end, and turn with the vehicle, mount and all."""

from itertools import repeat
from typing import Any

import numpy as np
import pytest

from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.records import ImageArray
from mavbridge.simulation.clock import SteppedClock
from mavbridge.simulation.world import MOUNTS, SimulatedCamera
from sitl.simulated_vehicle import Pose
from sitl.vehicle.dynamics import BodyState
from sitl.vehicle.rotation import IDENTITY, Quat, Vec3

BODY = BodyState(
    position_ned_m=(0.0, 0.0, -2.0),
    ned_from_body_wxyz=IDENTITY,
    velocity_ned_mps=(0.0, 0.0, 0.0),
    rate_body_radps=(1.0, 2.0, 3.0),
    specific_force_body_mps2=(0.0, 0.0, -9.8),
    touching=False,
)


class Renderer:
    def __init__(self) -> None:
        self.rate_radps: Vec3 | None = None

    def render(self, _position: Vec3, _attitude: Quat, rate_radps: Vec3) -> ImageArray:
        self.rate_radps = rate_radps
        return np.zeros((16, 16, 3), np.uint8)


def camera(**settings: Any) -> tuple[SteppedClock, SimulatedCamera, Renderer]:
    clock, renderer = SteppedClock(), Renderer()
    made = SimulatedCamera(
        clock,
        lambda: Pose(stamp_ns=clock.now_ns(), body=BODY),
        renderer.render,
        period_ns=100 * NS_PER_MS,
        phase_ns=0,
        delays_ns=repeat(3 * NS_PER_MS),
        **settings,
    )
    return clock, made, renderer


@pytest.mark.parametrize(("to_end_ms", "arrival_ms"), [(0, 3), (15, 18)])
def test_no_frame_arrives_before_its_last_row_was_exposed(to_end_ms: int, arrival_ms: int) -> None:
    clock, made, _ = camera(to_end_ns=to_end_ms * NS_PER_MS)
    begun_ns = clock.now_ns()
    clock.sleep_until_ns(begun_ns + arrival_ms * NS_PER_MS - 1)
    assert made.read(0) is None
    clock.sleep_until_ns(begun_ns + arrival_ms * NS_PER_MS)
    assert made.read(0).captured_ns == begun_ns


@pytest.mark.parametrize(
    ("mount", "rate_radps"),
    [
        ("front", (1.0, 2.0, 3.0)),
        ("right", (2.0, -1.0, 3.0)),  # what was to the right is ahead
        ("down", (3.0, 2.0, -1.0)),  # the vehicle's yaw is a roll about the optical axis
    ],
)
def test_a_mounted_camera_turns_about_its_own_axes(mount: str, rate_radps: Vec3) -> None:
    clock, made, renderer = camera(mount=MOUNTS[mount])
    clock.sleep_until_ns(clock.now_ns() + 3 * NS_PER_MS)
    assert made.read(0) is not None
    assert renderer.rate_radps == pytest.approx(rate_radps)
