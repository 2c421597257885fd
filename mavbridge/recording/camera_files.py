"""The files of one camera in a flight's folder: its video and the table of its frames."""

from pathlib import Path

from mavbridge.core.records import VisionTick
from mavbridge.recording.folder import frames_of, video_of
from mavbridge.recording.rows import FrameRow, FrameTruth
from mavbridge.recording.tlog import TlogJob
from mavbridge.recording.video.writer import Pressure, VideoWriter, WriterDiedError


class CameraFiles:
    """Written by a process of their own; one that died costs these frames alone."""

    def __init__(
        self,
        folder: Path,
        camera: str | None,
        *,
        pressure: Pressure,
        hz: float,
        with_truth: bool = False,
        tlog: TlogJob | None = None,
    ) -> None:
        """Start the process; ``camera`` is the name of another camera than the first."""
        self.failure: WriterDiedError | None = None
        """Why no more frames are recorded."""
        self.source_size: tuple[int, int] | None = None
        """Height and width of the frames as they come; None before the first."""
        self._serial = -1
        self._video = VideoWriter(
            folder / video_of(camera),
            pressure=pressure,
            hz=hz,
            rows=folder / frames_of(camera),
            with_truth=with_truth,
            tlog=tlog,
        )

    def write(self, vision: VisionTick, truth: FrameTruth | None) -> None:
        """Record a frame; serial numbers that were left out count as dropped."""
        dropped = vision.serial - self._serial - 1
        self._serial = vision.serial
        if self.failure is not None:
            return
        if self.source_size is None:
            self.source_size = (vision.rgb.shape[0], vision.rgb.shape[1])
        row = FrameRow(
            frame_id=vision.frame_id,
            captured_ns=vision.captured_ns,
            ready_ns=vision.ready_ns,
            dropped_before=dropped,
            truth=truth,
        )
        try:
            self._video.submit(vision.rgb, row)
        except WriterDiedError as error:
            self.failure = error

    @property
    def written(self) -> int:
        """Frames known to be in the video."""
        return self._video.written

    @property
    def dropped(self) -> int:
        """Frames up to the last one that are not in it."""
        return self._serial + 1 - self._video.written

    @property
    def size(self) -> tuple[int, int] | None:
        """Height and width of the video; None before the first frame."""
        return self._video.size

    def finish(self) -> None:
        """Close the files in order, as far as the process lives."""
        if self.failure is not None:
            return
        try:
            self._video.finish()
        except WriterDiedError as error:
            self.failure = error

    def close(self) -> None:
        """Leave the files as they are; may be called twice."""
        self._video.close()
