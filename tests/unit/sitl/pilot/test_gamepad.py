import pytest

from sitl.clock import NS_PER_MS, NS_PER_S
from sitl.pilot.devices import (
    ARM_BUTTON,
    BAD_BUTTON,
    DISARM_BUTTON,
    RECORD_BUTTON,
    GamepadPilot,
    PygamePad,
)
from sitl.pilot.transmitter import DEFAULT_AXES, OFF_US, PERIOD_NS, parse_axes


class Clock:
    now = 0

    def now_ns(self):
        return self.now


class FakePad:
    def __init__(self):
        self.is_there = True
        self.values = [0.0] * 6
        self.down = set()

    def poll(self):
        return self.is_there

    def axes(self):
        return self.values

    def buttons(self):
        return [number in self.down for number in range(12)]


@pytest.fixture
def pad():
    return FakePad()


@pytest.fixture
def fly(pad):
    """Channels of the next frame."""
    clock = Clock()
    pilot = GamepadPilot(pad, parse_axes(DEFAULT_AXES), clock)

    def frame(*buttons):
        pad.down = set(buttons)
        clock.now += PERIOD_NS
        return pilot.latest()

    frame.pilot, frame.clock = pilot, clock
    return frame


def test_frames_come_at_the_rate_of_a_receiver(fly):
    assert fly.pilot.latest() is not None
    fly.clock.now += 2 * NS_PER_MS
    assert fly.pilot.latest() is None
    assert fly() is not None


def test_sticks_are_channels_as_the_autopilots_have_them(fly, pad):
    pad.values = [1.0, -1.0, 0.0, -1.0, -1.0, 0.0]
    assert fly()[:4] == (1000, 1000, 2000, 2000)  # left, nose down, up, right
    pad.values = [0.0] * 6
    assert fly()[:4] == (1500, 1500, 1500, 1500)


def test_without_the_pad_the_receiver_has_no_signal_until_it_is_back(fly, pad):
    assert fly() != OFF_US
    pad.is_there = False
    assert fly() == fly() == OFF_US
    pad.is_there = True
    assert fly()[:4] == (1500, 1500, 1500, 1500)


def test_buttons_hold_the_gestures(fly, pad):
    pad.values = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0]
    assert fly(ARM_BUTTON)[:4] == (1500, 1500, 1000, 2000)
    assert fly(DISARM_BUTTON)[:4] == (1500, 1500, 1000, 1000)
    assert fly()[:4] == (2000, 1500, 1500, 1500)


def test_buttons_move_the_switch_once_each_time(fly):
    assert fly()[6] == 1000
    assert fly(RECORD_BUTTON)[6] == fly(RECORD_BUTTON)[6] == fly()[6] == 2000
    assert fly(BAD_BUTTON)[6] == 1500
    assert fly(RECORD_BUTTON)[6] == 2000
    fly()
    assert fly(RECORD_BUTTON)[6] == 1000


def test_the_mode_switch_is_moved_once_after_the_start(fly):
    assert fly()[4] == 1100
    fly.clock.now += NS_PER_S
    assert fly()[4] == 1500


def test_a_computer_without_a_gamepad(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setenv("SDL_JOYSTICK_DISABLE_UDEV", "1")
    pad = PygamePad()
    pilot = GamepadPilot(pad, parse_axes(DEFAULT_AXES), Clock())
    if pad.description is None:
        assert pilot.latest() == OFF_US
        assert (pad.axes(), pad.buttons()) == ((), ())
    else:
        assert "axes" in pad.description
    pilot.close()
