"""``settings.json``: every setting of a recorded flight, so that it can be replayed."""

from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from mavbridge.config.flight import FlyConfig
from mavbridge.core.files import as_json
from mavbridge.core.provenance import without_secrets
from mavbridge.recording.folder import SETTINGS, FlightError
from policy.files import read_json

_T = TypeVar("_T")


@dataclass(frozen=True, kw_only=True)
class ReplaySettings:
    """Flags of a flight, including the defaults of flags that were not given."""

    config: FlyConfig
    wall_offset_ns: int
    """Offset from the clock of all stamps to Unix time, as used in ``link.tlog``."""


def write_settings(folder: Path, settings: ReplaySettings) -> None:
    """Write the file; raise OSError if that fails."""
    (folder / SETTINGS).write_text(without_secrets(as_json(settings)))


def read_settings(folder: Path) -> ReplaySettings:
    """Read the file; raise FlightError if it is missing or not of this version."""
    try:
        return _made(ReplaySettings, read_json(folder / SETTINGS))
    except FileNotFoundError as error:
        raise FlightError(
            f"{folder} has no {SETTINGS}: it was recorded by an older mavbridge, or is no flight "
            "of mavbridge fly --record; such a flight cannot be replayed"
        ) from error
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise FlightError(
            f"{folder / SETTINGS} is damaged, or of another version: {error}"
        ) from error


def _made(cls: type[_T], document: dict[str, Any]) -> _T:
    """Rebuild a dataclass from its ``asdict`` JSON; flags of later versions are ignored."""
    hints = get_type_hints(cls)
    names = [field.name for field in fields(cls) if field.name in document]  # type: ignore[arg-type]
    return cls(**{name: _value(hints[name], document[name]) for name in names})


def _value(hint: Any, value: Any) -> Any:
    """Convert a value of JSON to the type of its field; raise TypeError if it has another one."""
    if is_dataclass(hint) and isinstance(hint, type):
        return _made(hint, value)
    kinds = get_args(hint) or (hint,)
    if get_origin(hint) is tuple:
        return tuple(_value(kinds[0], each) for each in _value(list, value))
    if Path in kinds and isinstance(value, str):
        return Path(value)
    is_choice = get_origin(hint) is Literal and value in kinds
    if is_choice or type(value) in kinds or (type(value) is int and float in kinds):
        return value
    raise TypeError(f"{value!r} is no {hint}")
