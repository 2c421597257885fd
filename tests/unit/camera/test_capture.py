import os
import threading
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pytest

from helpers.camera_senders import SIDE, FakeCapture, RtpSender, repeating
from helpers.fakes import START_NS
from mavbridge.camera import capture
from mavbridge.camera.capture import (
    CaptureSource,
    VideoFileCamera,
    device_mode,
    open_device,
    open_stream,
)
from mavbridge.camera.grabber import ExposureClock
from mavbridge.camera.open import open_camera
from mavbridge.core.clock import NS_PER_MS, NS_PER_S, MonotonicClock
from mavbridge.core.errors import CameraError


@pytest.mark.parametrize(
    ("stamp_ms", "is_our_clock", "latency_ms", "captured_ms"),
    [
        pytest.param(1_000_000.0, False, 0, 1_000_000, id="now"),
        pytest.param(999_000.0, False, 0, 999_000, id="as old as it may be"),
        pytest.param(998_999.0, False, 0, 1_000_000, id="too old"),
        pytest.param(1_000_000.1, False, 0, 1_000_000, id="from the future"),
        pytest.param(-1.0, False, 0, 1_000_000, id="not supported"),
        pytest.param(1.7e12, False, 0, 1_000_000, id="wall clock"),
        pytest.param(997_000.0, True, 0, 997_000, id="from a queue that nobody read"),
        pytest.param(1_000_400.0, True, 0, 1_000_400, id="our clock, ahead"),
        pytest.param(0.0, True, 0, 1_000_000, id="our clock, no stamp"),
        # No stamp makes a frame younger than the latency.
        pytest.param(999_990.0, True, 20, 999_980, id="of the transfer"),
        pytest.param(999_900.0, True, 20, 999_900, id="of the exposure"),
        pytest.param(1_000_400.0, True, 20, 1_000_400, id="ahead"),
        pytest.param(0.0, True, 20, 999_980, id="no stamp"),
        pytest.param(-1.0, False, 20, 999_980, id="not supported, a latency"),
    ],
)
def test_the_drivers_stamp_is_taken_if_it_can_be_one(
    stamp_ms, is_our_clock, latency_ms, captured_ms
):
    stamps = ExposureClock(is_our_clock, latency_ns=latency_ms * NS_PER_MS)
    assert stamps.exposure_ns(round(stamp_ms * NS_PER_MS), START_NS) == captured_ms * NS_PER_MS


def test_a_device_gives_rgb_with_the_drivers_stamp(monkeypatch, clock):
    opened_with, device = [], FakeCapture([START_NS / NS_PER_MS - 7])

    def open_capture(*arguments):
        opened_with.append(arguments)
        return device

    monkeypatch.setattr(cv2, "VideoCapture", open_capture)
    source = open_device(Path("/dev/video7"), image_size=(300, 300), clock=clock)
    assert opened_with == [("/dev/video7", cv2.CAP_V4L2)]
    assert device.settings == {cv2.CAP_PROP_FRAME_WIDTH: 640, cv2.CAP_PROP_FRAME_HEIGHT: 480}
    image = source.next_image()
    assert (image.arrived_ns, image.stamp_ns) == (START_NS, START_NS - 7 * NS_PER_MS)
    assert image.rgb.tolist() == [[[3, 2, 1]]]
    with pytest.raises(CameraError, match="unplugged"):
        source.next_image()
    source.close()


@pytest.mark.parametrize("damaged", [-1.0, -2.0])
def test_damaged_frames_of_a_device_are_passed_over_unless_they_go_on(damaged, clock):
    stamps_ms = [1.0, *[damaged] * 10, 2.0, *[damaged] * 11]
    source = CaptureSource(FakeCapture(stamps_ms), "camera 0", "has ended", clock, True)
    images = [source.next_image() for _ in range(22)]
    stamps_ns = [image.stamp_ns for image in images if image is not None]
    assert stamps_ns == [NS_PER_MS, 2 * NS_PER_MS]
    with pytest.raises(CameraError, match="camera 0: 11 frames in a row are damaged"):
        source.next_image()


