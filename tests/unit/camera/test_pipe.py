"""A camera that is a program's output: cut into frames, stamped, ended and explained."""

import os
import shlex
import sys
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from faults.processes import Process, child_of
from helpers.camera_senders import SIDE, depth_scene, encoded, next_image, scene
from mavbridge.camera.open import check_camera, open_camera
from mavbridge.camera.pipe import PipeCommand, PipeSource, parse_pipe
from mavbridge.camera.pipe_frames import RAW_FORMATS, PictureCutter, RawCutter
from mavbridge.core.clock import NS_PER_MS, MonotonicClock
from mavbridge.core.errors import CameraError, UserError

WIDTH, HEIGHT = 32, 16
WRITER = """
import signal, sys, time
out = sys.stdout.buffer
def write(data):
    out.write(data)
    out.flush()
"""


def python(body: str) -> str:
    """A command line that runs this Python program."""
    return shlex.join([sys.executable, "-c", WRITER + body])


def picture(level: int) -> np.ndarray:
    rgb = np.full((HEIGHT, WIDTH, 3), level, np.uint8)
    rgb[:, : WIDTH // 2, 0] = 200
    return rgb


def with_thumbnail(data: bytes) -> bytes:
    """The same picture with another one in its header, as cameras write them."""
    inner = encoded(picture(7))
    return data[:2] + b"\xff\xe1" + (len(inner) + 2).to_bytes(2, "big") + inner + data[2:]


def source(command: str) -> closing[PipeSource]:
    return closing(PipeSource(parse_pipe(command), clock=MonotonicClock()))


@pytest.mark.parametrize(("prefix", "raw"), [("", None), ("33x17:gray16le:", (33, 17, "gray16le"))])
def test_a_command_is_split_without_a_shell(prefix: str, raw: tuple[int, int, str] | None) -> None:
    command = parse_pipe(f"{prefix}{sys.executable} -c 1 'two words' $HOME")
    assert command == PipeCommand((sys.executable, "-c", "1", "two words", "$HOME"), raw)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("640x480:rgb24:", "names no program"),
        ("no-such-program -o -", "there is no program 'no-such-program'"),
        ("640x480:rgb:cat", "'rgb' is no format .* rgb24"),
        ("0x480:rgb24:cat", "0x480"),
        ("33x16:nv12:cat", "even"),
        ("cat 'half", "quotation"),
    ],
)
def test_what_cannot_run_is_refused_before_anything_is_loaded(text: str, told: str) -> None:
    with pytest.raises(UserError, match=told):
        check_camera(f"pipe:{text}")


@given(
    st.lists(st.integers(0, 255), min_size=1, max_size=4),
    st.lists(st.integers(1, 700), min_size=1, max_size=20),
    st.booleans(),
    st.booleans(),
)
def test_pictures_are_found_however_their_bytes_come(
    levels: list[int], sizes: list[int], is_multipart: bool, is_png: bool
) -> None:
    header = b"--frame\r\nContent-Type: image/jpeg\r\n\r\n" if is_multipart else b""
    frames = [
        encoded(depth_scene(level), ".png") if is_png else with_thumbnail(encoded(picture(level)))
        for level in levels
    ]
    data = b"".join(header + frame for frame in frames)
    cutter, found, at, number = PictureCutter(), [], 0, 0
    while at < len(data):
        size = sizes[number % len(sizes)]
        cutter.put(data[at : at + size], number)
        if (taken := cutter.take()) is not None:
            found.append(taken[0])
        at, number = at + size, number + 1
    assert found[-1] == frames[-1]
    assert set(found) <= set(frames)
    assert cutter.rest() == ""


def test_a_frame_is_as_old_as_its_first_byte_and_the_newest_wins() -> None:
    for cutter, frames in (
        (RawCutter(2, 2, RAW_FORMATS["gray"]), [b"abcd", b"efgh", b"ijkl"]),
        (PictureCutter(), [encoded(picture(level)) for level in (10, 20, 30)]),
    ):
        cutter.put(frames[0][:2], 1)
        cutter.put(frames[0][2:] + frames[1][:2], 5)
        assert cutter.take() == (frames[0], 1)
        cutter.put(frames[1][2:] + frames[2], 9)
        assert cutter.take() == (frames[2], 9)
        assert cutter.take() is None


def test_every_raw_format_shows_the_colours() -> None:
    rgb = picture(60)
    grey = np.repeat(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)[..., None], 3, axis=2)
    yuv = cv2.cvtColor(rgb, cv2.COLOR_RGB2YUV_I420).reshape(-1)
    luma, chroma = yuv[: WIDTH * HEIGHT], yuv[WIDTH * HEIGHT :].reshape(2, -1)
    for name, data, expected in (
        ("rgb24", rgb.tobytes(), rgb),
        ("bgr24", rgb[..., ::-1].tobytes(), rgb),
        ("yuv420p", yuv.tobytes(), rgb),
        ("nv12", luma.tobytes() + chroma.T.tobytes(), rgb),
        ("gray", grey[..., 0].tobytes(), grey),
        ("yuyv422", b"\x50\x80" * WIDTH * HEIGHT, np.full_like(rgb, 80)),
    ):
        shown = RawCutter(WIDTH, HEIGHT, RAW_FORMATS[name]).decode(data)
        assert np.abs(shown.astype(int) - expected).max() <= 12, name


