import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from helpers.factories import make_state, make_tick
from mavbridge.core.reasons import Code, because
from mavbridge.core.records import VehicleState
from mavbridge.recording.crash import CrashWatch

TICK_HZ = 100


def state(*, tilt_deg: float = 0.0, speed_mps: float = 0.0) -> VehicleState:
    values = np.zeros(13, np.float32)
    values[0] = speed_mps
    half_rad = math.radians(tilt_deg) / 2
    values[3], values[4] = math.cos(half_rad), math.sin(half_rad)
    return replace(make_state(), values=values)


def watched(*stretches: tuple[float, dict[str, Any]]) -> str | None:
    """The reason after stretches of flight: seconds, and the ticks' fields."""
    watch, index = CrashWatch(), 0
    for seconds, changes in stretches:
        for _ in range(round(seconds * TICK_HZ)):
            watch.see(make_tick(index, **changes))
            index += 1
    return watch.reason


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
    assert (watched((0.01, {"texts": (text,)})) is not None) is is_crash


OVER, FLYING = {"state": state(tilt_deg=180.0)}, {"state": state(speed_mps=0.1), "phase": "flying"}
DISARMED = {"phase": "releasing", "release_reason": because(Code.DISARMED), "armed": False}
FALLING = {"state": state(speed_mps=3.0)} | DISARMED
SAID = {"texts": ("vehicle: Crash: Disarming: AngErr=70>30, Accel=1.0<3.0",)}
TAKEN = {"phase": "released", "release_reason": because(Code.OPERATOR)}
PILOTS = {"phase": "released", "release_reason": because(Code.PILOT_FLIES)}


@pytest.mark.parametrize(
    ("stretches", "told"),
    [
        pytest.param([(0.7, {"state": state(tilt_deg=95.0)})], "lay on its back", id="on its back"),
        pytest.param([(2.0, {"state": state(tilt_deg=85.0)})], None, id="leans"),
        pytest.param([(0.4, OVER), (0.1, FLYING), (0.4, OVER)], None, id="two flips"),
        pytest.param([(2.0, OVER | DISARMED)], None, id="carried home"),
        pytest.param([(1.0, FLYING), (0.5, FALLING)], "disarmed in the air", id="falls"),
        pytest.param(
            [(1.0, FLYING), (2.0, {"state": state(speed_mps=0.2)} | DISARMED), (0.5, FALLING)],
            None,
            id="lands and is carried",
        ),
        pytest.param([(0.5, FALLING), (0.1, SAID | DISARMED)], None, id="never armed"),
        pytest.param(
            [(1.0, FLYING), (0.1, DISARMED), (0.1, SAID | DISARMED)], "said", id="told late"
        ),
        pytest.param(
            [(1.0, FLYING), (1.1, DISARMED | {"state": None}), (0.1, SAID | DISARMED)],
            None,
            id="told at rest",
        ),
        pytest.param([(1.0, FLYING | TAKEN), (0.5, FALLING | TAKEN)], None, id="by a hand"),
        pytest.param(
            [(1.0, FLYING | PILOTS), (0.5, FALLING | PILOTS)], "disarmed in", id="a pilot's flight"
        ),
    ],
)
def test_a_vehicle_that_stays_over_or_is_disarmed_in_the_air_has_crashed(
    stretches: list[tuple[float, dict[str, Any]]], told: str | None
) -> None:
    reason = watched(*stretches)
    assert reason is None if told is None else told in str(reason)
