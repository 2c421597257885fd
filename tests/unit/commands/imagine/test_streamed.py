"""The decode thread and the writer process when things go wrong or slow."""

import errno
import os
import signal
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from helpers.recordings import count_frames, read_video, send_signal
from helpers.rollouts import TinyWorld, make_plan, make_sampler, read_rows
from mavbridge.commands.imagine import QUEUED_SEGMENTS, StreamedOutput
from mavbridge.commands.imagine_rollout import RolloutError, Segment
from mavbridge.core.stopping import HungError
from mavbridge.recording.tables import TableWriter

DEADLINE_S = 60.0
PLAN = make_plan(iterations=1000)


@contextmanager
def output(out: Path, model: TinyWorld | None = None) -> Iterator[StreamedOutput]:
    with closing(StreamedOutput(out, make_sampler(model), PLAN)) as made:
        yield made
    assert not [each for each in threading.enumerate() if "rollout-decode" in each.name]


def make_segment(iteration: int) -> Segment:
    generator = torch.Generator().manual_seed(iteration)
    return Segment(
        iteration=iteration,
        latents=torch.randn(16, 4, 4, 4, generator=generator),
        states=np.full((16, 13), iteration, np.float32),
        actions=np.zeros((16, 4), np.float32),
        decoded={},
    )


def require_whole(out: Path, at_least: int) -> None:
    """Readable to the end, and a row for each frame."""
    frames = count_frames(out)
    assert frames >= at_least
    assert len(list(read_video(out))) == read_rows(out).num_rows == frames
    assert read_rows(out)["iteration"].to_pylist() == [k // 16 for k in range(frames)]


def put_all(made: StreamedOutput, first: int = 0) -> None:
    for iteration in range(first, PLAN.iterations):
        made.put(make_segment(iteration))


def test_a_slow_disk_holds_the_loop_up_and_nothing_is_lost(tmp_path: Path) -> None:
    out = tmp_path / "a.mp4"
    with output(out) as made:
        made.put(make_segment(0))
        send_signal(made.video._process.pid, signal.SIGSTOP)
        put: list[int] = []
        is_full = threading.Event()

        def produce() -> None:
            for iteration in range(1, 20):
                made.put(make_segment(iteration))
                put.append(iteration)
                if sum(not each.done() for each in made._open) > QUEUED_SEGMENTS:
                    is_full.set()

        producer = threading.Thread(target=produce)
        producer.start()
        assert is_full.wait(DEADLINE_S)
        # the ring of 32 frames, the segment in the thread's hands, the queue, the one being put
        assert len(put) <= 2 + 1 + QUEUED_SEGMENTS + 1
        send_signal(made.video._process.pid, signal.SIGCONT)
        producer.join(DEADLINE_S)
        assert len(put) == 19
        made.finish()
    assert out.with_suffix(".parquet").exists()
    require_whole(out, 320)


def test_a_full_disk_under_the_rows_reaches_the_loop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, flush = tmp_path / "a.mp4", TableWriter.flush
    flushed = []

    def fills_up(self: TableWriter) -> None:
        flushed.append(self)
        if len(flushed) > 3:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        flush(self)

    monkeypatch.setattr(TableWriter, "flush", fills_up)
    with output(out) as made, pytest.raises(RolloutError, match=r"a\.arrows.*No space left"):
        put_all(made)
    require_whole(out, 48)
    assert count_frames(out) == 48


@pytest.mark.usefixtures("in_process_writer")
def test_an_error_of_the_decoder_is_raised_in_the_loop(tmp_path: Path) -> None:
    class Breaks(TinyWorld):
        def decode(self, latents: Tensor) -> Tensor:
            if self.frames_decoded == 20:
                raise RuntimeError("out of memory")
            return super().decode(latents)

    with output(tmp_path / "a.mp4", Breaks()) as made:
        with pytest.raises(RuntimeError, match="out of memory"):
            put_all(made)
        with pytest.raises(RuntimeError, match="out of memory"):
            made.finish()


@pytest.mark.usefixtures("in_process_writer")
def test_a_decoder_that_hangs_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    go_on = threading.Event()

    class Hangs(TinyWorld):
        def decode(self, latents: Tensor) -> Tensor:
            go_on.wait(DEADLINE_S)
            return super().decode(latents)

    monkeypatch.setattr("mavbridge.commands.imagine.STALL_S", 0.0)
    with output(tmp_path / "a.mp4", Hangs()) as made:
        with pytest.raises(HungError, match="no frame"):
            put_all(made)
        go_on.set()
