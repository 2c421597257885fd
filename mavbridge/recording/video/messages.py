"""What the producer of frames and the writer process say to each other over their pipe."""

from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

from mavbridge.recording.rows import FrameRow
from mavbridge.recording.video.ring import RingShape


@dataclass(frozen=True, slots=True, kw_only=True)
class VideoJob:
    """What the writer process is started for."""

    video: Path
    """Fragmented MP4; must not exist."""
    rows: Path | None
    """Folder and stem of the frames table, or None: only a video."""
    with_truth: bool
    """The table has the columns of ``FrameTruth``."""
    hz: float
    """Nominal frame rate."""
    yield_cpu: bool
    """Whoever else wants the processor comes first."""


@dataclass(frozen=True, slots=True)
class Open:
    """To the writer: the frames will lie here."""

    shape: RingShape


@dataclass(frozen=True, slots=True)
class Submit:
    """To the writer: this slot holds a frame."""

    slot: int
    row: FrameRow


@dataclass(frozen=True, slots=True)
class Finish:
    """To the writer: that was all."""


@dataclass(frozen=True, slots=True)
class Ready:
    """From the writer: it runs."""


@dataclass(frozen=True, slots=True)
class Opened:
    """From the writer: it has the memory mapped; the name is not needed any more."""


@dataclass(frozen=True, slots=True)
class Written:
    """From the writer: the frame of this slot is in the file; the slot is free."""

    slot: int


@dataclass(frozen=True, slots=True)
class Failed:
    """From the writer: it cannot go on; it closes what it has, and ends."""

    reason: str


@dataclass(frozen=True, slots=True)
class Done:
    """From the writer: everything is closed."""


ToWriter: TypeAlias = Open | Submit | Finish
FromWriter: TypeAlias = Ready | Opened | Written | Failed | Done
