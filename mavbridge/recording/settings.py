"""``settings.json``: every setting of a recorded flight, so that it can be replayed."""

import json
from dataclasses import asdict, dataclass, fields, is_dataclass
from pathlib import Path
from types import NoneType
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from mavbridge.config.flight import FlyConfig
from mavbridge.core.errors import MavbridgeError
from mavbridge.core.provenance import without_secrets
from mavbridge.recording.folder import SETTINGS
from policy.files import read_json

_T = TypeVar("_T")


class SettingsError(MavbridgeError):
    """The settings of a recorded flight cannot be read."""


@dataclass(frozen=True, kw_only=True)
class ReplaySettings:
    """Flags of a flight, including the defaults of flags that were not given."""

    config: FlyConfig
    wall_offset_ns: int
    """Offset from the clock of all stamps to Unix time, as used in ``link.tlog``."""


def write_settings(folder: Path, settings: ReplaySettings) -> None:
    """Write the file; raise OSError if that fails."""
    text = json.dumps(asdict(settings), indent=2, default=str) + "\n"
    (folder / SETTINGS).write_text(without_secrets(text))


def read_settings(folder: Path) -> ReplaySettings:
    """Read the file; raise SettingsError if it is missing or not of this version."""
    try:
        return _made(ReplaySettings, read_json(folder / SETTINGS))
    except FileNotFoundError as error:
        raise SettingsError(
            f"{folder} has no {SETTINGS}: it was recorded by an older mavbridge, or is no flight "
            "of mavbridge fly --record; such a flight cannot be replayed"
        ) from error
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise SettingsError(
            f"{folder / SETTINGS} is damaged, or of another version: {error}"
        ) from (error)


def _made(cls: type[_T], document: dict[str, Any]) -> _T:
    """Rebuild a dataclass from its ``asdict`` JSON; flags of later versions are ignored."""
    hints = get_type_hints(cls)
    names = [field.name for field in fields(cls) if field.name in document]  # type: ignore[arg-type]
    return cls(**{name: _value(hints[name], document[name]) for name in names})


def _value(hint: Any, value: Any) -> Any:
    if is_dataclass(hint) and isinstance(hint, type):
        return _made(hint, value)
    kinds = get_args(hint)
    if value is None and NoneType in kinds:
        return None
    if hint is Path or Path in kinds:
        return Path(value)
    return tuple(value) if get_origin(hint) is tuple else value
