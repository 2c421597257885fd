"""The folder of a recorded flight (docs/formats.md): names of its files, and ``meta.json``.

Written by ``mavbridge.recording``. Imports no extra.
"""

from pathlib import Path
from typing import Any

from policy.errors import DatasetError
from policy.files import read_json

META = "meta.json"
TICKS = "ticks"
FRAMES = "frames"
"""Stems of the tables: .arrows while they grow, .parquet once they are complete."""
TLOG = "link.tlog"
SOLVES, PACKETS, FEATURES = "solves", "packets", "features"
"""Stems of the tables for a replay."""
SETTINGS = "settings.json"
FORMAT = "mavbridge-flight"
VERSION = 1


def of_camera(stem: str, camera: str | None) -> str:
    """Return the stem of a file or table of the first camera (None), or of the named one."""
    return stem if camera is None else f"{stem}_{camera}"


def video_of(camera: str | None) -> str:
    """Return the file name of a camera's video."""
    return of_camera("camera", camera) + ".mp4"


def table_file(stem: Path) -> Path:
    """Return the file of a table: the complete one if it exists, else the one that grows."""
    parquet = stem.with_suffix(".parquet")
    return parquet if parquet.exists() else stem.with_suffix(".arrows")


def read_meta_document(folder: Path) -> dict[str, Any]:
    """Read ``meta.json``; raise DatasetError if it is missing, or not of this format."""
    try:
        if odd := [each.name for each in folder.iterdir() if not (each.is_file() or each.is_dir())]:
            raise DatasetError(f"{folder / odd[0]} is neither a file nor a folder: leave it out")
        document: Any = read_json(folder / META)
    except (FileNotFoundError, NotADirectoryError) as error:
        raise DatasetError(_unreadable(folder)) from error
    except OSError as error:
        raise DatasetError(f"{error.filename} cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise DatasetError(f"{folder / META} is not JSON: {error}") from error
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise DatasetError(f"{folder / META} is not of a recorded flight: no format {FORMAT!r}")
    if document.get("version") != VERSION:
        raise DatasetError(
            f"{folder} has version {document.get('version')} of the format, this build reads "
            f"{VERSION}: use the mavbridge that recorded it"
        )
    return document


def _unreadable(folder: Path) -> str:
    if not folder.exists():
        return f"there is no folder {folder}: name one that mavbridge --record made"
    if not folder.is_dir():
        return f"{folder} is a file: a recorded flight is a folder, made by mavbridge --record"
    inside = sorted(entry.name for entry in folder.iterdir())
    if not inside:
        return f"{folder} is empty: nothing was recorded there"
    if flights := sorted(folder.glob(f"*/{META}")):
        return f"{folder} holds flights, and is none: name one of them ({flights[0].parent})"
    return (
        f"{folder} is no recorded flight: it has no {META} (it has {', '.join(inside[:3])}); "
        "mavbridge --record makes one"
    )
