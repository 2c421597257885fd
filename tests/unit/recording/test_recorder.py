import multiprocessing
import os
import resource
import signal
import threading
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from helpers.factories import make_tick
from helpers.recordings import make_frame, make_meta, number_of, send_signal
from mavbridge.mavlink.codec.tlog import PacketPipe
from mavbridge.recording.flight_folder import open_flight
from mavbridge.recording.folder import FlightMeta, read_meta, remove_flight
from mavbridge.recording.recorder import Recorder
from mavbridge.recording.tlog import open_tlog_pipe

DEADLINE_S = 30.0


class RecorderStand:
    """A recorder with its writer process, and what it told a person; closed by the context."""

    def __init__(self, folder: Path) -> None:
        tlog_pipe = open_tlog_pipe()
        self.told: list[str] = []
        self.packets = PacketPipe(os.dup(tlog_pipe.writer.fileno()), wall_offset_ns=10**18)
        tlog_pipe.writer.close()
        self.recorder = Recorder(
            folder,
            make_meta(),
            tlog_pipe=tlog_pipe,
            packets_dropped=lambda: self.packets.dropped,
            autopilot=lambda: "ardupilot 4.6.0",
            report=self.told.append,
        )
        children = multiprocessing.active_children()
        (self.pid,) = (child.pid for child in children if child.name == "mavbridge-writer")

    def __enter__(self) -> "RecorderStand":
        return self

    def __exit__(self, *_: object) -> None:
        self.packets.close()
        self.recorder.close(DEADLINE_S)

    def emit(self, ticks: range, frames: range) -> None:
        for event in (*map(make_tick, ticks), *map(make_frame, frames)):
            self.recorder.emit(event)


def test_a_killed_writer_costs_the_images_alone_and_is_told_once(tmp_path: Path) -> None:
    with RecorderStand(tmp_path) as stood:
        stood.emit(range(10), range(10))
        for _ in range(3_000):
            if stood.recorder._flight.writer.ticks < 10:  # the thread has not taken them yet
                stood.recorder._closing.wait(0.01)
        assert read_meta(tmp_path).autopilot == "ardupilot 4.6.0", "known if it is cut off now"
        send_signal(stood.pid, signal.SIGKILL)
        stood.emit(range(10, 40), range(10, 20))
        stood.recorder.describe(lambda meta: replace(meta, parameters={"RC_SPEED": 490.0}))
    assert len(stood.told) == 1
    assert "recording no more images: the writer process has died" in stood.told[0]
    back = open_flight(tmp_path)
    assert back.ticks.num_rows == 40
    assert (back.meta.finished, back.meta.parameters) == (False, {"RC_SPEED": 490.0})
    assert 0 <= back.frames.num_rows <= 10
    assert len(list(back.images())) == back.frames.num_rows
    assert 10 <= stood.recorder.dropped <= 20
    assert "not completely: the writer process has died" in stood.recorder.summary()


def test_two_threads_may_describe_a_flight_at_once(tmp_path: Path) -> None:
    def add(names: Sequence[str]) -> None:
        for name in names:
            stood.recorder.describe(partial(with_condition, name))

    def with_condition(name: str, meta: FlightMeta) -> FlightMeta:
        return replace(meta, conditions=meta.conditions | {name: 0.0})

    with RecorderStand(tmp_path) as stood:
        other = threading.Thread(target=add, args=([*map(str, range(50))],))
        other.start()
        add([*map(str, range(50, 100))])
        other.join(DEADLINE_S)
        assert len(read_meta(tmp_path).conditions) == 100


@pytest.mark.parametrize(
    ("shapes", "told", "recorded"),
    [
        ([(48, 64, 3)] * 3 + [(96, 128, 3)] * 3, "images have changed from 64x48 to 128x96", 3),
        ([(9, 64, 3), (8, 64, 3), (3, 64, 3)] * 2, "images have changed from 64x8 to 64x3", 4),
        ([(1, 64, 3)] * 3, "images of 64x1 are too small for a video", 0),
        ([(64, 1, 3)] * 2 + [(48, 64, 3)], "images of 1x64 are too small for a video", 1),
    ],
)
def test_images_that_no_video_can_have_are_told_once_and_cost_themselves_alone(
    tmp_path: Path, shapes: list[tuple[int, ...]], told: str, recorded: int
) -> None:
    with RecorderStand(tmp_path) as stood:
        stood.emit(range(10), range(0))
        for number, shape in enumerate(shapes):
            frame = replace(make_frame(number), rgb=np.full(shape, 9, np.uint8))
            stood.recorder.emit(frame)
    assert stood.told == [f"images are missing from the recording: the camera's {told}"]
    lost = f"{len(shapes) - recorded} events were dropped; the camera's {told}"
    assert stood.recorder.summary().endswith(f"not completely: {lost}")
    meta = open_flight(tmp_path).meta
    assert (meta.finished, meta.ticks, meta.frames) == (True, 10, recorded)


def test_a_full_disk_ends_the_recording_with_one_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with RecorderStand(tmp_path) as stood:
        resource.prlimit(stood.pid, resource.RLIMIT_FSIZE, (6_000, 6_000))
        number = 0
        while stood.recorder.failure is None:
            assert number < 10_000
            stood.emit(range(number, number + 1), range(number, number + 1))
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


def test_a_removed_flight_leaves_the_files_of_others(tmp_path: Path) -> None:
    with RecorderStand(tmp_path) as stood:
        (tmp_path / "notes.txt").touch()
        stood.emit(range(10), range(10))
    assert stood.recorder.meta.finished
    remove_flight(tmp_path, ("front",))
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]
