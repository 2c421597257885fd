"""The grabber with scripted sources: the test hands out each frame, so nothing is raced."""

import queue
import threading

import numpy as np
import pytest

from helpers.fakes import START_NS
from mavbridge.camera.grabber import REOPENED_NS, STALL_NS, Grabber, Image
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.errors import CameraError

WAIT_NS = 10 * NS_PER_S
"""Deadline of waits that succeed at once unless something is broken."""
UNPLUGGED = CameraError("unplugged")


class ScriptedSource:
    """Delivers what the test puts in; `idle` is set whenever the thread has come back for more."""

    def __init__(self, *script):
        self.script = queue.Queue()
        self.idle = threading.Event()
        self.is_closed = False
        for item in script:
            self.script.put(item)

    def put(self, *stamps_ns):
        """Returns when all frames have been taken and dealt with."""
        for stamp_ns in stamps_ns:
            self.idle.clear()
            self.script.put(stamp_ns)
            assert self.idle.wait(10)

    def next_image(self):
        self.idle.set()
        item = self.script.get(timeout=10)
        if isinstance(item, Exception):
            raise item
        return Image(arrived_ns=item, rgb=np.full((2, 2, 3), item % 256, np.uint8))

    def close(self):
        self.is_closed = True
        self.idle.set()


@pytest.fixture
def source():
    return ScriptedSource()


@pytest.fixture
def grab(clock):
    """Make a grabber that opens these sources in turn; an exception fails its attempt.

    One that has ``flown`` has delivered a first frame.
    """
    made = []

    def make(*sources, delays_s=(0.0,), flown=True):
        pending = [*sources]

        def open_source():
            item = pending.pop(0) if pending else CameraError("no more sources")
            if isinstance(item, Exception):
                raise item
            return item

        grabber = Grabber(open_source, clock=clock, reopen_delays_s=delays_s)
        made.append((grabber, sources))
        if flown:
            sources[0].put(START_NS)
            assert grabber.read(WAIT_NS).frame_id == 1
        return grabber

    yield make
    for grabber, sources in made:
        for source in sources:
            if isinstance(source, ScriptedSource):
                source.script.put(CameraError("end of test"))
        grabber.close()
        grabber.close()
    assert "mavbridge-camera" not in [thread.name for thread in threading.enumerate()]


def test_the_newest_frame_wins_and_the_others_are_counted(source, clock, grab):
    refusals = [CameraError(f"no such device, attempt {k}") for k in range(5)]
    grabber = grab(*refusals, source, flown=False)  # before the first frame, all are tried
    clock.advance_ns(3600 * NS_PER_S)
    source.put(START_NS + 1, START_NS + 2, START_NS + 3)
    frame = grabber.read(WAIT_NS)
    assert (frame.frame_id, frame.captured_ns) == (3, START_NS + 3)
    assert not frame.rgb.flags.writeable
    assert grabber.read(0) is None
    source.put(START_NS + 4)
    assert grabber.read(WAIT_NS).frame_id == 4
    assert grabber.dropped_frames == 2


@pytest.mark.parametrize(("is_reopened", "limit_ns"), [(False, STALL_NS), (True, REOPENED_NS)])
def test_a_source_that_falls_silent_is_dead(source, clock, grab, is_reopened, limit_ns):
    second = ScriptedSource()
    grabber = grab(source, second)
    if is_reopened:
        source.script.put(UNPLUGGED)
        assert second.idle.wait(10)
    clock.advance_ns(limit_ns)
    assert grabber.read(0) is None
    clock.advance_ns(1)
    with pytest.raises(CameraError, match="stopped delivering"):
        grabber.read(0)


@pytest.mark.parametrize("flown", [False, True])
def test_any_other_exception_of_a_source_reaches_read_by_name(source, grab, flown):
    grabber, cause = grab(source, flown=flown), ValueError("cannot reshape 614400 bytes")
    source.script.put(cause)
    for _ in range(2):
        with pytest.raises(CameraError, match=r"ValueError\('cannot reshape 614400") as caught:
            grabber.read(WAIT_NS)
        assert caught.value.__cause__ is cause
    assert source.is_closed


def test_a_lost_source_is_closed_and_opened_again_and_a_frame_gives_all_attempts_back(source, grab):
    others = [ScriptedSource() for _ in range(3)]
    grabber = grab(source, *others)
    for before, after, frame_id in zip([source, *others], others, (2, 3, 4), strict=False):
        before.script.put(UNPLUGGED)
        after.put(START_NS + frame_id)
        assert before.is_closed
        assert grabber.read(WAIT_NS).frame_id == frame_id


def test_why_a_camera_is_opened_again_is_told_once(source, grab, caplog):
    other = ScriptedSource()
    grabber = grab(source, CameraError("still gone"), other, delays_s=(0.0, 0.0))
    source.script.put(UNPLUGGED)
    other.put(START_NS + 2)
    grabber.close()
    assert caplog.messages == ["unplugged; the camera is opened again"]


@pytest.mark.parametrize("attempt", [lambda error: error, ScriptedSource])
def test_when_all_attempts_fail_it_is_dead_with_the_last_reason(source, grab, attempt):
    """Sources that open but deliver nothing use up the attempts."""
    attempts = [attempt(CameraError("gone")), attempt(CameraError("still gone"))]
    grabber = grab(source, *attempts, delays_s=(0.0, 0.0))
    source.script.put(UNPLUGGED)
    with pytest.raises(CameraError, match="still gone; 2 attempts to reopen it have failed"):
        grabber.read(WAIT_NS)
