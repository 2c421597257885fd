"""Files that a command will write at its end, checked at its start."""

from pathlib import Path

from mavbridge.core.errors import UserError


def require_writable(path: Path | None, flag: str) -> None:
    """Raise UserError if the file that a flag names cannot be written; creates its folder.

    ``flag`` is named in the message, such as ``--json``. An empty file is not left behind.
    """
    if path is None:
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        existed = path.exists()
        path.open("ab").close()
        if not existed:
            path.unlink()
    except OSError as error:
        raise UserError(
            f"cannot write {flag} {path}: {error.strerror}; name a file in a folder that you may "
            "write to"
        ) from error
