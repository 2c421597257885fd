"""Overrides, the override switch, receiver options, and sticks from PWM."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sitl.ardupilot import rc as pilot_sticks
from sitl.ardupilot.params import ArduPilotParams
from sitl.ardupilot.rc import RcEngine, read_sticks
from sitl.clock import NS_PER_MS
from sitl.vehicle.config import IDLE_RECEIVER_US
from sitl.vehicle.firmware import Receiver

KEEP = 65535


def engine(**params):
    store = ArduPilotParams()
    for name, value in params.items():
        assert store.set(name, value)
    return RcEngine(store, Receiver(IDLE_RECEIVER_US)), store


def test_a_receiver_may_turn_up_later():
    receiver = Receiver(None)
    rc = RcEngine(ArduPilotParams(), receiver)
    receiver.move([0] * 8)
    assert not rc.update(0)
    assert not rc.found
    receiver.move([1500] * 8)
    assert rc.update(NS_PER_MS)
    assert rc.found
    assert rc.channels_us[:8] == [1500] * 8


def sticks_at(**params_and_pwm):
    pwm = params_and_pwm.pop("pwm")
    rc, params = engine(**params_and_pwm)
    rc.override([*pwm, *[KEEP] * (8 - len(pwm))], 0)
    rc.update(0)
    return read_sticks(rc, params), params


@pytest.mark.parametrize(
    ("pwm", "roll"),
    [
        (1500, 0.0),
        (1520, 0.0),
        (1480, 0.0),
        (1700, 0.375),
        (1300, -0.375),
        (2000, 1.0),
        (2500, 1.0),
        (900, -1.0),
        (40000, 1.0),
    ],
)
def test_centred_sticks_have_a_dead_zone_and_end_stops(pwm, roll):
    sticks, _ = sticks_at(pwm=[pwm])
    assert sticks.roll == pytest.approx(roll)


def test_reversed_channels_and_channel_map():
    sticks, _ = sticks_at(pwm=[1500, 1500, 1000, 1500, 1740], RCMAP_ROLL=5.0, RC5_REVERSED=1.0)
    assert sticks.roll == pytest.approx(-0.48)
    rc, params = engine()
    params.set("RCMAP_ROLL", 5.0)
    assert rc.index_of("ROLL") == 0  # until the next boot


@given(st.integers(0, 65534), st.integers(0, 65534))
def test_the_lean_never_exceeds_angle_max(roll_us, pitch_us):
    sticks, params = sticks_at(pwm=[roll_us, pitch_us])
    roll, pitch = pilot_sticks.lean_angles(sticks, params)
    assert math.hypot(roll, pitch) <= math.radians(30.0) + 1e-9
