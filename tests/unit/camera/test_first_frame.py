"""The wait for a camera's first frame, on a clock that only the camera moves."""

import numpy as np
import pytest

from helpers.fakes import START_NS, FakeClock
from mavbridge.camera.grabber import wait_for_first_frame
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.errors import CameraError
from mavbridge.core.records import Frame


class LateCamera:
    """Delivers once, after some seconds; says what it is told to about the wait."""

    def __init__(self, clock, *, after_s, error=None, reasons=()):
        self._clock = clock
        self._due_ns = START_NS + round(after_s * NS_PER_S)
        self._error = error
        self._reasons = dict(reasons)
        self.reads = 0
        self.dropped_frames = 0

    @property
    def waiting_reason(self):
        waited_s = (self._clock.now_ns() - START_NS) // NS_PER_S
        return self._reasons.get(waited_s, "it is being opened")

    def read(self, timeout_ns):
        self.reads += 1
        assert self.reads < 1000
        until_ns = self._clock.now_ns() + timeout_ns
        self._clock.sleep_until_ns(min(self._due_ns, until_ns))
        if self._due_ns > until_ns:
            return None
        if self._error is not None:
            raise self._error
        return Frame(frame_id=1, captured_ns=self._due_ns, rgb=np.zeros((1, 1, 3), np.uint8))

    def close(self):
        pass


def wait(camera, clock, timeout_s=10.0):
    lines = []
    wait_for_first_frame(camera, clock=clock, timeout_s=timeout_s, report=lines.append)
    return lines


def test_every_second_of_the_wait_is_a_line_and_a_new_reason_is_told_once():
    clock = FakeClock()
    reasons = {2: "no such device", 3: "no such device"}
    assert wait(LateCamera(clock, after_s=4.5, reasons=reasons), clock) == [
        "waiting for the camera: 9 s left (it is being opened)",
        "waiting for the camera: 8 s left (no such device)",
        "waiting for the camera: 7 s left",
        "waiting for the camera: 6 s left (it is being opened)",
    ]


@pytest.mark.parametrize(
    ("timeout_s", "left_s"), [(10.0, list(range(9, 0, -1))), (2.5, [2, 1]), (0.4, [])]
)
def test_a_camera_that_never_delivers_is_given_up_at_the_limit(timeout_s, left_s):
    clock = FakeClock()
    lines = []
    with pytest.raises(
        CameraError, match=f"no frame within {timeout_s:g} s .*: it is being opened"
    ):
        wait_for_first_frame(
            LateCamera(clock, after_s=60), clock=clock, timeout_s=timeout_s, report=lines.append
        )
    assert clock.now_ns() == START_NS + round(timeout_s * NS_PER_S)
    told = [line.removeprefix("waiting for the camera: ").split()[0] for line in lines]
    assert told == [str(seconds) for seconds in left_s]


def test_what_waiting_cannot_mend_ends_the_wait():
    clock = FakeClock()
    camera = LateCamera(clock, after_s=2.0, error=CameraError("wrong magic"))
    with pytest.raises(CameraError, match="wrong magic"):
        wait(camera, clock)
    assert clock.now_ns() == START_NS + 2 * NS_PER_S
