"""Gamepad as the pilot: sticks, arming, switch, lost signal."""

import pytest

from helpers.fakes import FakeClock
from sitl import UsageError
from sitl.pilot import gamepad
from sitl.pilot.gamepad import GamepadPilot
from sitl.pilot.transmitter import (
    DEFAULT_AXES,
    OFF_US,
    PERIOD_NS,
    pad_sticks,
    parse_axes,
    prepare_vehicle,
)
from sitl.simulated_vehicle import SimulatedVehicle
from sitl.vehicle.config import MID_RECEIVER_US, STEP_NS, VehicleConfig

MIDDLE = (1500, 1500, 1500, 1500)


def test_axes_are_read_and_may_be_reversed():
    axes = parse_axes("roll=0,pitch=-1, throttle=2,yaw=-0")
    assert axes == {"roll": (0, 1.0), "pitch": (1, -1.0), "throttle": (2, 1.0), "yaw": (0, -1.0)}
    sticks = pad_sticks(axes, [1.0, 1.0, -1.0])
    assert (sticks.roll, sticks.pitch, sticks.throttle, sticks.yaw) == (1.0, -1.0, -1.0, -1.0)


def test_the_usual_pad_flies_by_mode_2_and_an_axis_that_it_lacks_is_centred():
    """A pad's vertical axes are negative upwards."""
    axes = parse_axes(DEFAULT_AXES)
    sticks = pad_sticks(axes, [0.5, -1.0, 0.0, 0.7, -1.0, 0.0])
    assert (sticks.throttle, sticks.pitch) == (1.0, 1.0)
    assert 0.4 < sticks.yaw < 0.5
    assert 0.6 < sticks.roll < 0.7
    assert pad_sticks(axes, [0.0, -1.0]).roll == 0.0


@pytest.mark.parametrize("rest", ["", ",roll=3,roll=2", ",lean=3", ",roll=x", ",roll=3,"])
def test_other_axes_are_refused_with_an_example(rest):
    with pytest.raises(UsageError, match=DEFAULT_AXES):
        parse_axes(f"throttle=1,yaw=0,pitch=4{rest}")


class FakePad:
    def __init__(self):
        self.is_there = True
        self.values = [0.0] * 6
        self.down = set()
        self.clock = FakeClock()
        config = VehicleConfig(estimator_ready_s=0.0, receiver_us=MID_RECEIVER_US)
        self.vehicle = SimulatedVehicle(links=0, boot_ns=0, config=config)
        prepare_vehicle(self.vehicle)
        self.vehicle.step(STEP_NS)
        self.pilot = GamepadPilot(self, parse_axes(DEFAULT_AXES), self.vehicle, self.clock)

    def poll(self):
        return self.is_there

    def axes(self):
        return self.values

    def pressed(self):
        return self.down

    def frame(self, *buttons):
        """Channels of the next frame."""
        self.down = set(buttons)
        self.clock.advance_ns(PERIOD_NS)
        return self.pilot.latest()


@pytest.fixture
def pad():
    return FakePad()


def test_sticks_are_channels_as_the_autopilots_have_them(pad):
    pad.values = [1.0, -1.0, 0.0, -1.0, -1.0, 0.0]
    assert pad.frame()[:4] == (1000, 1000, 2000, 2000)  # left, nose down, up, right
    pad.values = [0.0] * 6
    assert pad.frame()[:4] == MIDDLE


def test_without_the_pad_the_receiver_has_no_signal_until_it_is_back(pad):
    assert pad.frame() != OFF_US
    pad.is_there = False
    assert pad.frame() == pad.frame() == OFF_US
    pad.is_there = True
    assert pad.frame()[:4] == MIDDLE


def test_buttons_arm_and_disarm(pad):
    armed = []
    for button in (gamepad.ARM_BUTTON, gamepad.DISARM_BUTTON):
        pad.frame(button)
        armed.append(pad.vehicle.ap.armed)
    assert armed == [True, False]


def test_buttons_move_the_switch_once_each_time(pad):
    record, bad = gamepad.RECORD_BUTTON, gamepad.BAD_BUTTON
    pressed = [(), (record,), (record,), (), (bad,), (record,), (), (record,)]
    positions = [pad.frame(*buttons)[6] for buttons in pressed]
    assert positions == [1000, 2000, 2000, 2000, 1500, 2000, 2000, 1000]
