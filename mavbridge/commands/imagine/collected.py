"""The plain form, kept as the reference: all frames in a list, everything written at the end."""

from collections.abc import Callable
from pathlib import Path

from mavbridge.commands.imagine.files import RolloutError, RowsWriter, rollout_frames
from mavbridge.commands.imagine.loop import Segment
from mavbridge.commands.imagine.output import FrameDigest, OnFrame, frame_row
from mavbridge.commands.imagine.plan import RolloutPlan
from mavbridge.commands.imagine.sampling import Sampler
from mavbridge.core.clock import Clock
from mavbridge.core.records import ImageArray, RolloutFrame
from mavbridge.recording.video.file import WRITE_ERRORS, FragmentedMp4


class CollectedOutput:
    """See ``Output``; every segment's frames must have been decoded by the loop."""

    frames_decoded = decode_queue = 0

    def __init__(
        self,
        out: Path,
        sampler: Sampler,
        plan: RolloutPlan,
        *,
        decode_video: bool,
        clock: Clock,
        on_frame: OnFrame,
    ) -> None:
        """As ``StreamedOutput``; creates nothing yet."""
        self._out = out
        self._plan = plan
        self._frame_dt_s = sampler.config.frame_dt_s
        self._size = sampler.config.image_size
        self._meter = sampler.meter
        self._decode_video = decode_video
        self._clock = clock
        self._on_frame = on_frame
        self._digest = FrameDigest()
        self._collected: list[tuple[RolloutFrame, ImageArray]] = []
        self._written = 0

    @property
    def frames(self) -> int:
        """Frames that have left the decoder."""
        return len(self._collected)

    @property
    def writer_queue(self) -> int:
        """Frames that wait to be written."""
        return len(self._collected) - self._written

    @property
    def writer_pid(self) -> int | None:
        """There is none."""
        return None

    @property
    def sha256(self) -> str:
        """Of all frames so far, raw, in their order."""
        return self._digest.hexdigest()

    def put(self, segment: Segment) -> None:
        """Keep a segment."""
        for frame in rollout_frames(segment, self._plan, self._frame_dt_s):
            rgb = segment.decoded[frame.frame]
            self._collected.append((frame, rgb))
            if self._decode_video:
                self._digest.add(rgb)
            self._on_frame(frame, rgb if self._decode_video else None)

    def finish(self, on_wait: Callable[[], None] = lambda: None) -> None:
        """Write everything.

        Raises:
            RolloutError: it could not all be written.
        """
        with self._meter.write:
            rows = RowsWriter(self._out)
            try:
                rows.append([frame for frame, _ in self._collected])
                if self._decode_video:
                    self._write_video(on_wait)
            except BaseException:
                rows.abandon()
                raise
            rows.finish()

    def _write_video(self, on_wait: Callable[[], None]) -> None:
        size = self._size
        try:
            video = FragmentedMp4(self._out, height=size, width=size, hz=1 / self._frame_dt_s)
            try:
                for frame, rgb in self._collected:
                    captured_ns = frame_row(frame, self._clock).captured_ns
                    video.append(rgb, captured_ns)
                    self._written += 1
                    on_wait()
            finally:
                video.close()
        except WRITE_ERRORS as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise RolloutError(f"{self._out} cannot be written: {reason}") from error

    def close(self) -> None:
        """Nothing is open between two calls."""
