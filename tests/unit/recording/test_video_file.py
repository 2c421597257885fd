from pathlib import Path

import av
import numpy as np
import pytest

from helpers.factories import FRAME_NS, START_NS
from helpers.recordings import number_of, picture
from mavbridge.recording.video.file import FragmentedMp4, VideoError, count_frames, read_video
from policy.data.flight_data import DatasetError
from policy.data.flight_folders import decode_video


def write(path: Path, count: int) -> FragmentedMp4:
    video = FragmentedMp4(path, height=48, width=64, hz=30)
    for k in range(count):
        video.append(picture(k), START_NS + k * FRAME_NS)
    return video


def test_frames_come_back_in_order_with_their_times(tmp_path: Path) -> None:
    path = tmp_path / "camera.mp4"
    write(path, 70).close()
    assert count_frames(path) == 70
    assert [number_of(rgb) for rgb in read_video(path)] == list(range(70))
    with av.open(str(path)) as container:
        times = [frame.time for frame in container.decode(video=0)]
    assert times == pytest.approx([k / 30 for k in range(70)], abs=2e-5)


def test_each_frame_but_the_last_is_on_disk_at_once(tmp_path: Path) -> None:
    path = tmp_path / "camera.mp4"
    video = FragmentedMp4(path, height=48, width=64, hz=30)
    for k in range(5):
        video.append(picture(k), START_NS + k * FRAME_NS)
        assert count_frames(path) == k
    video.close()
    assert count_frames(path) == 5


def test_colours_are_kept(tmp_path: Path) -> None:
    path = tmp_path / "camera.mp4"
    rgb = np.zeros((48, 96, 3), np.uint8)
    rgb[:, :32, 0], rgb[:, 32:64, 1], rgb[:, 64:, 2] = 200, 200, 200
    video = FragmentedMp4(path, height=48, width=96, hz=30)
    video.append(rgb, START_NS)
    video.close()
    (back,) = read_video(path)
    centres = back[24, [16, 48, 80]].astype(int)
    assert np.abs(centres - rgb[24, [16, 48, 80]]).max() < 12


def test_stamps_that_stand_still_or_go_back_still_give_frames(tmp_path: Path) -> None:
    path = tmp_path / "camera.mp4"
    video = FragmentedMp4(path, height=48, width=64, hz=30)
    for k, at_ns in enumerate((0, 0, -5 * FRAME_NS, FRAME_NS, 0)):
        video.append(picture(k), START_NS + at_ns)
    video.close()
    assert [number_of(rgb) for rgb in read_video(path)] == [0, 1, 2, 3, 4]


def test_a_video_cut_off_anywhere_has_its_whole_frames(tmp_path: Path) -> None:
    path = tmp_path / "camera.mp4"
    write(path, 4).close()
    data = path.read_bytes()
    counts = []
    for size in range(0, len(data) + 1, 7):
        path.write_bytes(data[:size])
        counts.append(count_frames(path))
        assert [number_of(rgb) for rgb in read_video(path)] == list(range(counts[-1]))
    assert set(counts) == {0, 1, 2, 3, 4}


def test_errors_say_what_is_wrong(tmp_path: Path) -> None:
    path = tmp_path / "camera.mp4"
    with pytest.raises(VideoError, match="cannot be read"):
        count_frames(path)
    path.write_bytes(b"no video")
    with pytest.raises(VideoError, match="cannot be decoded after 0 frames"):
        list(read_video(path, 3))
    path.unlink()
    write(path, 3).close()
    with pytest.raises(VideoError, match="ends after 3 of 5 frames"):
        list(read_video(path, 5))
    with pytest.raises(FileExistsError):
        FragmentedMp4(path, height=48, width=64, hz=30)


def test_depth_comes_back_to_the_last_bit(tmp_path: Path) -> None:
    path = tmp_path / "camera.mp4"
    random = np.random.default_rng(0)
    depths = [random.integers(0, 1 << 16, (48, 64), np.uint16) for _ in range(4)]
    video = FragmentedMp4(path, height=48, width=64, hz=30, is_depth=True)
    for k, depth in enumerate(depths):
        video.append(depth, START_NS + k * FRAME_NS)
        assert count_frames(path) == k
    video.close()
    back = list(read_video(path))
    assert {each.dtype for each in back} == {np.dtype(np.uint16)}
    assert np.array_equal(back, depths)
    with pytest.raises(DatasetError, match="holds depth"):
        next(decode_video(path))
