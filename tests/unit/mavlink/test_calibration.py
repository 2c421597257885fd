from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from helpers.wire import ARDUPILOT
from mavbridge.core.vehicle import IDLE, NEUTRAL, Sticks
from mavbridge.mavlink.codec.calibration import RcCalibration, RcChannel


@pytest.mark.parametrize(
    ("sticks", "throttle_yaw_pitch_roll_us"),
    [
        (NEUTRAL, (1500, 1500, 1500, 1500)),
        (IDLE, (1100, 1500, 1500, 1500)),
        (Sticks(1, 1, 1, 1), (1900, 1900, 1100, 1900)),  # stick forward is PWM below trim
        (Sticks(-1, -1, -1, -1), (1100, 1100, 1900, 1100)),
        (Sticks(0.5, 0.25, -0.5, -0.25), (1700, 1600, 1700, 1400)),
        (Sticks(0, 0.001, 0, 0), (1500, 1500, 1500, 1500)),  # below the resolution
    ],
)
def test_sticks_to_pwm(sticks: Sticks, throttle_yaw_pitch_roll_us: tuple[int, ...]) -> None:
    assert ARDUPILOT.to_pwm_us(sticks) == throttle_yaw_pitch_roll_us


def test_a_calibration_has_a_channel_for_each_stick_and_by_default_no_failsafe() -> None:
    throttle, yaw, pitch, roll = ARDUPILOT.channels
    ours = RcCalibration(throttle=throttle, yaw=yaw, pitch=pitch, roll=roll)
    assert ours.throttle_floor_us == 0
    assert ours.to_pwm_us(Sticks(0.5, 0.25, -0.5, -0.25)) == (1700, 1600, 1700, 1400)
    with pytest.raises(ValueError, match="two sticks on one channel"):
        replace(ours, yaw=replace(yaw, number=3))


def test_an_uneven_and_reversed_channel() -> None:
    channel = RcChannel(number=1, min_us=1000, trim_us=1520, max_us=2000, is_reversed=True)
    values = [channel.to_us(stick, centre_us=1520) for stick in (-1, -0.5, 0, 0.5, 1)]
    assert values == [2000, 1760, 1520, 1260, 1000]
    back = [channel.to_stick(value, centre_us=1520) for value in values]
    assert back == pytest.approx([-1, -0.5, 0, 0.5, 1])
    assert channel.to_stick(2500, centre_us=1520) == -1


def test_throttle_never_falls_to_the_radio_failsafe() -> None:
    throttle = RcChannel(number=3, min_us=950, trim_us=950, max_us=2000)
    low = replace(ARDUPILOT, throttle=throttle, throttle_floor_us=985)
    assert low.to_pwm_us(IDLE)[0] == 985


unit = st.floats(-1, 1)


@given(st.tuples(unit, unit, unit, unit).map(lambda values: Sticks(*values)))
def test_the_mapping_stays_in_range_and_inverts_to_half_a_microsecond(sticks: Sticks) -> None:
    pwm_us = ARDUPILOT.to_pwm_us(sticks)
    assert all(1100 <= value <= 1900 for value in pwm_us)
    assert ARDUPILOT.to_sticks(pwm_us) == pytest.approx(sticks, abs=0.5 / 400 + 1e-9)


def channel(number: int = 1, **values: int) -> RcChannel:
    return replace(RcChannel(number=number, min_us=1100, trim_us=1500, max_us=1900), **values)


def test_a_calibration_may_go_to_the_ends_of_a_radio() -> None:
    widest = channel(8, min_us=800, trim_us=800, max_us=2200)
    assert (widest.to_us(-1.0, centre_us=800), widest.to_us(1.0, centre_us=800)) == (800, 2200)
    for values, message in (
        ({"max_us": 2201}, "RC1_MAX 2201"),
        ({"min_us": 799}, "RC1_MIN 799 is not in 800..2200.*--set RC1_MIN=800"),
        ({"min_us": 1900}, "not below RC1_MAX 1900"),
        ({"number": 9}, "not one of 1..8"),
    ):
        with pytest.raises(ValueError, match=message):
            channel(**values)


def test_pwm_beyond_the_calibration_is_a_full_stick() -> None:
    assert channel().to_stick(500, centre_us=1500) == -1.0
    assert channel().to_stick(2500, centre_us=1500) == 1.0


def test_a_centre_at_the_end_of_its_range_is_the_centre() -> None:
    for end_us in (1100, 1900):
        assert channel().to_stick(end_us, centre_us=end_us) == 0.0


@pytest.mark.parametrize("stick", ["yaw", "pitch", "roll"])
@pytest.mark.parametrize("trim_us", [1100, 1900, 1099, 1901])
def test_a_trim_is_inside_its_channel(stick: str, trim_us: int) -> None:
    moved = replace(getattr(ARDUPILOT, stick), trim_us=trim_us)
    if 1100 <= trim_us <= 1900:
        assert replace(ARDUPILOT, **{stick: moved}).to_pwm_us(NEUTRAL)
    else:
        name = f"RC{moved.number}_TRIM"
        with pytest.raises(ValueError, match=f"{name} {trim_us} is not .* --set {name}=1500"):
            replace(ARDUPILOT, **{stick: moved})


def test_the_trim_of_the_throttle_means_nothing() -> None:
    moved = replace(ARDUPILOT, throttle=replace(ARDUPILOT.throttle, trim_us=0))
    assert moved.to_pwm_us(NEUTRAL)[0] == 1500


def test_a_failsafe_in_the_middle_of_the_throttle_is_refused() -> None:
    assert replace(ARDUPILOT, throttle_floor_us=1499).to_pwm_us(NEUTRAL)[0] == 1500
    with pytest.raises(ValueError, match="FS_THR_VALUE 1490 makes a failsafe"):
        replace(ARDUPILOT, throttle_floor_us=1500)
