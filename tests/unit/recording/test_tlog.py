"""The log of the link, with plain processes in the places of the link's and the flight's."""

import os
import resource
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from multiprocessing.connection import wait
from pathlib import Path

import pytest
from pymavlink import mavutil

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


FLIGHT = """
import os, signal, subprocess, sys
from pathlib import Path
from mavbridge.recording.tlog import TlogJob, open_tlog_pipe
from mavbridge.recording.video.writer import VideoWriter
folder = Path(sys.argv[1])
if __name__ == "__main__":
    signal.signal(signal.SIGINT, lambda *_: None)
    pipe = open_tlog_pipe()
    fd = pipe.writer.fileno()
    link = [sys.executable, sys.argv[2], str(fd), str(os.getpid())]
    subprocess.Popen(link, pass_fds=(fd,), start_new_session=True)
    pipe.writer.close()
    job = TlogJob(folder / "link.tlog", pipe.reader)
    video = VideoWriter(folder / "camera.mp4", pressure="online", hz=30, tlog=job)
    os.killpg(os.getpid(), signal.SIGINT)  # Ctrl-C
    print("recording", flush=True)
    sys.stdin.read()
"""
LINK = """
import os, select, sys
from helpers.wire import WireEnd
from mavbridge.core.vehicle import Packet
from mavbridge.mavlink.transport.packet_pipe import PacketPipe
end, log = WireEnd(), PacketPipe(int(sys.argv[1]), wall_offset_ns=1_700_000_000 * 10**9)
def send(number):
    packet = end.pack(end.mav.manual_control_encode(1, number, 0, 0, 0, 0))
    log.put(Packet(number * 10_000_000, packet))
for number in range(100):
    send(number)
pidfd = os.pidfd_open(int(sys.argv[2]))
print("flying", flush=True)
select.select([pidfd], [], [], 30)
for number in range(100, 200):
    send(number)
print("released", log.dropped, flush=True)
"""


def test_after_a_kill_of_the_flight_process_the_log_has_the_release(tmp_path: Path) -> None:
    scripts = {name: tmp_path / f"{name}.py" for name in ("flight", "link")}
    scripts["flight"].write_text(FLIGHT)
    scripts["link"].write_text(LINK)
    flight = subprocess.Popen(
        [sys.executable, str(scripts["flight"]), str(tmp_path), str(scripts["link"])],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        bufsize=0,
        start_new_session=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
    )
    with flight:
        assert flight.stdout is not None
        lines = set()
        while lines != {b"flying\n", b"recording\n"} and wait([flight.stdout], DEADLINE_S):
            lines.add(flight.stdout.readline())
        flight.kill()
        assert lines == {b"flying\n", b"recording\n"}
        # All three have this output: its end is the end of the last of them.
        assert flight.stdout.read() == b"released 0\n"
    log = mavutil.mavlogfile(str(tmp_path / "link.tlog"))
    sent = []
    while (message := log.recv_msg()) is not None:
        sent.append(message.x)
    log.f.close()
    assert sent == [*range(200)]
