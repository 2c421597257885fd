import os
import sys
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest

from helpers.camera_senders import SIDE, depth_scene, scene
from helpers.fakes import START_NS
from mavbridge.camera import open as camera_open
from mavbridge.camera.open import BLANK_NS, check_camera, open_camera
from mavbridge.core.clock import NS_PER_S, MonotonicClock
from mavbridge.core.errors import CameraError, MavbridgeError, UserError
from mavbridge.recording.video_process import FragmentedMp4
from sitl.camera.shm import FramePublisher

needs_shm = pytest.mark.skipif(not Path("/dev/shm").is_dir(), reason="needs /dev/shm")


@pytest.mark.parametrize(
    "source",
    [
        *(12, Path("/dev/video3"), Path("/dev/null"), Path("/dev/v4l/by-id/usb-X-video-index0")),
        *("rtp://0.0.0.0:5004", "rtsp://host:8554/cam", "udp://0.0.0.0:5600"),
        *("tcp://h:1", "http://h/a", "https://h/a"),
    ],
)
def test_live_sources(source, monkeypatch):
    """Numbers and files are devices, addresses are streams."""
    asked = []

    def opener(name):
        def refuse(source, *, clock, image_size=None):
            asked.append((name, source, image_size))
            raise CameraError("refused")

        return refuse

    for name in ("open_device", "open_stream"):
        monkeypatch.setattr(camera_open, name, opener(name))
    with pytest.raises(CameraError, match="refused"):
        open_camera(str(source), image_size=(96, 224), clock=MonotonicClock(), timeout_s=0.1)
    expected = ("open_device", source, (96, 224))
    if "://" in str(source):
        expected = ("open_stream", source, None)
    assert asked[0] == expected


def test_a_device_is_known_by_its_kind_and_a_named_pipe_is_told_of_another_way(tmp_path):
    link, fifo = tmp_path / "front_cam", tmp_path / "fifo"
    link.symlink_to("/dev/null")
    os.mkfifo(fifo)
    check_camera(str(link))
    check_camera("rtsp://host/" + 300 * "x")
    for name, told in ((fifo, "'pipe:cat .*fifo'"), (300 * "x", "no such file")):
        with pytest.raises(UserError, match=told):
            check_camera(str(name))


@pytest.mark.parametrize("name", ["a.avi", "10:30.avi"])  # FFmpeg would take one for a protocol
def test_a_file_plays_from_the_first_read_on_and_refuses_a_latency(
    name, tmp_path, monkeypatch, clock
):
    monkeypatch.chdir(tmp_path)
    writer = cv2.VideoWriter(name, cv2.VideoWriter.fourcc(*"MJPG"), 20, (32, 32))
    writer.write(np.zeros((32, 32, 3), np.uint8))
    writer.release()
    with pytest.raises(UserError, match="--camera-latency 120 cannot be used with"):
        check_camera(name, latency_ms=120)
    camera = open_camera(name, image_size=(224, 224), clock=clock)
    frame = camera.read(0)
    assert (frame.captured_ns, frame.is_stamped) == (START_NS, True)
    assert frame.rgb.shape == (32, 32, 3)
    assert camera.dropped_frames == 0
    with pytest.raises(CameraError, match="video ended after 1 frames"):
        camera.read(0)
    camera.close()


def test_shared_memory_carries_its_own_stamps_and_refuses_a_latency(clock):
    with pytest.raises(UserError, match="--camera-latency 40 cannot be used with shm:fpv"):
        open_camera("shm:fpv", image_size=(224, 224), clock=clock, latency_ms=40.0)
    check_camera("shm:fpv")
    check_camera("rtsp://host/cam", latency_ms=40.0)


