"""The log of the link, with plain processes in the places of the link's and the flight's."""

import os
import resource
import signal
from collections.abc import Iterator
from multiprocessing import Pipe
from multiprocessing.connection import wait
from pathlib import Path
from unittest.mock import patch

import pytest

from helpers.recordings import count_frames, picture
from mavbridge.mavlink.codec.tlog import PacketPipe
from mavbridge.recording import video_process
from mavbridge.recording.tlog import TlogPipe, open_tlog_pipe
from mavbridge.recording.video_process import VideoJob, WriterService
from mavbridge.recording.video_writer import VideoWriter, WriterError

DEADLINE_S = 30.0


def numbers(path: Path) -> list[int]:
    data = path.read_bytes()
    assert len(data) % 13 == 0, "torn"
    return [int(data[at + 8 : at + 13]) for at in range(0, len(data), 13)]


@pytest.fixture
def pipe() -> Iterator[TlogPipe]:
    made = open_tlog_pipe()
    yield made
    made.close()


@pytest.fixture
def link(pipe: TlogPipe) -> Iterator[PacketPipe]:
    """The end of the link's process."""
    made = PacketPipe(os.dup(pipe.writer.fileno()), wall_offset_ns=0)
    pipe.writer.close()
    yield made
    made.close()


@pytest.fixture
def video(tmp_path: Path, pipe: TlogPipe, link: PacketPipe) -> Iterator[VideoWriter]:
    job = VideoJob(tmp_path / "camera.mp4", 30, tlog=pipe.reader)
    made = VideoWriter(job, pressure="online")
    yield made
    made.close()


def send(link: PacketPipe, count: int) -> None:
    for k in range(count):
        link.put(k * 1000, b"%05d" % k)


def test_a_log_without_an_end_is_left(
    tmp_path: Path, pipe: TlogPipe, link: PacketPipe, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(video_process, "TLOG_S", 0.1)
    send(link, 2)
    ours, its = Pipe()
    ours.close()
    service = WriterService(its, VideoJob(tmp_path / "camera.mp4", 30, tlog=pipe.reader))
    service.serve(0)
    assert not service.is_open, "the producer is gone"
    service.finish_log()
    its.close()
    assert numbers(tmp_path / "link.tlog") == [0, 1]


def test_a_log_that_cannot_be_written_is_the_writers_failure(
    video: VideoWriter, link: PacketPipe
) -> None:
    resource.prlimit(video._process.pid, resource.RLIMIT_FSIZE, (6_000, 6_000))
    send(link, 1_000)
    with pytest.raises(WriterError, match=r"the log of the link cannot be written: .*File too"):
        video._wait_until(lambda: False)


def test_the_log_goes_on_after_the_recording_was_finished(
    tmp_path: Path, video: VideoWriter, link: PacketPipe
) -> None:
    send(link, 10)
    for k in range(5):
        video.submit(picture(k), k)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGTSTP):
        os.kill(video._process.pid, number)
    with patch.object(video._process, "join", side_effect=AssertionError("waits in vain")):
        video.finish()
    assert count_frames(tmp_path / "camera.mp4") == 5
    assert video._process.is_alive()
    send(link, 10)
    link.close()
    assert wait([video._process.sentinel], DEADLINE_S)
    assert numbers(tmp_path / "link.tlog") == [*range(10), *range(10)]
    assert link.dropped == 0
