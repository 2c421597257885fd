import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from helpers.fakes import FakeClock
from mavbridge.camera import open as camera_open
from mavbridge.camera.open import open_camera
from mavbridge.camera.shared_memory import SharedMemoryCamera
from mavbridge.camera.video_file import VideoFileCamera
from mavbridge.core.errors import CameraError, UserError
from sitl.camera.shm import FramePublisher


class NotOpenedError(Exception):
    """Carries what the opener was asked for."""


@pytest.fixture
def openers(monkeypatch):
    """Sources that only say what they were asked for."""

    def refuse(kind):
        def source(*arguments, **options):
            options.pop("clock")
            raise NotOpenedError(kind, *arguments, options)

        return source

    monkeypatch.setattr(camera_open, "open_device", refuse("device"))
    monkeypatch.setattr(camera_open, "open_stream", refuse("stream"))


@pytest.mark.parametrize(
    ("spec", "asked"),
    [
        ("0", ("device", 0, {"image_size": 224})),
        ("12", ("device", 12, {"image_size": 224})),
        ("/dev/video3", ("device", Path("/dev/video3"), {"image_size": 224})),
        ("rtsp://host:8554/cam", ("stream", "rtsp://host:8554/cam", {})),
        ("udp://0.0.0.0:5600", ("stream", "udp://0.0.0.0:5600", {})),
        ("tcp://host:1", ("stream", "tcp://host:1", {})),
        ("http://host/a.mjpg", ("stream", "http://host/a.mjpg", {})),
        ("https://host/a.mjpg", ("stream", "https://host/a.mjpg", {})),
    ],
)
@pytest.mark.usefixtures("openers")
def test_live_sources(spec, asked):
    with pytest.raises(NotOpenedError) as caught:
        open_camera(spec, image_size=224, clock=FakeClock())
    assert caught.value.args == asked


def test_an_existing_file_is_a_video(tmp_path):
    path = tmp_path / "a.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 20, (32, 32))
    writer.write(np.zeros((32, 32, 3), np.uint8))
    writer.release()
    camera = open_camera(str(path), image_size=224, clock=FakeClock())
    assert isinstance(camera, VideoFileCamera)
    camera.close()


@pytest.mark.skipif(not Path("/dev/shm").is_dir(), reason="needs /dev/shm")
def test_shared_memory():
    publisher = FramePublisher("mb-test-open", 8, 8)
    camera = open_camera("shm:mb-test-open", image_size=224, clock=FakeClock())
    assert isinstance(camera, SharedMemoryCamera)
    camera.close()
    publisher.close()


@pytest.mark.parametrize("spec", ["", "nowhere.mp4", "-1", "ftp://host/x", "camera", "."])
def test_anything_else_is_refused_with_the_forms_there_are(spec):
    with pytest.raises(UserError, match="no such file") as caught:
        open_camera(spec, image_size=224, clock=FakeClock())
    for form in ("/dev/video0", "rtsp://", "shm:NAME", "screen:"):
        assert form in str(caught.value)


def test_a_device_that_is_not_there_is_refused():
    with pytest.raises(CameraError, match="camera 999 cannot be opened"):
        open_camera("999", image_size=224, clock=FakeClock())


@pytest.mark.parametrize("package", ["mss", "Xlib"])
def test_the_screen_without_its_packages_names_the_extra(monkeypatch, package):
    for name in ("mavbridge.camera.x11", package):
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.delitem(sys.modules, "mavbridge.camera.screen", raising=False)
    with pytest.raises(UserError, match=r"pip install 'mavbridge\[screen\]'"):
        open_camera("screen:", image_size=224, clock=FakeClock())