@needs_shm
@pytest.mark.parametrize(("timeout_s", "left_s"), [(3.0, [2, 1]), (2.5, [2, 1]), (0.4, [])])
def test_shared_memory_that_never_appears_is_counted_down_and_refused(timeout_s, left_s, clock):
    lines = []
    camera = {
        "image_size": (224, 224),
        "clock": clock,
        "timeout_s": timeout_s,
        "report": lines.append,
    }
    told = rf"within {timeout_s:g} s \(link.camera_timeout\): shm:mb-none"
    with pytest.raises(CameraError, match=told):
        open_camera("shm:mb-none", **camera)
    assert clock.now_ns() == START_NS + round(timeout_s * NS_PER_S)
    said = [line.partition(" (") for line in lines]
    assert [line for line, _, _ in said] == [f"waiting for the camera: {s} s left" for s in left_s]
    assert ["--camera shm:mb-none" in reason for _, _, reason in said] == [
        second == 2 for second in left_s
    ], "a reason is told once"


@pytest.mark.parametrize("spec", ["", "nowhere.mp4", "-1", "ftp://host/x", "/"])
def test_anything_else_is_refused_with_the_forms_there_are(spec):
    lack = "a folder" if spec == "/" else "no such file"
    with pytest.raises(UserError, match=lack + r".*/dev/video0.*rtsp://.*shm:NAME.*screen:"):
        check_camera(spec)


def test_a_device_that_is_not_there_is_refused():
    with pytest.raises(CameraError, match=r"within 0\.3 s .*camera 999 cannot be opened"):
        open_camera("999", image_size=(224, 224), clock=MonotonicClock(), timeout_s=0.3)
    assert "mavbridge-camera" not in [thread.name for thread in threading.enumerate()]


@pytest.mark.parametrize("package", ["mss", "Xlib"])
def test_the_screen_without_its_packages_names_the_extra(monkeypatch, package):
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.delitem(sys.modules, "mavbridge.camera.screen", raising=False)
    with pytest.raises(MavbridgeError, match=r"pip install "):
        check_camera("screen:")


@needs_shm
@pytest.mark.parametrize("is_depth", [True, False])
def test_a_camera_of_the_other_kind_is_refused_with_its_figures(is_depth, clock):
    name = f"mb-test-kind-{is_depth}"
    publisher = FramePublisher(name, 24, 16, is_depth=is_depth)
    publisher.publish(depth_scene(0)[:16, :24] if is_depth else scene(0)[:16, :24], START_NS)
    for wanted in (is_depth, None):
        open_camera(f"shm:{name}", image_size=(16, 16), clock=clock, is_depth=wanted).close()
    found = "depth of 24x16" if is_depth else "RGB images of 24x16"
    with pytest.raises(UserError, match=rf"shm:{name} delivers {found}, .*\(image_channels\)"):
        open_camera(f"shm:{name}", image_size=(16, 16), clock=clock, is_depth=not is_depth)
    publisher.close()


def test_the_video_of_a_depth_flight_plays_as_depth(tmp_path, clock):
    path = tmp_path / "camera.mp4"
    video = FragmentedMp4(path, hz=30)
    for number in range(3):
        video.append(depth_scene(number), number * NS_PER_S // 30)
    video.close()
    with pytest.raises(UserError, match=f"delivers depth of {SIDE}x{SIDE}, .* takes RGB"):
        open_camera(str(path), image_size=(32, 32), clock=clock, is_depth=False)
    camera = open_camera(str(path), image_size=(32, 32), clock=clock, is_depth=True)
    for number in range(3):
        assert np.array_equal(camera.read(NS_PER_S).rgb, depth_scene(number))
    camera.close()


def test_black_frames_come_on_a_grid_and_late_ones_are_dropped(clock):
    camera = open_camera("none", image_size=(32, 32), clock=clock)
    first = camera.read(BLANK_NS)
    assert camera.read(BLANK_NS // 2) is None
    second = camera.read(BLANK_NS)
    assert second.captured_ns - first.captured_ns == BLANK_NS
    clock.advance_ns(3 * BLANK_NS + BLANK_NS // 4)
    third = camera.read(BLANK_NS)
    assert third.captured_ns - second.captured_ns == 3 * BLANK_NS
    assert (third.frame_id, camera.dropped_frames, third.rgb.any()) == (5, 2, False)
    camera.close()
