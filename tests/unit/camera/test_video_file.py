import cv2
import numpy as np
import pytest

from helpers.camera_senders import FakeCapture
from helpers.fakes import START_NS
from mavbridge.camera.capture import VideoFileCamera
from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.errors import CameraError, PolicyError

FRAMES = 10
PERIOD_NS = NS_PER_S // 20


@pytest.fixture
def camera(tmp_path, clock):
    """Ten frames, 50 ms apart, each redder than the one before."""
    path = tmp_path / "red.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 20, (64, 48))
    for index in range(FRAMES):
        writer.write(np.full((48, 64, 3), (0, 0, 20 * index), np.uint8))
    writer.release()
    camera = VideoFileCamera(path, clock=clock)
    yield camera
    camera.close()


def test_it_is_paced_by_its_stamps(camera, clock):
    for index in range(FRAMES):
        frame = camera.read(NS_PER_S)
        assert frame.frame_id == index + 1
        assert frame.captured_ns == pytest.approx(START_NS + index * PERIOD_NS, abs=NS_PER_MS)
        assert clock.now_ns() == frame.captured_ns
        assert frame.rgb[..., 0].mean() == pytest.approx(20 * index, abs=8)
        assert frame.rgb[..., 2].max() < 30
    assert camera.dropped_frames == 0


def test_a_slow_reader_gets_the_newest_and_the_end_is_an_error_after_the_last(camera, clock):
    camera.read(0)
    clock.advance_ns(4 * PERIOD_NS + NS_PER_MS)
    frame = camera.read(0)
    assert frame.frame_id == 5
    assert frame.rgb[..., 0].mean() == pytest.approx(80, abs=8)
    assert camera.dropped_frames == 3
    clock.advance_ns(NS_PER_S)
    assert camera.read(0).frame_id == FRAMES
    with pytest.raises(CameraError, match="video ended after 10 frames"):
        camera.read(0)


def test_a_file_that_is_no_video_is_refused(tmp_path, clock):
    path = tmp_path / "notes.mp4"
    path.write_text("not a video")
    with pytest.raises(CameraError, match="no video that can be decoded"):
        VideoFileCamera(path, clock=clock)
    path.write_text("version https://git-lfs.github.com/spec/v1\n")
    with pytest.raises(CameraError, match="is a pointer of Git LFS, not the file"):
        VideoFileCamera(path, clock=clock)
    with pytest.raises(PolicyError, match="is not UTF-8: rename it"):
        VideoFileCamera(path.rename(tmp_path / "caf\udce9.mp4"), clock=clock)


@pytest.mark.parametrize(
    ("fps", "stamps_ms", "due_ms"),
    [
        pytest.param(20, [0, 0, 0], [0, 50, 100], id="no stamps"),
        pytest.param(0, [0, 0], [0, 33.333333], id="no stamps, no rate"),
        pytest.param(float("nan"), [0, 0], [0, 33.333333], id="rate is not a number"),
        pytest.param(20, [0, 80, 40], [0, 80, 130], id="a stamp that goes back"),
        pytest.param(20, [0, 10, 300], [0, 10, 300], id="a variable rate"),
    ],
)
def test_stamps(monkeypatch, tmp_path, clock, fps, stamps_ms, due_ms):
    monkeypatch.setattr(cv2, "VideoCapture", lambda path: FakeCapture(stamps_ms, fps=fps))
    camera = VideoFileCamera(tmp_path, clock=clock)
    stamps_ns = [camera.read(NS_PER_S).captured_ns - START_NS for _ in due_ms]
    assert stamps_ns == pytest.approx([NS_PER_MS * due for due in due_ms], abs=10)
