"""File helpers: early checks of output paths, and durable writes."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from mavbridge.core.errors import UserError


def require_writable(path: Path | None, flag: str) -> None:
    """Raise UserError if the file that a flag names cannot be written; create its folder.

    ``flag``, such as ``--json``, is named in the message. No empty file is left behind.
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


@contextmanager
def empty_folders_removed(*folders: Path | None) -> Iterator[None]:
    """Context manager: remove empty folders created inside the block, these and their parents.

    A start that failed leaves nothing behind.
    """
    wanted = {each for folder in folders if folder for each in (folder, *folder.parents)}
    missing = [folder for folder in wanted if not folder.exists()]
    try:
        yield
    finally:
        for folder in sorted(missing, key=lambda each: len(each.parts), reverse=True):
            with suppress(OSError):
                folder.rmdir()


def write_durably(path: Path, text: str) -> None:
    """Replace a file atomically and durably: a loss of power leaves the old or the new content.

    Raises:
        OSError: the file cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(f".{os.getpid()}")
    with temporary.open("w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
