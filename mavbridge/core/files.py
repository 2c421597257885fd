"""Files that a command will write at its end, checked at its start."""

from pathlib import Path

from mavbridge.core.errors import UserError


def require_writable(path: Path, flag: str) -> None:
    """Make sure that ``path`` can be written, making its folder; leaves no file behind.

    Raises:
        UserError: it cannot; the message names ``flag``.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        existed = path.exists()
        path.open("ab").close()
        if not existed:
            path.unlink()
    except OSError as error:
        raise UserError(
            f"{flag} {path} cannot be written ({error.strerror}): name a file in a folder that "
            "you may write to"
        ) from error
