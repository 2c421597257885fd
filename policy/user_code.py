"""The boundary to a user's code: an exception there becomes one message with its file and line."""

import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from policy.errors import PolicyError

_OURS = Path(__file__).parent


@contextmanager
def user_code(doing: str) -> Iterator[None]:
    """Turn any exception of a user's policy into a ``PolicyError`` with its file and line.

    Args:
        doing: what was being done, for the message.

    Raises:
        PolicyError: instead of any exception; one that is a PolicyError already passes.
    """
    try:
        yield
    except PolicyError:
        raise
    except Exception as error:
        raise PolicyError(f"{doing}: {type(error).__name__}: {error}{_where(error)}") from error


def _where(error: Exception) -> str:
    frames = traceback.extract_tb(error.__traceback__)
    theirs = [
        frame
        for frame in frames
        if not frame.filename.startswith("<") and _OURS not in Path(frame.filename).parents
    ]
    return f" ({theirs[-1].filename}:{theirs[-1].lineno})" if theirs else ""
