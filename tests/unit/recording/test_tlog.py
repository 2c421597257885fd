"""The log of the link, with plain processes in the places of the link's and the flight's."""

import os
import resource
import signal
import threading
from collections.abc import Iterator
from multiprocessing.connection import wait
from pathlib import Path

import pytest

from helpers.recordings import make_row, picture, send_signal
from mavbridge.core.vehicle import Packet
from mavbridge.mavlink.transport.packet_pipe import PacketPipe
from mavbridge.recording.tlog import TlogJob, TlogPipe, TlogThread, open_tlog_pipe
from mavbridge.recording.video.file import count_frames
from mavbridge.recording.video.writer import VideoWriter, WriterError

DEADLINE_S = 30.0


class Link:
    """Stands in for the process of the link."""

    def __init__(self, pipe: TlogPipe) -> None:
        self.log = PacketPipe(os.dup(pipe.writer.fileno()), wall_offset_ns=0)
        pipe.writer.close()

    def send(self, count: int) -> None:
        for k in range(count):
            self.log.put(Packet(k * 1000, b"%05d" % k))


def numbers(path: Path) -> list[int]:
    data = path.read_bytes()
    assert len(data) % 13 == 0, "torn"
    return [int(data[at + 8 : at + 13]) for at in range(0, len(data), 13)]


@pytest.fixture
def pipe() -> Iterator[TlogPipe]:
    made = open_tlog_pipe()
    yield made
    made.close()


def start(folder: Path, pipe: TlogPipe) -> VideoWriter:
    job = TlogJob(folder / "link.tlog", pipe.reader)
    return VideoWriter(folder / "camera.mp4", pressure="online", hz=30, tlog=job)


def await_size(path: Path, size_bytes: int) -> None:
    pause = threading.Event()
    for _ in range(3_000):
        if path.exists() and path.stat().st_size >= size_bytes:
            return
        pause.wait(0.01)
    raise TimeoutError


def test_everything_is_written_in_order_also_what_came_before_the_thread(
    tmp_path: Path, pipe: TlogPipe
) -> None:
    path = tmp_path / "link.tlog"
    link = Link(pipe)
    link.send(3_000)
    thread = TlogThread(TlogJob(path, pipe.reader))
    link.send(3_000)
    link.log.close()
    thread.finish(DEADLINE_S)
    assert numbers(path) == [*range(3_000), *range(3_000)]
    assert link.log.dropped == 0
    assert thread.failure is None


def test_a_pipe_that_does_not_end_is_left_after_the_deadline(
    tmp_path: Path, pipe: TlogPipe
) -> None:
    thread = TlogThread(TlogJob(tmp_path / "link.tlog", pipe.reader))
    thread.finish(0.0)
    link = Link(pipe)
    link.send(2)
    assert link.log.dropped == 2, "the link learns that nobody reads"
    link.log.close()


def test_a_log_that_cannot_be_written_closes_the_pipe(tmp_path: Path, pipe: TlogPipe) -> None:
    thread = TlogThread(TlogJob(tmp_path / "missing" / "link.tlog", pipe.reader))
    thread.finish(DEADLINE_S)
    assert isinstance(thread.failure, FileNotFoundError)
    link = Link(pipe)
    link.send(1)
    assert link.log.dropped == 1
    link.log.close()


def test_a_log_that_cannot_be_written_is_the_writers_failure(
    tmp_path: Path, pipe: TlogPipe
) -> None:
    video = start(tmp_path, pipe)
    assert video.pid is not None
    resource.prlimit(video.pid, resource.RLIMIT_FSIZE, (6_000, 6_000))
    link = Link(pipe)
    link.send(1_000)
    with pytest.raises(WriterError, match=r"the log of the link cannot be written: .*File too"):
        video._wait_until(lambda: False)
    video.close()
    link.log.close()


def test_the_log_goes_on_after_the_recording_was_finished(tmp_path: Path, pipe: TlogPipe) -> None:
    video = start(tmp_path, pipe)
    link = Link(pipe)
    link.send(10)
    for k in range(5):
        video.submit(picture(k), make_row(k))
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGTSTP):
        assert video.pid is not None
        os.kill(video.pid, number)
    video.finish()
    assert count_frames(tmp_path / "camera.mp4") == 5
    assert video._process.is_alive()
    link.send(10)
    link.log.close()
    assert wait([video._process.sentinel], DEADLINE_S)
    assert numbers(tmp_path / "link.tlog") == [*range(10), *range(10)]
    assert link.log.dropped == 0


def test_a_killed_writer_costs_the_log_and_not_the_link(tmp_path: Path, pipe: TlogPipe) -> None:
    video = start(tmp_path, pipe)
    link = Link(pipe)
    link.send(10)
    await_size(tmp_path / "link.tlog", 10 * 13)
    assert video.pid is not None
    send_signal(video.pid, signal.SIGKILL)
    link.send(7)
    assert link.log.dropped == 7
    video.close()
    link.log.close()
    assert numbers(tmp_path / "link.tlog") == [*range(10)]
