"""Reader of recorded flights, finished or cut off."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mavbridge.core.records import CameraImage, ImageArray
from mavbridge.recording.folder import FlightMeta, read_meta
from mavbridge.recording.rows import FrameRow, TickRow, read_frame_rows, read_ticks
from policy.data.flight_files import TICKS, video_of
from policy.data.flight_video import decode_images, decode_video, read_frames
from policy.data.tables import (
    EXPERT_COLUMN,
    FRAME_COLUMNS,
    TICK_COLUMNS,
    TRUTH_COLUMNS,
    read_table,
)
from policy.errors import DatasetError


@dataclass(frozen=True, kw_only=True)
class RecordedFlight:
    """One recorded flight. Row k of ``frames`` always belongs to the k-th of ``images``."""

    folder: Path
    meta: FlightMeta
    ticks: Any
    """``pyarrow.Table`` with the columns of docs/formats.md."""
    frames: Any
    """``pyarrow.Table`` with one row per image."""
    video: str = video_of(None)
    """File name of the video."""
    damage: tuple[str, ...] = ()
    """Lost parts of the flight, in sentences for the user."""

    def tick_rows(self) -> Iterator[TickRow]:
        """Return the ticks as records, with the expert's if it is a demonstration."""
        return read_ticks(self.ticks, self.meta.contract.action)

    def frame_rows(self) -> Iterator[FrameRow]:
        """Return the row of each image."""
        return read_frame_rows(self.frames)

    def images(self) -> Iterator[CameraImage]:
        """Iterate over the images; raise DatasetError if the video is damaged."""
        return decode_images(self.folder / self.video, self.frames.num_rows)

    def rgb_images(self) -> Iterator[ImageArray]:
        """Iterate over the images; raise DatasetError if they are depth images, or damaged."""
        return decode_video(self.folder / self.video, self.frames.num_rows)


def open_flight(folder: Path, camera: str | None = None) -> RecordedFlight:
    """Read the tables of a flight, with the frames of its first camera or of the named one.

    A flight that was cut off (``meta.finished`` is false) or damaged is read up to there. Frames
    without a row and rows without a frame are left out.

    Raises:
        MavbridgeError: not a recorded flight, or a damaged one; the message gives the next step.
    """
    meta = read_meta(folder)
    damage: list[str] = []
    ticks = read_table(folder / TICKS, TICK_COLUMNS, optional=[EXPERT_COLUMN], damage=damage)
    known = meta.contract.cameras
    if camera is not None and camera not in known:
        raise DatasetError(f"{folder} has no camera {camera}: it has {', '.join(known)}")
    other = None if camera == known[0] else camera
    frames = read_frames(
        *(folder, other, FRAME_COLUMNS),
        optional=TRUTH_COLUMNS,
        recorded=meta.frames if meta.finished else None,
        damage=damage,
    )
    return RecordedFlight(
        folder=folder,
        meta=meta,
        ticks=ticks,
        frames=frames,
        video=video_of(other),
        damage=tuple(damage),
    )


def open_cameras(folder: Path) -> list[RecordedFlight]:
    """Call ``open_flight`` for each camera of a flight, in the contract's order."""
    first = open_flight(folder)
    return [first, *(open_flight(folder, name) for name in first.meta.contract.cameras[1:])]
