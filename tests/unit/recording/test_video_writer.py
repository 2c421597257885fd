import errno
import os
import signal
import threading
from contextlib import closing
from multiprocessing import Pipe
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers.recordings import (
    count_frames,
    make_row,
    number_of,
    picture,
    read_video,
    send_signal,
)
from mavbridge.recording import video_process, video_writer
from mavbridge.recording.rows import FRAMES, read_frames
from mavbridge.recording.tables import read_table
from mavbridge.recording.video_process import (
    MAX_BYTES,
    MAX_SLOTS,
    MIN_SLOTS,
    Notice,
    VideoJob,
    WriterService,
    allocate,
    ring_of,
)
from mavbridge.recording.video_writer import Pressure, VideoWriter, WriterError

DEADLINE_S = 30.0


def writer(folder: Path, pressure: Pressure) -> closing[VideoWriter]:
    job = VideoJob(folder / "camera.mp4", hz=30, rows=folder / "frames")
    return closing(VideoWriter(job, pressure=pressure))


def read_back(folder: Path) -> tuple[list[int], list[int]]:
    """Numbers of the images, and of their rows."""
    rows = read_table(folder / "frames", FRAMES)["frame_id"].to_pylist()
    return [number_of(rgb) for rgb in read_video(folder / "camera.mp4")], rows


def test_a_video_alone_needs_no_table_and_an_odd_row_and_column_are_cut_off(tmp_path: Path) -> None:
    job = VideoJob(tmp_path / "odd.mp4", hz=10)
    with closing(VideoWriter(job, pressure="offline")) as video:
        for k in range(3):
            video.submit(picture(k, height=49, width=67), make_row(k))
        video.finish()
    assert [path.name for path in tmp_path.iterdir()] == ["odd.mp4"]
    images = list(read_video(tmp_path / "odd.mp4"))
    assert [(rgb.shape, number_of(rgb)) for rgb in images] == [((48, 66, 3), k) for k in range(3)]


def test_a_pause_of_both_processes_is_no_hang(tmp_path: Path) -> None:
    wait, pauses = video_writer.wait, [[]]

    def paused_once(*ends_and_timeout: Any) -> list[Any]:
        return pauses.pop() if pauses else wait(*ends_and_timeout)

    with (
        patch.object(video_writer, "wait", paused_once),
        writer(tmp_path, "offline") as video,
    ):
        video.submit(picture(0), make_row(0))
        video.finish()
    assert read_back(tmp_path) == ([0], [0])


def test_an_offline_producer_that_waits_hears_of_the_death(tmp_path: Path) -> None:
    with writer(tmp_path, "offline") as video:
        video.submit(picture(0), make_row(0))
        send_signal(video._process.pid, signal.SIGSTOP)
        reasons: list[str] = []
        has_begun = threading.Event()

        def produce() -> None:
            try:
                for k in range(1, 100):
                    video.submit(picture(k), make_row(k))
                    has_begun.set()
            except WriterError as error:
                reasons.append(str(error))

        producer = threading.Thread(target=produce)
        producer.start()
        assert has_begun.wait(DEADLINE_S)
        send_signal(video._process.pid, signal.SIGKILL)
        producer.join(DEADLINE_S)
        assert len(reasons) == 1
        assert "has died" in reasons[0]


class Alive:
    """A process that never ends; the service is driven by hand in the same thread."""

    sentinel, exitcode = -1, None

    def join(self, timeout_s: float) -> None:
        pass

    def is_alive(self) -> bool:
        return False


@settings(max_examples=40)
@given(st.lists(st.integers(0, 3), max_size=60))
def test_rows_are_frames_and_every_drop_is_told(steps: list[int]) -> None:
    """0..2: a frame is offered, with so many lost before it; 3: the writer does one thing."""
    with TemporaryDirectory() as name, patch.object(video_process, "MAX_SLOTS", MIN_SLOTS):
        folder = Path(name)
        video, table = folder / "camera.mp4", folder / "frames"
        ours, its = Pipe()
        job = VideoJob(video, hz=30, rows=table)
        service = WriterService(its, job)
        service.send(Notice.READY)
        with patch.object(video_writer, "start_process", lambda *_: (ours, Alive())):
            sender = VideoWriter(job, pressure="online")
        offered = lost_upstream = 0
        taken: list[int] = []
        for step in steps:
            if step == 3:
                if its.poll():
                    service.serve(0)
                continue
            lost_upstream += step
            sender.submit(picture(offered), make_row(offered, dropped_before=step))
            if sender._pending_drops == 0:
                taken.append(offered)
                lost_upstream_taken = lost_upstream
            offered += 1
        ours.send(Notice.FINISH)
        while service.is_open:
            service.serve(0)
        sender._receive()
        sender.close()
        its.close()
        if not taken:
            return
        rows = list(read_frames(read_table(table, FRAMES)))
        assert [row.frame_id for row in rows] == taken
        assert count_frames(video) == len(rows)
        dropped = sum(row.dropped_before for row in rows)
        assert dropped == lost_upstream_taken + taken[-1] + 1 - len(taken)
        assert sender.written == len(rows)


@pytest.mark.parametrize(("side", "slots"), [(224, MAX_SLOTS), (1080, 9), (3000, MIN_SLOTS)])
def test_memory_is_bounded(side: int, slots: int) -> None:
    assert ring_of(np.zeros((side, side, 3), np.uint8)).slots == slots
    assert slots == MIN_SLOTS or slots * side * side * 3 <= MAX_BYTES


def test_too_little_memory_is_an_error_now_and_not_a_crash_later(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    reserved: list[str] = []

    def refuse(fd: int, _offset: int, _size: int) -> None:
        reserved.append(str(Path(f"/proc/self/fd/{fd}").readlink()))
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", refuse)
    with pytest.raises(OSError, match="No space"):
        allocate(ring_of(picture(0)))
    assert reserved[0].startswith("/dev/shm/")
    assert reserved[0].endswith("(deleted)"), "nothing stays, whoever is killed"


def test_a_fork_of_the_policy_does_not_keep_the_writer(tmp_path: Path) -> None:
    video = VideoWriter(VideoJob(tmp_path / "camera.mp4", hz=30), pressure="online")
    child = os.fork()
    if child == 0:
        signal.pause()
    try:
        video.close()
        assert video._process.exitcode == 0
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
