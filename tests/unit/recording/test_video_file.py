from collections.abc import Iterable
from pathlib import Path

import av
import numpy as np
import pytest

from helpers.factories import FRAME_NS, START_NS
from helpers.recordings import count_frames, fragment, number_of, picture, read_video
from mavbridge.core.records import CameraImage
from mavbridge.recording.video_process import FragmentedMp4
from policy.data.flight_video import decode_images, decode_video, whole_images
from policy.errors import DatasetError


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "camera.mp4"


def write(path: Path, images: Iterable[CameraImage]) -> None:
    """30 images a second; each can be read once the next has come."""
    video = FragmentedMp4(path, hz=30)
    for k, image in enumerate(images):
        video.append(image, START_NS + k * FRAME_NS)
        assert count_frames(path) == k
    video.close()


def test_frames_come_back_in_order_with_their_times(path: Path) -> None:
    write(path, map(picture, range(70)))
    assert count_frames(path) == 70
    assert [number_of(rgb) for rgb in read_video(path)] == list(range(70))
    with av.open(str(path)) as container:
        times = [frame.time for frame in container.decode(video=0)]
    assert times == pytest.approx([k / 30 for k in range(70)], abs=2e-5)


def test_colours_are_kept(path: Path) -> None:
    rgb = np.zeros((48, 96, 3), np.uint8)
    rgb[:, :32, 0], rgb[:, 32:64, 1], rgb[:, 64:, 2] = 200, 200, 200
    write(path, [rgb])
    (back,) = read_video(path)
    centres = back[24, [16, 48, 80]].astype(int)
    assert np.abs(centres - rgb[24, [16, 48, 80]]).max() < 12


def test_a_video_cut_off_anywhere_has_its_whole_frames(path: Path) -> None:
    write(path, map(picture, range(4)))
    data = path.read_bytes()
    counts = []
    for size in range(0, len(data) + 1, 7):
        path.write_bytes(data[:size])
        counts.append(count_frames(path))
        assert [number_of(rgb) for rgb in read_video(path)] == list(range(counts[-1]))
    assert set(counts) == {0, 1, 2, 3, 4}


@pytest.mark.parametrize("kind", ["overwritten", "inserted", "cut out"])
@pytest.mark.parametrize("frame", [0, 3, 29, 30])
def test_a_damaged_video_has_the_images_before_the_damage(
    path: Path, kind: str, frame: int
) -> None:
    write(path, map(picture, range(40)))
    data = path.read_bytes()
    start, end = fragment(data, frame)
    kept = {"overwritten": b"?" * (end - start - 2), "inserted": b"?" * 50 + data[start + 2 : end]}
    path.write_bytes(data[: start + 2] + kept.get(kind, b"") + data[end:])
    assert whole_images(path) == (frame, start)
    assert [number_of(rgb) for rgb in read_video(path)] == list(range(frame))


def test_a_video_that_lacks_an_image_ends_before_it(path: Path) -> None:
    write(path, map(picture, range(40)))
    data = path.read_bytes()
    start, end = fragment(data, 7)
    path.write_bytes(data[:start] + data[end:])
    assert whole_images(path) == (7, start)


def test_another_kind_of_mp4_has_no_images_of_a_flight(path: Path) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", 30)
        stream.height, stream.width = 48, 64
        for number in range(3):
            frame = av.VideoFrame.from_ndarray(picture(number), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    assert count_frames(path) == 0


def test_an_image_that_is_damaged_inside_is_refused(path: Path) -> None:
    write(path, np.random.default_rng(0).integers(0, 256, (40, 96, 128, 3), dtype=np.uint8))
    data = bytearray(path.read_bytes())
    _, end = fragment(data, 7)
    data[end - 900 : end - 500] = b"\x5a" * 400
    path.write_bytes(data)
    with pytest.raises(DatasetError, match="7 of its 40 images came before the damage"):
        list(read_video(path))


def test_errors_say_what_is_wrong(path: Path) -> None:
    with pytest.raises(DatasetError, match="no such file"):
        list(decode_images(path, 3))
    path.write_bytes(b"no video")
    with pytest.raises(DatasetError, match="3 of 3 images are missing"):
        list(decode_images(path, 3))
    path.unlink()
    write(path, map(picture, range(3)))
    with pytest.raises(DatasetError, match="2 of 5 images are missing"):
        list(decode_images(path, 5))
    with pytest.raises(FileExistsError):
        FragmentedMp4(path, hz=30).append(picture(0), START_NS)


def test_depth_comes_back_to_the_last_bit(path: Path) -> None:
    depths = np.random.default_rng(0).integers(0, 1 << 16, (4, 48, 64), np.uint16)
    write(path, depths)
    back = list(read_video(path))
    assert {each.dtype for each in back} == {np.dtype(np.uint16)}
    assert np.array_equal(back, depths)
    with pytest.raises(DatasetError, match="holds depth"):
        next(decode_video(path, 4))


def test_stamps_that_stand_still_or_go_back_still_give_frames(path: Path) -> None:
    video = FragmentedMp4(path, hz=30)
    for k, at_ns in enumerate((0, 0, -5 * FRAME_NS, FRAME_NS, 0)):
        video.append(picture(k), START_NS + at_ns)
    video.close()
    assert [number_of(rgb) for rgb in read_video(path)] == [0, 1, 2, 3, 4]
