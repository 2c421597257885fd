import pytest

from sitl import UsageError
from sitl.pilot.transmitter import DEAD_ZONE, DEFAULT_AXES, Axis, parse_axes, past_dead_zone


def test_axes_are_read_and_may_be_reversed():
    axes = parse_axes("roll=0,pitch=-1, throttle=2,yaw=-0")
    assert axes.roll == Axis(0, is_reversed=False)
    assert axes.pitch == Axis(1, is_reversed=True)
    assert axes.yaw == Axis(0, is_reversed=True)
    sticks = axes.sticks([1.0, 1.0, -1.0])
    assert (sticks.roll, sticks.pitch, sticks.throttle, sticks.yaw) == (1.0, -1.0, -1.0, -1.0)


def test_the_usual_pad_flies_by_mode_2():
    """A pad's vertical axes are negative upwards."""
    sticks = parse_axes(DEFAULT_AXES).sticks([0.5, -1.0, 0.0, 0.7, -1.0, 0.0])
    assert sticks.throttle == 1.0
    assert sticks.pitch == 1.0
    assert 0.4 < sticks.yaw < 0.5
    assert 0.6 < sticks.roll < 0.7


def test_an_axis_that_the_pad_lacks_is_centred():
    assert parse_axes(DEFAULT_AXES).sticks([0.0, -1.0]).roll == 0.0


@pytest.mark.parametrize(
    "text",
    [
        "",
        "throttle=1,yaw=0,pitch=4",
        "throttle=1,yaw=0,pitch=4,roll=3,roll=2",
        "throttle=1,yaw=0,pitch=4,lean=3",
        "throttle=1,yaw=0,pitch=4,roll=x",
        "throttle=1,yaw=0,pitch=4,roll=3,",
    ],
)
def test_anything_else_is_refused_with_an_example(text):
    with pytest.raises(UsageError, match=DEFAULT_AXES):
        parse_axes(text)


def test_the_dead_zone_is_left_without_a_jump_and_full_stays_full():
    assert past_dead_zone(DEAD_ZONE) == past_dead_zone(-DEAD_ZONE) == 0.0
    assert past_dead_zone(DEAD_ZONE + 0.01) == pytest.approx(0.01 / (1 - DEAD_ZONE))
    assert past_dead_zone(-1.0) == -1.0
    assert past_dead_zone(1.5) == 1.0
