"""Overrides, the override switch, receiver options, and sticks from PWM."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sitl.ardupilot import sticks as pilot_sticks
from sitl.ardupilot.params import ArduPilotParams
from sitl.ardupilot.sticks import RcEngine, Sticks, read_sticks
from sitl.clock import NS_PER_MS, NS_PER_S
from sitl.vehicle.config import IDLE_RECEIVER_US

KEEP = 65535


def engine(*, receiver=True, **params):
    store = ArduPilotParams()
    for name, value in params.items():
        assert store.set(name, value)
    return RcEngine(store, IDLE_RECEIVER_US if receiver else None), store


def run(rc, start_ms, end_ms):
    for ms in range(start_ms, end_ms):
        rc.update(ms * NS_PER_MS)


def test_ignore_overrides_option_works_live():
    rc, params = engine()
    rc.override([1700] + [KEEP] * 7, 0)
    run(rc, 0, 50)
    assert rc.channels_us[0] == 1700

    params.set("RC_OPTIONS", 2.0)
    run(rc, 50, 100)

    assert rc.channels_us[0] == 1500


def test_ignore_receiver_option_keeps_only_overrides():
    rc, _ = engine(RC_OPTIONS=1.0)
    assert not rc.update(0)
    rc.override([1600] + [KEEP] * 7, 0)

    assert rc.update(0)
    assert rc.channels_us[:2] == [1600, 0]


def test_expiry_is_per_channel():
    rc, _ = engine()
    rc.override([1700, 1700] + [KEEP] * 6, 0)
    run(rc, 0, 2000)
    rc.override([KEEP, 1700] + [KEEP] * 6, 2 * NS_PER_S)
    run(rc, 2000, 3100)

    assert rc.channels_us[:2] == [1500, 1700]


def test_a_channel_that_was_never_seen_is_zero():
    rc, _ = engine(receiver=False)
    assert not rc.found

    rc.override([1500] * 4 + [KEEP] * 4, 0)
    rc.update(0)

    assert rc.found
    assert rc.channels_us[:6] == [1500] * 4 + [0, 0]


def test_the_override_switch_cuts_overrides_after_its_debounce():
    rc, _ = engine(receiver=False, RC7_OPTION=46.0)
    rc.override([1700, KEEP, KEEP, KEEP, KEEP, KEEP, 1900, KEEP], 0)
    run(rc, 0, 500)
    rc.override([1700, KEEP, KEEP, KEEP, KEEP, KEEP, 1000, KEEP], 500 * NS_PER_MS)
    run(rc, 500, 650)
    rc.override([1650] + [KEEP] * 7, 650 * NS_PER_MS)
    run(rc, 650, 651)
    assert rc.channels_us[0] == 1650

    run(rc, 651, 1000)
    rc.override([1600] + [KEEP] * 7, 1000 * NS_PER_MS)
    run(rc, 1000, 1100)

    assert rc.channels_us[0] == 1650


def test_the_middle_of_the_override_switch_keeps_the_last_state():
    rc, _ = engine(receiver=False, RC7_OPTION=46.0)
    rc.override([1700, KEEP, KEEP, KEEP, KEEP, KEEP, 1500, KEEP], 0)
    run(rc, 0, 1000)

    rc.override([1600] + [KEEP] * 7, NS_PER_S)
    run(rc, 1000, 1010)

    assert rc.channels_us[0] == 1600


def test_manual_control_axes_can_be_absent_and_negative_thrust_is_refused():
    rc, _ = engine()
    rc.manual_control(x=32767, y=1000, z=32767, r=-1000, now_ns=0)
    run(rc, 0, 50)
    assert rc.channels_us[:4] == [2000, 1500, 1000, 1000]

    rc.manual_control(x=0, y=0, z=-1, r=0, now_ns=50 * NS_PER_MS)
    run(rc, 50, 100)

    assert rc.channels_us[:4] == [2000, 1500, 1000, 1000]


def test_the_receiver_moves_at_its_next_frame():
    rc, _ = engine()
    rc.update(0)
    rc.set_receiver([1600, 1500, 1400, 1500])
    run(rc, 1, 20)
    assert rc.channels_us[:4] == list(IDLE_RECEIVER_US[:4])

    run(rc, 20, 21)

    assert rc.channels_us[:8] == [1600, 1500, 1400, 1500, 1500, 1500, 1500, 1500]


def test_a_receiver_may_have_16_channels_and_zeros_leave_theirs():
    rc, _ = engine()
    rc.set_receiver([1500] * 15 + [1900])
    rc.set_receiver([1700] + [0] * 15)
    rc.update(0)

    assert rc.channels_us == [1700] + [1500] * 14 + [1900]
    assert rc.channel_count == 16


def test_a_receiver_may_turn_up_later():
    rc, _ = engine(receiver=False)
    rc.set_receiver([0] * 8)
    assert not rc.update(0)
    assert not rc.found

    rc.set_receiver([1500] * 8)

    assert rc.update(NS_PER_MS)
    assert rc.found
    assert rc.channels_us[:8] == [1500] * 8


def test_the_sticks_hide_behind_overrides_and_come_back():
    rc, params = engine(RCMAP_ROLL=2.0, RCMAP_PITCH=1.0)
    rc.set_receiver([1510, 1520, 1530, 1540])
    rc.override([1600, 1700] + [KEEP] * 6, 0)
    run(rc, 0, 30)
    assert rc.sticks_us() == (1700, 1600, 1530, 1540)

    rc.override([0, 0] + [KEEP] * 6, 30 * NS_PER_MS)
    run(rc, 30, 31)

    assert rc.sticks_us() == (1520, 1510, 1530, 1540)
    assert params["RCMAP_ROLL"] == 2.0


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


def test_a_calibration_without_travel_reads_as_centred():
    sticks, _ = sticks_at(pwm=[1900, 1500, 1700], RC1_MAX=1500.0, RC3_MAX=1000.0)
    assert (sticks.roll, sticks.throttle) == (0.0, 0.0)


@pytest.mark.parametrize(
    ("pwm", "climb_mps"), [(1500, 0.0), (1700, 0.639), (2000, 2.5), (1000, -2.5), (1545, 0.0)]
)
def test_climb_rate_of_the_throttle_stick(pwm, climb_mps):
    sticks, params = sticks_at(pwm=[1500, 1500, pwm])
    assert pilot_sticks.climb_rate_mps(sticks, params) == pytest.approx(climb_mps, abs=0.002)


@pytest.mark.parametrize(("pwm", "thrust"), [(1000, 0.0), (1500, 0.39), (2000, 1.0)])
def test_manual_thrust_passes_through_hover_at_mid_stick(pwm, thrust):
    sticks, params = sticks_at(pwm=[1500, 1500, pwm])
    assert pilot_sticks.manual_thrust(sticks, params) == pytest.approx(thrust, abs=0.002)


@given(st.integers(0, 65534), st.integers(0, 65534))
def test_the_lean_never_exceeds_angle_max(roll_us, pitch_us):
    sticks, params = sticks_at(pwm=[roll_us, pitch_us])

    roll, pitch = pilot_sticks.lean_angles(sticks, params)

    assert math.hypot(roll, pitch) <= math.radians(30.0) + 1e-9


@given(st.floats(-1.0, 1.0))
def test_acro_expo_is_odd_and_keeps_its_ends(value):
    def rate(roll):
        sticks = Sticks(roll=roll, pitch=0.0, yaw=0.0, throttle=0.0, throttle_mid=485.0)
        return pilot_sticks.acro_rates_radps(sticks, ArduPilotParams())[0]

    assert rate(value) == pytest.approx(-rate(-value))
    assert abs(rate(value)) <= rate(1.0) + 1e-9
    assert rate(1.0) == pytest.approx(math.radians(360.0))
