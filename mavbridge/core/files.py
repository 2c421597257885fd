"""Files that a command will write at its end, checked at its start."""

from pathlib import Path

from mavbridge.core.errors import UserError


def require_writable(path: Path | None, flag: str) -> None:
    """Refuse an output file that cannot be written, before a long run; creates its folder.

    Args:
        path: the file, which is not left behind; None where the flag was not given.
        flag: its name on the command line, such as ``--json``.

    Raises:
        UserError: the file cannot be written.
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
