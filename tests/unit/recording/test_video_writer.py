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
    number_of,
    picture,
    read_video,
    send_signal,
)
from mavbridge.recording import video_process, video_writer
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
    job = VideoJob(folder / "camera.mp4", hz=30)
    return closing(VideoWriter(job, pressure=pressure))


def read_back(path: Path) -> list[int]:
    """Numbers of the images."""
    return [number_of(rgb) for rgb in read_video(path)]


def test_an_odd_row_and_column_are_cut_off(tmp_path: Path) -> None:
    job = VideoJob(tmp_path / "odd.mp4", hz=10)
    with closing(VideoWriter(job, pressure="offline")) as video:
        for k in range(3):
            assert video.submit(picture(k, height=49, width=67), k)
        video.finish()
    assert [path.name for path in tmp_path.iterdir()] == ["odd.mp4"]
    images = list(read_video(tmp_path / "odd.mp4"))
    assert [(rgb.shape, number_of(rgb)) for rgb in images] == [((48, 66, 3), k) for k in range(3)]


def one_picture_kept(folder: Path) -> list[int]:
    """Write one picture, offline; return the numbers of those in the video."""
    with writer(folder, "offline") as video:
        video.submit(picture(0), 0)
        video.finish()
    return read_back(folder / "camera.mp4")


def test_a_pause_of_both_processes_is_no_hang(tmp_path: Path) -> None:
    wait, pauses = video_writer.wait, [[]]

    def paused_once(*ends_and_timeout: Any) -> list[Any]:
        return pauses.pop() if pauses else wait(*ends_and_timeout)

    with patch.object(video_writer, "wait", paused_once):
        assert one_picture_kept(tmp_path) == [0]


def test_an_offline_producer_that_waits_hears_of_the_death(tmp_path: Path) -> None:
    with writer(tmp_path, "offline") as video:
        video.submit(picture(0), 0)
        send_signal(video._process.pid, signal.SIGSTOP)
        reasons: list[str] = []
        has_begun = threading.Event()

        def produce() -> None:
            try:
                for k in range(1, 100):
                    video.submit(picture(k), k)
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


def test_a_signal_to_its_group_does_not_end_a_writer_that_starts(tmp_path: Path) -> None:
    start = video_writer.start_process

    def struck(*job: Any) -> Any:
        started = start(*job)
        for number in (signal.SIGTERM, signal.SIGINT):
            os.kill(started[1].pid, number)
        return started

    with patch.object(video_writer, "start_process", struck):
        assert one_picture_kept(tmp_path) == [0]
    assert signal.pthread_sigmask(signal.SIG_BLOCK, []) == set()


class Alive:
    """A process that never ends; the service is driven by hand in the same thread."""

    sentinel, exitcode = -1, None

    def join(self, timeout_s: float) -> None:
        pass

    def is_alive(self) -> bool:
        return False


@settings(max_examples=40)
@given(st.lists(st.booleans(), max_size=60))
def test_the_video_has_the_frames_that_were_taken(steps: list[bool]) -> None:
    """True: a frame is offered; False: the writer does one thing."""
    with TemporaryDirectory() as name, patch.object(video_process, "MAX_SLOTS", MIN_SLOTS):
        video = Path(name) / "camera.mp4"
        ours, its = Pipe()
        job = VideoJob(video, hz=30)
        service = WriterService(its, job)
        service.send(Notice.READY)
        with patch.object(video_writer, "start_process", lambda *_: (ours, Alive())):
            sender = VideoWriter(job, pressure="online")
        taken: list[int] = []
        for number, is_offered in enumerate(steps):
            if not is_offered:
                service.serve(0)
            elif sender.submit(picture(number), number):
                taken.append(number)
        ours.send(Notice.FINISH)
        while service.is_open:
            service.serve(0)
        sender._receive()
        sender.close()
        its.close()
        assert sender.written == len(taken)
        assert video.exists() == bool(taken)
        assert not taken or read_back(video) == taken


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
