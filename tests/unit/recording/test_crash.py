import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from helpers.factories import make_state, make_tick
from mavbridge.core.records import Tick, VehicleState
from mavbridge.recording.crash import CrashWatch

TICK_HZ = 100


def state(*, tilt_deg: float = 0.0, speed_mps: float = 0.0) -> VehicleState:
    values = np.zeros(13, np.float32)
    values[0] = speed_mps
    half_rad = math.radians(tilt_deg) / 2
    values[3], values[4] = math.cos(half_rad), math.sin(half_rad)
    return replace(make_state(), values=values)


def watched(*ticks: Tick) -> str | None:
    watch = CrashWatch()
    for tick in ticks:
        watch.see(tick)
    return watch.reason


def ticks(first: int, seconds: float, **changes: Any) -> list[Tick]:
    return [make_tick(first + k, **changes) for k in range(round(seconds * TICK_HZ))]


@pytest.mark.parametrize(
    ("text", "is_crash"),
    [
        ("vehicle: Crash: Disarming: AngErr=70>30, Accel=1.0<3.0", True),
        ("vehicle: Flight termination active", True),
        ("vehicle: Disarming motors", False),
        ("the camera has crashed", False),
    ],
)
def test_the_vehicle_says_that_it_has_crashed(text: str, is_crash: bool) -> None:
    assert (watched(make_tick(texts=(text,))) is not None) is is_crash


@pytest.mark.parametrize(
    ("tilt_deg", "seconds", "is_armed", "is_crash"),
    [
        (95.0, 0.7, True, True),
        (85.0, 2.0, True, False),
        (180.0, 0.4, True, False),  # a flip
        (180.0, 2.0, False, False),  # carried home
    ],
)
def test_a_vehicle_on_its_back_has_crashed_if_it_stays_there(
    tilt_deg: float, seconds: float, is_armed: bool, is_crash: bool
) -> None:
    over = ticks(0, seconds, state=state(tilt_deg=tilt_deg), armed=is_armed)
    reason = watched(*over)
    assert (reason is not None) is is_crash


def test_two_short_flips_are_no_crash() -> None:
    first, second = (ticks(start, 0.4, state=state(tilt_deg=170)) for start in (0, 50))
    assert watched(*first, *ticks(40, 0.1, state=state()), *second) is None


def test_disarmed_in_the_air_is_a_fall_and_on_the_ground_is_none() -> None:
    flying = ticks(0, 1, state=state(speed_mps=0.1))
    falling = ticks(100, 0.5, state=state(speed_mps=3.0), armed=False)
    standing = ticks(100, 1, state=state(speed_mps=0.2), armed=False)
    carried = ticks(300, 0.5, state=state(speed_mps=2.0), armed=False)
    reason = watched(*flying, *falling)
    assert "disarmed in the air" in reason
    assert watched(*flying, *standing, *carried) is None
    assert watched(*falling) is None, "it was never armed"