def test_depth_comes_as_png_of_16_bits_or_raw_and_no_other_picture_is_depth() -> None:
    depth = depth_scene(3)
    shown = PictureCutter().decode(encoded(depth, ".png"))
    raw = RawCutter(SIDE, SIDE, RAW_FORMATS["gray16le"]).decode(depth.astype("<u2").tobytes())
    for found in (shown, raw):
        assert found.dtype == np.uint16
        assert np.array_equal(found, depth)
    for colours in (np.dstack([depth] * 3), (depth >> 8).astype(np.uint8), scene(1)):
        picture = PictureCutter().decode(encoded(colours, ".png"))
        assert (picture.dtype, picture.shape) == (np.uint8, (SIDE, SIDE, 3))


@pytest.mark.parametrize("size", [1, 7, 4096])
def test_a_picture_that_is_cut_off_costs_itself_alone(size: int) -> None:
    whole = encoded(scene(1))
    for kept in (2, 9, 200, whole.index(b"\xff\xda"), len(whole) // 2, len(whole) - 1):
        data, cutter = whole[:kept] + whole, PictureCutter()
        starts = range(0, len(data), size)
        for number in starts:
            cutter.put(data[number : number + size], number)
        frame, arrived_ns = cutter.take() or (b"", 0)
        assert frame == whole
        if kept not in (9, 200):  # in its header: it is noticed while the next one comes
            assert arrived_ns == max(each for each in starts if each <= kept + (size == 1))
        assert cutter.rest() == ""


@pytest.mark.parametrize("kept", [9, 200, 2000])
@pytest.mark.parametrize("between", [b"", bytes(5000)])
def test_of_pictures_of_which_every_second_is_cut_off_the_others_come(
    kept: int, between: bytes
) -> None:
    whole = [encoded(scene(level)) for level in range(12)]
    cutter, found = PictureCutter(), []
    for number, picture in enumerate(whole):
        cutter.put(picture[: kept if number % 2 else None] + between, number)
        found.append(cutter.take())
    assert {taken[0] for taken in found if taken} >= set(whole[2::2])


@pytest.mark.parametrize("data", [b"no pictures here " * 400, b"\xff\xd8junk" * 700])
def test_garbage_ends_in_a_clear_error(data: bytes) -> None:
    with pytest.raises(CameraError, match="no MJPEG"):
        PictureCutter().put(data, 0)


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
@pytest.mark.parametrize(
    "setup",
    [
        "",
        "signal.signal(signal.SIGTERM, signal.SIG_IGN)",
        "import subprocess\n"
        "signal.signal(signal.SIGTERM, signal.SIG_IGN)\n"
        "subprocess.Popen(['sleep', '60'])\n"  # it ignores the signal, too
        "signal.signal(signal.SIGTERM, signal.SIG_DFL)",
    ],
)
def test_frames_come_from_a_program_which_ends_with_the_camera(tmp_path: Path, setup: str) -> None:
    file = tmp_path / f"{len(setup)}.jpg"
    file.write_bytes(encoded(picture(40)))
    body = f"{setup}\nwhile True:\n    write(open('{file}', 'rb').read()); time.sleep(0.01)"
    clock = MonotonicClock()
    camera = open_camera(f"pipe:{python(body)}", image_size=(16, 16), clock=clock, latency_ms=20)
    with closing(camera):
        frame = camera.read(2_000 * NS_PER_MS)
        assert frame.rgb.shape == (HEIGHT, WIDTH, 3)
        assert abs(int(frame.rgb[8, 24, 1]) - 40) < 6
        assert frame.captured_ns <= clock.now_ns() - 20 * NS_PER_MS
        pid = child_of(os.getpid(), bytes(file))
        child = Process(child_of(pid, b"sleep"), clock) if "sleep'" in setup else None
    assert not Path(f"/proc/{pid}").exists()
    assert child is None or child.has_ended(5)


def test_a_program_faster_than_this_computer_still_gives_frames() -> None:
    with source(f"{WIDTH}x{HEIGHT}:rgb24:cat /dev/zero") as opened:
        for _ in range(3):
            assert next_image(opened).rgb.shape == (HEIGHT, WIDTH, 3)


@pytest.mark.parametrize(
    ("body", "raw", "told"),
    [
        ("sys.exit('no camera found')", "", "ended with status 1; it said: no camera found"),
        ("write(b'x' * 9000); time.sleep(60)", "", "begins with 78 78 78"),
        ("write(b'x' * 100)", "32x16:rgb24:", "last 100 bytes are no whole picture of 1536"),
        ("write(b'\\xff\\xd8')", "", "its last picture was cut off"),
    ],
)
def test_why_a_program_gives_no_more_frames_is_said(body: str, raw: str, told: str) -> None:
    with source(raw + python(body)) as opened, pytest.raises(CameraError, match=told):
        next_image(opened)
