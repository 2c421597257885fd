"""The grabber with scripted sources: the test hands out each frame, so nothing is raced."""

import queue
import threading

import numpy as np
import pytest

from helpers.fakes import START_NS, FakeClock
from mavbridge.camera.deadlines import REOPENED_NS, STALL_NS
from mavbridge.camera.grabber import Grabber, Image
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.errors import CameraError

WAIT_NS = 10 * NS_PER_S
"""Deadline of waits that succeed at once unless something is broken."""


class ScriptedSource:
    """Delivers what the test puts in; `idle` is set whenever the thread has come back for more."""

    def __init__(self):
        self._script = queue.Queue()
        self.idle = threading.Event()
        self.closed = threading.Event()

    def put(self, *items):
        """Returns when all items have been taken and dealt with."""
        for item in items:
            self.idle.clear()
            self._script.put(item)
            assert self.idle.wait(10) or self.closed.is_set()

    def fail(self, reason):
        self.crash(CameraError(reason))

    def crash(self, error):
        self._script.put(error)

    def next_image(self):
        self.idle.set()
        item = self._script.get(timeout=10)
        if isinstance(item, Exception):
            raise item
        return Image(captured_ns=item, rgb=np.full((2, 2, 3), item % 256, np.uint8))

    def close(self):
        self.closed.set()
        self.idle.set()


@pytest.fixture
def clock():
    return FakeClock()


@pytest.fixture
def source():
    return ScriptedSource()


def opening(*sources):
    """Opens these one after another; an exception fails its attempt, and there are no more."""
    pending = list(sources)

    def open_source():
        item = pending.pop(0) if pending else CameraError("no more sources")
        if isinstance(item, Exception):
            raise item
        return item

    return open_source


def end(grabber, source):
    source.fail("end of test")
    grabber.close()


def test_a_frame_comes_with_its_stamp_and_cannot_be_written(source, clock):
    grabber = Grabber(opening(source), clock=clock)
    source.put(START_NS)
    frame = grabber.read(WAIT_NS)
    assert (frame.frame_id, frame.captured_ns) == (1, START_NS)
    assert not frame.rgb.flags.writeable
    end(grabber, source)


def test_the_newest_frame_wins_and_the_others_are_counted(source, clock):
    grabber = Grabber(opening(source), clock=clock)
    source.put(START_NS + 1, START_NS + 2, START_NS + 3)
    frame = grabber.read(WAIT_NS)
    assert (frame.frame_id, frame.captured_ns) == (3, START_NS + 3)
    assert grabber.dropped_frames == 2
    assert grabber.read(0) is None
    source.put(START_NS + 4)
    assert grabber.read(WAIT_NS).frame_id == 4
    assert grabber.dropped_frames == 2
    end(grabber, source)


def test_before_the_first_frame_it_is_opened_until_that_works(source, clock):
    refusals = [CameraError(f"no such device, attempt {k}") for k in range(5)]
    grabber = Grabber(opening(*refusals, source), clock=clock, reopen_delays_s=(0.0,))
    clock.advance_ns(3600 * NS_PER_S)
    source.put(START_NS)
    assert grabber.read(WAIT_NS).frame_id == 1
    end(grabber, source)


def test_while_nothing_was_delivered_it_says_why(source, clock):
    opened = threading.Event()

    def refuse_once():
        if not opened.is_set():
            opened.set()
            raise CameraError("no such device")
        return source

    grabber = Grabber(refuse_once, clock=clock, reopen_delays_s=(0.05,))
    assert opened.wait(10)
    assert grabber.waiting_reason in {"it is being opened", "no such device"}
    assert source.idle.wait(10)
    assert grabber.waiting_reason == "it is open, and has delivered no frame yet"
    clock.advance_ns(3600 * NS_PER_S)
    assert grabber.read(0) is None
    end(grabber, source)


def test_a_source_that_falls_silent_is_dead(source, clock):
    grabber = Grabber(opening(source), clock=clock)
    source.put(START_NS)
    grabber.read(WAIT_NS)
    clock.advance_ns(STALL_NS)
    assert grabber.read(0) is None
    clock.advance_ns(1)
    with pytest.raises(CameraError, match="stopped delivering"):
        grabber.read(0)
    end(grabber, source)


