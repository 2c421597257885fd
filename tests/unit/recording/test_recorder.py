import multiprocessing
import os
import resource
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from helpers.factories import make_tick
from helpers.recordings import make_frame, make_meta, number_of, send_signal
from mavbridge.core.vehicle import Packet
from mavbridge.mavlink.transport.packet_pipe import PacketPipe
from mavbridge.recording.flight_folder import open_flight
from mavbridge.recording.recorder import Recorder
from mavbridge.recording.tlog import open_tlog_pipe

DEADLINE_S = 30.0


@dataclass
class RecorderStand:
    """A recorder and what it told a person."""

    folder: Path
    told: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        tlog_pipe = open_tlog_pipe()
        self.packets = PacketPipe(os.dup(tlog_pipe.writer.fileno()), wall_offset_ns=10**18)
        tlog_pipe.writer.close()
        self.recorder = Recorder(
            self.folder,
            make_meta(),
            tlog_pipe=tlog_pipe,
            packets_dropped=lambda: self.packets.dropped,
            autopilot=lambda: "ardupilot 4.6.0",
            report=self.told.append,
        )
        self.writer = self.recorder._flight.writer
        (process,) = (
            child for child in multiprocessing.active_children() if child.name == "mavbridge-writer"
        )
        assert process.pid is not None
        self.pid = process.pid


@contextmanager
def stand(folder: Path) -> Iterator[RecorderStand]:
    made = RecorderStand(folder)
    try:
        yield made
    finally:
        made.packets.close()
        made.recorder.close(DEADLINE_S)


def until(stood: RecorderStand, ticks: int) -> None:
    """The thread has taken that many ticks."""
    for _ in range(10_000):
        if stood.writer.ticks >= ticks:
            return
        stood.recorder._closing.wait(0.01)
    raise TimeoutError


def test_ticks_frames_and_packets_end_in_the_folder(tmp_path: Path) -> None:
    with stand(tmp_path) as stood:
        for k in range(3):
            stood.packets.put(Packet(k, b"packet"))
        for k in range(300):
            stood.recorder.emit(make_tick(k))
        for k in range(20):
            stood.recorder.emit(make_frame(k))
    assert stood.recorder.dropped == 0
    assert stood.recorder.summary() == f"recorded 300 ticks and 20 frames in {tmp_path}"
    back = open_flight(tmp_path)
    assert (back.meta.ticks, back.meta.frames, back.meta.packets_dropped) == (300, 20, 0)
    assert back.meta.autopilot == "ardupilot 4.6.0"
    assert [number_of(rgb) for rgb in back.images()] == list(range(20))
    assert (tmp_path / "link.tlog").stat().st_size == 3 * (8 + 6)
    assert stood.told == []


def test_a_killed_writer_costs_the_images_alone_and_is_told_once(tmp_path: Path) -> None:
    with stand(tmp_path) as stood:
        for k in range(10):
            stood.recorder.emit(make_tick(k))
            stood.recorder.emit(make_frame(k))
        until(stood, 10)
        send_signal(stood.pid, signal.SIGKILL)
        for k in range(10, 40):
            stood.recorder.emit(make_tick(k))
        for k in range(10, 20):
            stood.recorder.emit(make_frame(k))
    assert len(stood.told) == 1
    assert "recording no more images: the writer process has died" in stood.told[0]
    back = open_flight(tmp_path)
    assert back.ticks.num_rows == 40
    assert not back.meta.finished
    assert 0 <= back.frames.num_rows <= 10
    assert len(list(back.images())) == back.frames.num_rows
    assert 10 <= stood.recorder.dropped <= 20
    assert "not completely: the writer process has died" in stood.recorder.summary()


def test_a_full_disk_ends_the_recording_with_one_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with stand(tmp_path) as stood:
        resource.prlimit(stood.pid, resource.RLIMIT_FSIZE, (6_000, 6_000))
        number = 0
        while stood.recorder.failure is None:
            assert number < 10_000
            stood.recorder.emit(make_tick(number))
            stood.recorder.emit(make_frame(number))
            number += 1
            stood.recorder._closing.wait(0.005)
        stood.recorder.emit(make_tick(number))  # the flight goes on
    warnings = [record.getMessage() for record in caplog.records] + stood.told
    assert len(warnings) == 1
    assert "the video cannot be written" in warnings[0]
    assert "File too large" in warnings[0]
    assert stood.recorder.dropped > 0
    back = open_flight(tmp_path)
    assert not back.meta.finished
    assert 0 < back.frames.num_rows < number
    numbers = [row.frame_id - 1 for row in back.frame_rows()]
    assert [number_of(rgb) for rgb in back.images()] == numbers
