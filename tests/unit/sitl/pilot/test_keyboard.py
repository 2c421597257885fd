import pygame
import pytest

from sitl.clock import NS_PER_MS, NS_PER_S
from sitl.pilot.devices import KeyboardPilot
from sitl.pilot.transmitter import OFF_US, PERIOD_NS


class Clock:
    now = 0

    def now_ns(self):
        return self.now


class Keys:
    def __init__(self):
        self.clock = Clock()
        self.pilot = KeyboardPilot(self.clock)

    def press(self, *keys):
        for key in keys:
            pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=key))

    def release(self, *keys):
        for key in keys:
            pygame.event.post(pygame.event.Event(pygame.KEYUP, key=key))

    def frames(self, seconds=0.0):
        """The last frame of this time."""
        frame = None
        for _ in range(max(1, round(seconds * NS_PER_S / PERIOD_NS))):
            self.clock.now += PERIOD_NS
            frame = self.pilot.latest()
        return frame


@pytest.fixture
def keys(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    made = Keys()
    yield made
    made.pilot.close()


def test_keys_move_the_sticks_as_fast_as_a_thumb(keys):
    assert keys.frames()[:4] == (1500, 1500, 1500, 1500)
    keys.press(pygame.K_UP, pygame.K_RIGHT)
    assert keys.frames()[:4] == (1540, 1460, 1500, 1500)  # 0.08 in 20 ms
    assert keys.frames(1.0)[:4] == (1850, 1150, 1500, 1500)
    keys.press(pygame.K_LSHIFT)
    assert keys.frames(1.0)[:4] == (2000, 1000, 1500, 1500)
    keys.release(pygame.K_UP, pygame.K_RIGHT, pygame.K_LSHIFT)
    keys.press(pygame.K_w, pygame.K_a)
    assert keys.frames(1.0)[:4] == (1500, 1500, 1850, 1150)
    keys.press(pygame.K_s)
    assert keys.frames(1.0)[2] == 1500, "both ways are none"


def test_frames_come_at_the_rate_of_a_receiver(keys):
    assert keys.frames() is not None
    keys.clock.now += 5 * NS_PER_MS
    assert keys.pilot.latest() is None


def test_gestures_and_the_switch(keys):
    keys.press(pygame.K_RETURN)
    assert keys.frames()[:4] == (1500, 1500, 1000, 2000)
    keys.release(pygame.K_RETURN)
    keys.press(pygame.K_BACKSPACE)
    assert keys.frames()[:4] == (1500, 1500, 1000, 1000)
    keys.release(pygame.K_BACKSPACE)
    for key, position_us in (
        (pygame.K_SPACE, 2000),
        (pygame.K_x, 1500),
        (pygame.K_SPACE, 2000),
        (pygame.K_SPACE, 1000),
    ):
        keys.press(key)
        assert keys.frames()[6] == position_us


def test_keys_that_go_to_another_window_are_released(keys):
    keys.press(pygame.K_w)
    assert keys.frames(1.0)[2] == 1850
    pygame.event.post(pygame.event.Event(pygame.WINDOWFOCUSLOST))
    assert keys.frames(1.0)[2] == 1500


def test_a_closed_window_is_a_lost_signal(keys):
    pygame.event.post(pygame.event.Event(pygame.QUIT))
    assert keys.frames() == keys.frames(1.0) == OFF_US
