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


def test_an_uneven_and_reversed_channel() -> None:
    channel = RcChannel(number=1, min_us=1000, trim_us=1520, max_us=2000, is_reversed=True)
    values = [channel.to_us(stick, centre_us=1520) for stick in (-1, -0.5, 0, 0.5, 1)]
    assert values == [2000, 1760, 1520, 1260, 1000]
    back = [channel.to_stick(value, centre_us=1520) for value in values]
    assert back == pytest.approx([-1, -0.5, 0, 0.5, 1])
    assert channel.to_stick(2500, centre_us=1520) == -1


def test_throttle_never_falls_to_the_radio_failsafe() -> None:
    low = RcCalibration(
        throttle=RcChannel(number=3, min_us=950, trim_us=950, max_us=2000),
        yaw=ARDUPILOT.yaw,
        pitch=ARDUPILOT.pitch,
        roll=ARDUPILOT.roll,
        throttle_floor_us=985,
    )
    assert low.to_pwm_us(IDLE)[0] == 985


unit = st.floats(-1, 1)


@given(st.tuples(unit, unit, unit, unit).map(lambda values: Sticks(*values)))
def test_the_mapping_stays_in_range_and_inverts_to_half_a_microsecond(sticks: Sticks) -> None:
    pwm_us = ARDUPILOT.to_pwm_us(sticks)
    assert all(1100 <= value <= 1900 for value in pwm_us)
    assert ARDUPILOT.to_sticks(pwm_us) == pytest.approx(sticks, abs=0.5 / 400 + 1e-9)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"number": 9, "min_us": 1100, "trim_us": 1500, "max_us": 1900}, "not one of 1..8"),
        ({"number": 1, "min_us": 1900, "trim_us": 1500, "max_us": 1100}, "not below RC1_MAX 1100"),
        (
            {"number": 1, "min_us": 0, "trim_us": 1500, "max_us": 1900},
            "RC1_MIN 0 is not in 800..2200.*--set RC1_MIN=800",
        ),
    ],
)
def test_an_unusable_calibration_is_refused(arguments: dict[str, int], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        RcChannel(**arguments)  # type: ignore[arg-type]


def test_a_failsafe_above_the_whole_throttle_is_refused() -> None:
    with pytest.raises(ValueError, match="FS_THR_VALUE"):
        RcCalibration(
            throttle=ARDUPILOT.throttle,
            yaw=ARDUPILOT.yaw,
            pitch=ARDUPILOT.pitch,
            roll=ARDUPILOT.roll,
            throttle_floor_us=1900,
        )


def test_two_sticks_on_one_channel_are_refused() -> None:
    with pytest.raises(ValueError, match="two sticks on one channel"):
        RcCalibration(
            throttle=ARDUPILOT.roll,
            yaw=ARDUPILOT.yaw,
            pitch=ARDUPILOT.pitch,
            roll=ARDUPILOT.roll,
        )
