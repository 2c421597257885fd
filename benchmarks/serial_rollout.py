"""The plain form of ``mavbridge imagine``, to compare with: everything is written at the end."""

import queue
from collections.abc import Callable
from contextlib import closing

from mavbridge.commands.imagine.loop import Segment
from mavbridge.commands.imagine.output import (
    SCHEMA,
    StreamedOutput,
    captured_ns,
    rows_batch,
    writing,
)
from mavbridge.core.records import ImageArray, RolloutFrame
from mavbridge.recording.tables import TableWriter
from mavbridge.recording.video.file import FragmentedMp4


class SerialOutput(StreamedOutput):
    """The plain form, kept as the reference: all frames in a list, everything written at the end.

    Every frame must have been decoded by the loop.
    """

    def _open(self) -> None:
        self._jobs = queue.Queue(1)  # nothing runs beside the loop
        self._collected: list[tuple[RolloutFrame, ImageArray]] = []
        self._written = 0

    @property
    def writer_queue(self) -> int:
        """Frames that wait to be written."""
        return len(self._collected) - self._written

    def put(self, segment: Segment) -> None:
        """Keep a segment."""
        for frame in self._rows(segment):
            rgb = segment.decoded[frame.frame]
            self._collected.append((frame, rgb))
            self._show(frame, rgb)

    def finish(self, on_wait: Callable[[], None] = lambda: None) -> None:
        """Write everything."""
        with self._sampler.meter.write, writing(self.out):
            table = TableWriter(self.out, SCHEMA)
            try:
                table.append(rows_batch([frame for frame, _ in self._collected]))
                size = self._sampler.config.image_size
                with closing(
                    FragmentedMp4(self.out, height=size, width=size, hz=1 / self._frame_dt_s)
                ) as video:
                    for frame, rgb in self._collected:
                        video.append(rgb, captured_ns(frame))
                        self._written += 1
                        on_wait()
            except BaseException:
                table.abandon()
                raise
            table.finish()

    def close(self) -> None:
        """Nothing is open between two calls."""