@pytest.mark.parametrize(
    ("least", "mode"),
    [
        *[((96, 96), (640, 480)), ((480, 640), (640, 480)), ((360, 641), (1280, 720))],
        *[((481, 96), (1280, 720)), ((720, 1280), (1280, 720)), ((2000, 2000), (1920, 1080))],
    ],
)
def test_a_device_is_asked_for_the_smallest_mode_that_covers_both_sides(least, mode):
    assert device_mode(*least) == mode


@pytest.mark.parametrize("set_by_user", [None, "timeout;1"])
def test_a_stream_is_opened_for_low_latency_unless_the_user_says_otherwise(
    monkeypatch, clock, set_by_user
):
    names = (capture.FFMPEG_OPTIONS_VARIABLE, capture.FFMPEG_LOG_VARIABLE)
    for name in names:
        monkeypatch.delenv(name, raising=False)
    if set_by_user is not None:
        monkeypatch.setenv(names[0], set_by_user)
    before, seen = dict(os.environ), []

    def open_capture(*arguments):
        seen.extend(os.environ[name] for name in names)
        return FakeCapture([0.0])

    monkeypatch.setattr(cv2, "VideoCapture", open_capture)
    source = open_stream("udp://0.0.0.0:5600", clock=clock)
    assert seen == [set_by_user or capture.LOW_LATENCY_OPTIONS, "-8"]
    assert dict(os.environ) == before
    image = source.next_image()
    assert (image.arrived_ns, image.stamp_ns) == (START_NS, 0)
    with pytest.raises(CameraError, match="ended, or was silent"):
        source.next_image()


def test_captures_opened_at_once_have_their_own_options(monkeypatch, tmp_path, clock):
    """A stream is being opened while a description of one and a file wait for their turn."""
    monkeypatch.delenv(capture.FFMPEG_OPTIONS_VARIABLE, raising=False)
    (sdp := tmp_path / "camera.sdp").touch()
    before, seen = dict(os.environ), {}
    is_opening, go_on = threading.Event(), threading.Event()

    def open_capture(name, *_):
        is_opening.set()
        assert go_on.wait(10)
        seen[name] = os.environ.get(capture.FFMPEG_OPTIONS_VARIABLE)
        raise CameraError("seen")

    def opened(open_it, source):
        with suppress(CameraError):
            open_it(source, clock=clock)

    monkeypatch.setattr(cv2, "VideoCapture", open_capture)
    low = capture.LOW_LATENCY_OPTIONS
    file, stream = tmp_path / "flight.mp4", "udp://0.0.0.0:5600"
    expected = {stream: low, str(sdp): low + capture.SDP_OPTIONS, str(file): None}
    opened_by = ((open_stream, stream), (open_stream, str(sdp)), (VideoFileCamera, file))
    threads = [threading.Thread(target=opened, args=each) for each in opened_by]
    for thread in threads:
        thread.start()
        assert is_opening.wait(10)
    go_on.set()
    for thread in threads:
        thread.join(10)
    assert (seen, dict(os.environ)) == (expected, before)


@pytest.mark.system
def test_h264_over_rtp_by_its_sdp_comes_in_order_and_one_frame_at_most_is_held_back(
    tmp_path, monkeypatch
):
    """Frames are grey, of one of eight levels, which H.264 keeps apart."""
    monkeypatch.delenv(capture.FFMPEG_OPTIONS_VARIABLE, raising=False)
    sender, clock = RtpSender(17220), MonotonicClock()
    sdp = sender.describe(tmp_path / "camera.sdp")

    def send(number):
        sender.send(np.full((SIDE, SIDE, 3), 16 + 30 * (number % 8), np.uint8))

    with repeating(send):
        camera = open_camera(str(sdp), image_size=(64, 64), clock=clock, timeout_s=20)
    while camera.read(NS_PER_S) is not None:  # what was on its way
        pass
    read, last_ns = [], clock.now_ns()
    for number in range(12):
        send(number)
        frame = camera.read(NS_PER_S)
        assert frame is not None, "more than one frame is held back"
        assert last_ns < frame.captured_ns <= clock.now_ns()
        last_ns = frame.captured_ns
        read.append(round((float(frame.rgb.mean()) - 16) / 30))
    assert read[1:] in ([number % 8 for number in range(first, first + 11)] for first in (0, 1))
    camera.close()
    sender.close()
