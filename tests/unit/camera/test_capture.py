import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from helpers.camera_senders import SIDE, FakeCapture, RtpSender, repeating
from helpers.fakes import START_NS, FakeClock
from mavbridge.camera import capture
from mavbridge.camera.capture import exposure_ns, open_device, open_stream
from mavbridge.camera.open import open_camera
from mavbridge.core.clock import NS_PER_MS, NS_PER_S, MonotonicClock
from mavbridge.core.errors import CameraError

NOW_NS = 1_000 * NS_PER_S


@pytest.mark.parametrize(
    ("driver_ms", "is_our_clock", "captured_ns"),
    [
        pytest.param(999_990.0, False, NOW_NS - 10 * NS_PER_MS, id="10 ms ago on our clock"),
        pytest.param(1_000_000.0, False, NOW_NS, id="now"),
        pytest.param(999_000.0, False, NOW_NS - NS_PER_S, id="as old as it may be"),
        pytest.param(998_999.0, False, NOW_NS, id="too old"),
        pytest.param(1_000_000.1, False, NOW_NS, id="from the future"),
        pytest.param(0.0, False, NOW_NS, id="no stamp"),
        pytest.param(-1.0, False, NOW_NS, id="not supported"),
        pytest.param(1.7e12, False, NOW_NS, id="wall clock"),
        pytest.param(997_000.0, True, NOW_NS - 3 * NS_PER_S, id="from a queue that nobody read"),
        pytest.param(1_000_400.0, True, NOW_NS + 400 * NS_PER_MS, id="our clock, ahead"),
        pytest.param(0.0, True, NOW_NS, id="our clock, no stamp"),
    ],
)
def test_the_drivers_stamp_is_taken_if_it_can_be_one(driver_ms, is_our_clock, captured_ns):
    stamp_ns = round(driver_ms * NS_PER_MS)
    assert exposure_ns(stamp_ns, NOW_NS, is_our_clock=is_our_clock) == captured_ns


def test_a_device_gives_rgb_with_the_drivers_stamp(monkeypatch):
    opened_with, device = [], FakeCapture([START_NS / NS_PER_MS - 7])

    def open_capture(*arguments):
        opened_with.append(arguments)
        return device

    monkeypatch.setattr(cv2, "VideoCapture", open_capture)
    source = open_device(Path("/dev/video7"), image_size=300, clock=FakeClock())
    assert opened_with == [("/dev/video7", cv2.CAP_V4L2)]
    assert device.settings == {cv2.CAP_PROP_FRAME_WIDTH: 640, cv2.CAP_PROP_FRAME_HEIGHT: 480}
    image = source.next_image()
    assert image.captured_ns == START_NS - 7 * NS_PER_MS
    assert image.rgb.tolist() == [[[3, 2, 1]]]
    with pytest.raises(CameraError, match="unplugged"):
        source.next_image()
    source.close()


@pytest.mark.parametrize(
    ("set_by_user", "seen"), [(None, capture.LOW_LATENCY_OPTIONS), ("timeout;1", "timeout;1")]
)
def test_a_stream_is_opened_for_low_latency_unless_the_user_says_otherwise(
    monkeypatch, set_by_user, seen
):
    monkeypatch.delenv(capture.FFMPEG_OPTIONS_VARIABLE, raising=False)
    if set_by_user is not None:
        monkeypatch.setenv(capture.FFMPEG_OPTIONS_VARIABLE, set_by_user)
    monkeypatch.delenv(capture.FFMPEG_LOG_VARIABLE, raising=False)
    options, log_levels = [], []

    def open_capture(*arguments):
        options.append(os.environ[capture.FFMPEG_OPTIONS_VARIABLE])
        log_levels.append(os.environ[capture.FFMPEG_LOG_VARIABLE])
        return FakeCapture([0.0])

    monkeypatch.setattr(cv2, "VideoCapture", open_capture)
    source = open_stream("udp://0.0.0.0:5600", clock=FakeClock())
    assert options == [seen]
    assert log_levels == ["-8"]
    assert capture.FFMPEG_LOG_VARIABLE not in os.environ
    assert os.environ.get(capture.FFMPEG_OPTIONS_VARIABLE) == set_by_user
    assert source.next_image().captured_ns == START_NS
    with pytest.raises(CameraError, match="ended, or was silent"):
        source.next_image()


@pytest.mark.system
def test_h264_over_rtp_by_its_sdp_comes_in_order_and_one_frame_at_most_is_held_back(
    tmp_path, monkeypatch
):
    monkeypatch.delenv(capture.FFMPEG_OPTIONS_VARIABLE, raising=False)
    sender, clock = RtpSender(17220), MonotonicClock()
    sdp = sender.describe(tmp_path / "camera.sdp")
    numbers = iter(range(1 << 20))

    def send():
        sender.send(level_scene(number := next(numbers)))
        return number

    with repeating(lambda _: send()):
        camera = open_camera(str(sdp), image_size=64, clock=clock, timeout_s=20)
    while camera.read(NS_PER_S) is not None:  # what was on its way
        pass
    sent, read, last_ns = [], [], clock.now_ns()
    for _ in range(12):
        sent.append(send())
        frame = camera.read(NS_PER_S)
        assert frame is not None, "more than one frame is held back"
        assert last_ns < frame.captured_ns <= clock.now_ns()
        last_ns = frame.captured_ns
        read.append(level_of(frame.rgb))
    assert read[1:] in ([number % 8 for number in sent[1:]], [number % 8 for number in sent[:-1]])
    camera.close()
    sender.close()


def level_scene(number):
    """Grey of one of eight levels, which H.264 keeps apart."""
    return np.full((SIDE, SIDE, 3), 16 + 30 * (number % 8), np.uint8)


def level_of(rgb):
    return round((float(rgb.mean()) - 16) / 30)
