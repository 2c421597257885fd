"""Sticks to PWM and back, and radio calibrations that cannot map them."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from helpers.wire import ARDUPILOT
from mavbridge.core.vehicle import IDLE, NEUTRAL, Sticks
from mavbridge.mavlink.codec.calibration import RcCalibration, RcChannel


def test_a_stick_forward_is_pwm_below_trim_and_the_others_are_above_it() -> None:
    assert replace(ARDUPILOT).to_pwm_us(Sticks(0.5, 0.25, 0.5, 0.25)) == (1700, 1600, 1300, 1600)


def test_the_sticks_are_told_by_the_numbers_of_their_channels() -> None:
    assert ARDUPILOT.stick_channels_us(range(1001, 1009)) == (1003, 1004, 1002, 1001)


unit = st.floats(-1, 1)


@given(st.tuples(unit, unit, unit, unit).map(lambda values: Sticks(*values)))
def test_the_mapping_stays_in_range_and_inverts_to_half_a_microsecond(sticks: Sticks) -> None:
    pwm_us = ARDUPILOT.to_pwm_us(sticks)
    assert all(1100 <= value <= 1900 for value in pwm_us)
    assert ARDUPILOT.to_sticks(pwm_us) == pytest.approx(sticks, abs=0.5 / 400 + 1e-9)


def changed(stick: str, **values: int) -> RcCalibration:
    channel: RcChannel = getattr(ARDUPILOT, stick)
    return replace(ARDUPILOT, **{stick: replace(channel, **values)})


@pytest.mark.parametrize(
    ("calibration", "yaw", "yaw_us"),
    [
        *((changed("yaw", trim_us=1520, is_reversed=True), *pair)
          for pair in ((-1, 1900), (-0.5, 1710), (0, 1520), (0.5, 1310), (1, 1100))),
        (changed("yaw", min_us=800, trim_us=800, max_us=2200), 1, 2200),
        (changed("yaw", min_us=800, trim_us=800, max_us=2200), 0, 800),
        (changed("yaw", trim_us=1900), 0, 1900),
        (changed("yaw", trim_us=1900), -1, 1100),
    ],
)  # fmt: skip
def test_a_channel_may_be_uneven_reversed_and_as_wide_as_a_radio(
    calibration: RcCalibration, yaw: float, yaw_us: int
) -> None:
    assert replace(calibration).to_pwm_us(Sticks(0, yaw, 0, 0))[1] == yaw_us
    assert calibration.to_sticks((1500, yaw_us, 1500, 1500)).yaw == pytest.approx(yaw)


def test_pwm_beyond_the_calibration_is_a_full_stick() -> None:
    assert ARDUPILOT.to_sticks((500, 2500, 500, 2500)) == (-1, 1, 1, 1)
    channel = RcChannel(number=1, min_us=1100, trim_us=1500, max_us=1900)
    assert (channel.to_us(2, centre_us=1500), channel.to_stick(2500, centre_us=1500)) == (1900, 1)


def test_the_throttle_has_its_centre_between_its_ends_and_stays_above_the_failsafe() -> None:
    assert changed("throttle", trim_us=0).to_pwm_us(NEUTRAL)[0] == 1500
    low = replace(changed("throttle", min_us=950, max_us=2000), throttle_floor_us=985)
    assert low.to_pwm_us(IDLE)[0] == 985
    assert replace(ARDUPILOT, throttle_floor_us=1499).to_pwm_us(NEUTRAL)[0] == 1500
    with pytest.raises(ValueError, match="FS_THR_VALUE 1490 makes a failsafe"):
        replace(ARDUPILOT, throttle_floor_us=1500)


@pytest.mark.parametrize(
    ("stick", "values", "message"),
    [
        ("roll", {"max_us": 2201}, "RC1_MAX 2201"),
        ("roll", {"min_us": 799}, "RC1_MIN 799 is not in 800..2200.*--set RC1_MIN=800"),
        ("roll", {"min_us": 1900}, "not below RC1_MAX 1900"),
        ("yaw", {"number": 3}, "two sticks on one channel"),
        *(
            (stick, {"trim_us": us}, f"RC{n}_TRIM {us} is not .* --set RC{n}_TRIM=1500")
            for stick, n in (("yaw", 4), ("pitch", 2), ("roll", 1))
            for us in (1099, 1901)
        ),
    ],
)
def test_a_calibration_that_cannot_map_sticks_is_refused(
    stick: str, values: dict[str, int], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        changed(stick, **values)
