"""Names in a flight's folder, and the check that it can be written. Imports no extra."""

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from mavbridge.core.errors import UserError
from mavbridge.core.extras import require_packages

META = "meta.json"
TICKS = "ticks"
FRAMES = "frames"
"""Stems of the tables: .arrows while they grow, .parquet once they are complete."""
VIDEO = "camera.mp4"
TLOG = "link.tlog"
SOLVES, PACKETS, FEATURES = "solves", "packets", "features"
"""Stems of the tables for a replay."""
SETTINGS = "settings.json"
EXTRA = ("av", "pyarrow")
"""Packages of the ``record`` extra; each has the same name for import and installation."""


def video_of(camera: str | None) -> str:
    """Return the video's file name for the first camera, or for the named one."""
    return VIDEO if camera is None else f"camera_{camera}.mp4"


def frames_of(camera: str | None) -> str:
    """Return the stem of a camera's table of frames."""
    return FRAMES if camera is None else f"{FRAMES}_{camera}"


def features_of(camera: str | None) -> str:
    """Return the stem of a camera's table of features."""
    return FEATURES if camera is None else f"{FEATURES}_{camera}"


def require_extra(what: str) -> None:
    """Raise UserError if the extra is not installed. ``what`` is the feature that needs it."""
    require_packages(what, {name: name for name in EXTRA})


def prepare_folder(folder: Path, flag: str) -> None:
    """Create the folder that a flag names and check that a flight can be recorded into it.

    Raises:
        UserError: the extra is not installed, or the folder is not empty or cannot be written.
    """
    require_extra(flag)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        taken = sorted(entry.name for entry in folder.iterdir())
        if not taken:
            probe = folder / META
            probe.open("xb").close()
            probe.unlink()
    except OSError as error:
        raise UserError(
            f"{flag} {folder} cannot be written ({error.strerror}); name a folder that you may "
            "write to"
        ) from error
    if taken:
        raise UserError(
            f"{flag} {folder} is not empty (it holds {taken[0]}); every flight has a folder of "
            "its own: name a new one"
        )


def remove_flight(folder: Path, cameras: Sequence[str]) -> None:
    """Delete the files of a recorded flight; other files, and the folder, stay."""
    names = (None, *cameras[1:])
    stems = (TICKS, SOLVES, PACKETS, *map(frames_of, names), *map(features_of, names))
    tables = (f"{stem}.{ending}" for stem in stems for ending in ("arrows", "parquet"))
    for name in (META, SETTINGS, TLOG, *map(video_of, names), *tables):
        with suppress(OSError):
            (folder / name).unlink(missing_ok=True)
