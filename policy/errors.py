"""Base class of all expected errors, errors of policies, and notes for the user.

``mavbridge.core.errors`` has the rest. These are here because ``policy`` imports nothing from
``mavbridge``.
"""

import importlib.util
import sysconfig
import threading
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_OURS = Path(__file__).parent
_LIBRARIES = {Path(sysconfig.get_path(name)) for name in ("stdlib", "purelib", "platlib")}
_WARNING = "warning: "
_INSTALL_NAMES = {"Xlib": "python-xlib"}
"""Names of packages that differ from that of their module."""


class MavbridgeError(Exception):
    """Base class of all expected errors; printed without a traceback."""

    exit_code: int = 2
    """Exit status of the process; ``mavbridge.core.errors`` lists the meanings."""


class PolicyError(MavbridgeError):
    """Unusable policy, contract, checkpoint or dataset; the message names the next step."""


class ContractError(PolicyError):
    """Malformed contract, or contract that the bridge cannot keep."""


class CheckpointError(PolicyError):
    """Checkpoint that cannot be read or does not fit; the message names the next step."""


class DatasetError(PolicyError):
    """Recorded flights or datasets that cannot be used; the message names them and the reason."""


class NothingToLearnError(DatasetError):
    """Flight that adds nothing to others: it is empty or a copy, or nobody flew in it."""


class NoChunkError(PolicyError):
    """The policy has no chunk for this state, but may have one for the next state.

    The flight continues along the last chunk while its limits permit. The user sees the message as
    the reason.
    """


def require_packages(what: str, *modules: str) -> None:
    """Raise MavbridgeError if ``what`` needs a module that is not installed."""
    missing = [name for name in modules if importlib.util.find_spec(name) is None]
    if missing:
        names = " ".join(_INSTALL_NAMES.get(name, name) for name in missing)
        raise MavbridgeError(f"{what} needs {' and '.join(missing)}: pip install {names}")


class Warned(str):
    """Note that something differs from the user's request."""

    __slots__ = ()

    @property
    def text(self) -> str:
        """Text of the note, without the word in front."""
        return self[len(_WARNING) :]


class Agreed(str):
    """Note that the engine's output agrees with torch's."""

    __slots__ = ()


def warned(text: str) -> Warned:
    """Return a warning; it is printed with that word in front."""
    return Warned(_WARNING + text)


@contextmanager
def user_code(doing: str) -> Iterator[None]:
    """Turn any exception of a user's policy into a ``PolicyError`` with its file and line.

    The message begins with ``doing``. A ``PolicyError`` passes unchanged, and so does
    ``KeyboardInterrupt`` on the main thread, which Ctrl-C raises. Any other ``BaseException`` is
    converted too: ``sys.exit`` would end the flight silently, with an arbitrary status.
    """
    try:
        yield
    except PolicyError:
        raise
    except BaseException as error:
        is_main = threading.current_thread() is threading.main_thread()
        if isinstance(error, KeyboardInterrupt) and is_main:
            raise
        said = str(traceback.TracebackException(type(error), error, None))  # its own may raise
        lines = [line.strip() for line in said.splitlines() if line.strip()]
        told = lines[-1] if "Traceback" in said else " ".join(lines)
        raise PolicyError(f"{doing}: {type(error).__name__}: {told}{user_line(error)}") from error


def user_line(error: BaseException) -> str:
    """Return " (file:line)" of the user's innermost line that raised, else of a library's."""
    foreign = [
        frame
        for frame in traceback.extract_tb(error.__traceback__)
        if not frame.filename.startswith("<") and _OURS not in Path(frame.filename).parents
    ]
    theirs = [
        frame for frame in foreign if _LIBRARIES.isdisjoint(Path(frame.filename).parents)
    ] or foreign
    return f" ({theirs[-1].filename}:{theirs[-1].lineno})" if theirs else ""
