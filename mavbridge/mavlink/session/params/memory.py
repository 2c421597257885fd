"""Remembers on disk which parameters the bridge has changed, for after a crash."""

import json
from pathlib import Path
from typing import NamedTuple

from mavbridge.core.errors import UserError
from mavbridge.core.files import sync_folder, write_durably
from mavbridge.mavlink.session.params.writer import is_same

_MOST_OURS = 8


class Changed(NamedTuple):
    """A parameter that the bridge has set, or was about to set."""

    before: float
    """Value to put back."""
    ours: tuple[float, ...]
    """Values that the bridge has set since, the newest last: after a crash, each is possible."""

    def is_ours(self, value: float) -> bool:
        """True if the bridge may have set this value."""
        return any(is_same(value, ours) for ours in self.ours)

    def then(self, value: float) -> "Changed":
        """The record before ``value`` is set."""
        earlier = tuple(other for other in self.ours if other != value)
        return Changed(self.before, (*earlier, value)[-_MOST_OURS:])


class ParamMemory:
    """A small JSON file; absent while nothing is changed.

    Raises UserError from every method if the file cannot be read or written.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def load(self) -> dict[str, Changed]:
        """The parameters that are changed, by name."""
        try:
            text = self.path.read_text(encoding="utf-8")
        except FileNotFoundError:
            return {}
        except (OSError, UnicodeDecodeError) as error:
            raise self._damaged(str(error)) from error
        try:
            return {
                str(name): Changed(
                    float(changed["before"]), tuple(float(value) for value in changed["ours"])
                )
                for name, changed in json.loads(text)["parameters"].items()
            }
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise self._damaged(f"{type(error).__name__} {error}") from error

    def _damaged(self, reason: str) -> UserError:
        return UserError(
            f"cannot read {self.path}, which holds parameters to put back: {reason}; note what you "
            "can read in it, set those by hand, and remove the file"
        )

    def save(self, changed: dict[str, Changed]) -> None:
        """Replace the file at once and on the disk itself; no entry: remove it."""
        try:
            if changed:
                entries = {name: change._asdict() for name, change in changed.items()}
                write_durably(self.path, json.dumps({"parameters": entries}, indent=2))
            elif self.path.exists():
                self.path.unlink()
                sync_folder(self.path.parent)
        except OSError as error:
            raise UserError(
                f"cannot remember changed parameters in {self.path}: {error.strerror}; make its "
                "folder writable, or name another one by XDG_STATE_HOME"
            ) from error
