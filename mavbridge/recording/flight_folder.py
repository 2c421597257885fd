"""Reader of recorded flights, finished or cut off."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mavbridge.core.records import CameraImage, ImageArray
from mavbridge.recording import rows
from mavbridge.recording.folder import (
    FRAMES,
    TICKS,
    FlightError,
    FlightMeta,
    of_camera,
    read_meta,
    video_of,
)
from mavbridge.recording.rows import FrameRow, TickRow, read_frames, read_ticks
from mavbridge.recording.tables import count_lost, read_numbered, read_table, table_exists
from policy.data.flight_video import decode_images, decode_video, with_images
from policy.files import why_unreadable


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
    numbers: tuple[int, ...] = ()
    """Number of each row's image in the video. Numbers are missing where files are damaged."""
    damage: tuple[str, ...] = ()
    """Skipped parts of the flight, in sentences for the user."""

    def tick_rows(self) -> Iterator[TickRow]:
        """Return the ticks as records, with the expert's if it is a demonstration."""
        return read_ticks(self.ticks, self.meta.contract.action)

    def frame_rows(self) -> Iterator[FrameRow]:
        """Return the row of each image."""
        return read_frames(self.frames)

    def images(self) -> Iterator[CameraImage]:
        """Iterate over the images; raise DatasetError if the video is damaged."""
        return decode_images(self.folder / self.video, self.numbers)

    def rgb_images(self) -> Iterator[ImageArray]:
        """Iterate over the images; raise DatasetError if they are depth images, or damaged."""
        return decode_video(self.folder / self.video, self.numbers)


def open_flight(folder: Path, camera: str | None = None) -> RecordedFlight:
    """Read the tables of a flight, with the frames of its first camera or of the named one.

    A flight that was cut off (``meta.finished`` is false) is read up to its last complete batch of
    rows. Frames without a row and rows without a frame are left out.

    Raises:
        MavbridgeError: not a recorded flight, or a damaged one; the message gives the next step.
    """
    meta = read_meta(folder)
    damage: list[str] = []
    ticks = read_table(folder / TICKS, rows.TICKS, optional=rows.DEMONSTRATION_TICKS, damage=damage)
    known = meta.contract.cameras
    if camera is not None and camera not in known:
        raise FlightError(f"{folder} has no camera {camera}: it has {', '.join(known)}")
    other = None if camera == known[0] else camera
    frames, numbers = _frames(folder, meta, other, damage)
    return RecordedFlight(
        folder=folder,
        meta=meta,
        ticks=ticks,
        frames=frames,
        video=video_of(other),
        numbers=numbers,
        damage=tuple(damage),
    )


def open_cameras(folder: Path) -> list[RecordedFlight]:
    """Call ``open_flight`` for each camera of a flight, in the contract's order."""
    first = open_flight(folder)
    return [first, *(open_flight(folder, name) for name in first.meta.contract.cameras[1:])]


def _frames(
    folder: Path, meta: FlightMeta, camera: str | None, damage: list[str]
) -> tuple[Any, tuple[int, ...]]:
    stem, video = of_camera(FRAMES, camera), video_of(camera)
    has_table = table_exists(folder / stem)
    has_video = (folder / video).exists()
    if not (has_table and has_video):
        if meta.finished and meta.frames and (camera is None or has_table or has_video):
            missing = video if has_table else f"{stem}.parquet"
            raise FlightError(
                f"{folder} lacks {missing}, though {meta.frames} frames were recorded: copy the "
                "folder again, whole"
            )
        return rows.FRAMES.empty_table(), ()  # the flight ended before its first frame
    table, numbers = read_numbered(
        folder / stem, rows.FRAMES, optional=rows.DEMONSTRATION_FRAMES, damage=damage
    )
    places, more = with_images(folder / video, numbers, is_whole=meta.finished)
    if meta.finished and len(numbers) and not len(places):
        none = ValueError(f"it holds none of {len(numbers)} images")
        raise FlightError(why_unreadable(folder / video, none))
    damage += more
    numbers = numbers[places]
    return count_lost(table.take(places), numbers), tuple(numbers.tolist())