def test_a_source_that_is_silent_after_it_was_reopened_is_dead(source, clock):
    second = ScriptedSource()
    grabber = Grabber(opening(source, second), clock=clock, reopen_delays_s=(0.0,))
    source.put(START_NS)
    grabber.read(WAIT_NS)
    source.fail("unplugged")
    assert second.idle.wait(10)
    clock.advance_ns(REOPENED_NS)
    assert grabber.read(0) is None
    clock.advance_ns(1)
    with pytest.raises(CameraError, match="stopped delivering"):
        grabber.read(0)
    end(grabber, second)


@pytest.mark.parametrize("frames", [0, 2])
def test_any_other_exception_of_a_source_reaches_read_by_name(source, clock, frames):
    grabber = Grabber(opening(source), clock=clock)
    for _ in range(frames):
        source.put(START_NS)
        grabber.read(WAIT_NS)
    cause = ValueError("cannot reshape 614400 bytes")
    source.crash(cause)
    for _ in range(2):
        with pytest.raises(CameraError, match=r"ValueError\('cannot reshape 614400") as caught:
            grabber.read(WAIT_NS)
        assert caught.value.__cause__ is cause
    grabber.close()
    assert source.closed.is_set()
    assert "mavbridge-camera" not in [thread.name for thread in threading.enumerate()]


def test_an_exception_of_the_opener_reaches_read_by_name(clock):
    grabber = Grabber(opening(OSError("out of file descriptors")), clock=clock)
    with pytest.raises(CameraError, match=r"OSError.*out of file descriptors"):
        grabber.read(WAIT_NS)
    grabber.close()


def test_a_frame_that_waits_is_given_even_if_nothing_came_since(source, clock):
    grabber = Grabber(opening(source), clock=clock)
    source.put(START_NS)
    clock.advance_ns(STALL_NS + 1)
    assert grabber.read(0) is not None
    end(grabber, source)


def test_a_lost_source_is_opened_again_and_closed_first(source, clock):
    second = ScriptedSource()
    grabber = Grabber(opening(source, second), clock=clock, reopen_delays_s=(0.0,))
    source.put(START_NS)
    grabber.read(WAIT_NS)
    source.fail("unplugged")
    second.put(START_NS + 1)
    assert source.closed.is_set()
    assert grabber.read(WAIT_NS).frame_id == 2
    end(grabber, second)
    assert second.closed.is_set()


def test_when_all_attempts_fail_it_is_dead_with_the_last_reason(source, clock):
    attempts = [CameraError("gone"), CameraError("still gone")]
    grabber = Grabber(opening(source, *attempts), clock=clock, reopen_delays_s=(0.0, 0.0))
    source.put(START_NS)
    grabber.read(WAIT_NS)
    source.fail("unplugged")
    with pytest.raises(CameraError, match="still gone; 2 attempts to reopen it have failed"):
        grabber.read(WAIT_NS)
    grabber.close()


def test_sources_that_open_but_deliver_nothing_use_up_the_attempts(source, clock):
    others = [ScriptedSource(), ScriptedSource()]
    for other in others:
        other.fail("no picture")
    grabber = Grabber(opening(source, *others), clock=clock, reopen_delays_s=(0.0, 0.0))
    source.put(START_NS)
    grabber.read(WAIT_NS)
    source.fail("unplugged")
    with pytest.raises(CameraError, match="no picture"):
        grabber.read(WAIT_NS)
    grabber.close()
    assert all(other.closed.is_set() for other in others)


def test_a_frame_gives_all_attempts_back(source, clock):
    others = [ScriptedSource() for _ in range(3)]
    grabber = Grabber(opening(source, *others), clock=clock, reopen_delays_s=(0.0,))
    source.fail("unplugged")
    for other in others[:-1]:
        other.put(START_NS)
        other.fail("unplugged again")
    others[-1].put(START_NS)
    assert grabber.read(WAIT_NS) is not None
    end(grabber, others[-1])


def test_while_it_is_being_opened_again_there_is_no_frame_and_no_error(source, clock):
    grabber = Grabber(opening(source), clock=clock, reopen_delays_s=(3600.0,))
    source.put(START_NS)
    grabber.read(WAIT_NS)
    source.fail("unplugged")
    assert source.closed.wait(10)
    clock.advance_ns(STALL_NS + REOPENED_NS)
    assert grabber.read(0) is None
    grabber.close()


def test_close_ends_the_thread_and_may_be_called_twice(source, clock):
    grabber = Grabber(opening(source), clock=clock)
    names = [thread.name for thread in threading.enumerate()]
    assert "mavbridge-camera" in names
    end(grabber, source)
    grabber.close()
    assert "mavbridge-camera" not in [thread.name for thread in threading.enumerate()]
    assert source.closed.is_set()
