"""The root of every expected error, those of policies, and notes that warn.

``mavbridge.core.errors`` has the rest. They lie here because ``policy`` imports nothing of
``mavbridge``.
"""

import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_OURS = Path(__file__).parent
_WARNING = "warning: "


class MavbridgeError(Exception):
    """Base of all expected errors; printed without a traceback."""

    exit_code: int = 2
    """Status with which the process ends; ``mavbridge.core.errors`` says what each means."""


class PolicyError(MavbridgeError):
    """A policy, contract, checkpoint or dataset that cannot be used; says what to do."""


class ContractError(PolicyError):
    """A contract that is malformed or that the bridge cannot keep."""


class CheckpointError(PolicyError):
    """A checkpoint that cannot be read, or does not fit; the message says what to do."""


class NoChunkError(PolicyError):
    """A policy that has no chunk for this state, and may have one for the next.

    The flight goes on by the last chunk for as long as its limits permit. The message is the reason
    that the user is shown.
    """


class Warned(str):
    """A note that something is not as it was asked for."""

    __slots__ = ()

    @property
    def text(self) -> str:
        """The note without the word in front."""
        return self[len(_WARNING) :]


class Agreed(str):
    """A note that the engine computes what torch computes."""

    __slots__ = ()


def warned(text: str) -> Warned:
    """Return a warning, shown with that word in front."""
    return Warned(_WARNING + text)


@contextmanager
def user_code(doing: str) -> Iterator[None]:
    """Turn any exception of a user's policy into a ``PolicyError`` with its file and line.

    The message begins with ``doing``; an exception that is a ``PolicyError`` already passes. A
    ``sys.exit`` is one as well: it would end the flight silently, with a status of its own.
    """
    try:
        yield
    except PolicyError:
        raise
    except (Exception, SystemExit) as error:
        theirs = [
            frame
            for frame in traceback.extract_tb(error.__traceback__)
            if not frame.filename.startswith("<") and _OURS not in Path(frame.filename).parents
        ]
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        told = lines[-1] if "Traceback" in str(error) else " ".join(lines)
        where = f" ({theirs[-1].filename}:{theirs[-1].lineno})" if theirs else ""
        raise PolicyError(f"{doing}: {type(error).__name__}: {told}{where}") from error
