"""File helpers: early checks of output paths, and durable writes."""

import errno
import json
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from mavbridge.core.errors import UserError
from mavbridge.core.reasons import Reason, reason_from_json, reason_to_json

_T = TypeVar("_T")


def require_writable(path: Path | None, flag: str) -> None:
    """Raise UserError if the file that a flag names cannot be written; create its folder.

    ``flag``, such as ``--json``, is named in the message. No empty file is left behind, and a link
    stays. Never blocks; opening a pipe without a reader would.
    """
    if path is None:
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        existed = path.exists()
        os.close(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_NONBLOCK, 0o666))
        if not existed:
            Path(os.path.realpath(path)).unlink()
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
    missing = [folder for folder in wanted if not os.path.exists(folder)]  # noqa: PTH110 - never raises
    try:
        yield
    finally:
        for folder in sorted(missing, key=lambda each: len(each.parts), reverse=True):
            with suppress(OSError):
                folder.rmdir()


_NOT_REPLACED = (errno.EACCES, errno.EBUSY, errno.EPERM, errno.EROFS)
"""Errors on replacing a file that may be writable all the same."""
_NO_FOLDER = (errno.EACCES, errno.EINVAL)
"""Errors of a folder that cannot be read, or on a file system that writes no folders to the disk
(those that virtual machines share)."""


def write_output(path: Path, text: str, flag: str) -> None:
    """Write the file that a flag names, durably where it can be replaced.

    A link such as /dev/stdout, a device or pipe, a mounted file, and a file in a read-only folder
    are written in place. Raises UserError if that fails.
    """
    is_plain = not path.is_symlink() and (path.is_file() or not path.exists())
    try:
        if is_plain:
            path.parent.mkdir(parents=True, exist_ok=True)
            try:
                write_durably(path, text)
                return
            except OSError as error:
                if error.errno not in _NOT_REPLACED:
                    raise
        path.write_text(text, encoding="utf-8", errors="backslashreplace")
    except OSError as error:
        raise UserError(
            f"cannot write {flag} {path}: {error.strerror or error}; make room there, or name "
            "another file"
        ) from error


def as_json(document: object) -> str:
    """Return the text of a JSON file; dataclasses, reasons and paths may be anywhere in it."""
    return json.dumps(document, indent=2, allow_nan=False, default=_plain) + "\n"


def _plain(value: object) -> object:
    if isinstance(value, Reason):
        return reason_to_json(value)
    if is_dataclass(value):
        return {field.name: getattr(value, field.name) for field in fields(value)}
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{value!r} has no form in JSON")


def from_json(cls: type[_T], document: object) -> _T:
    """Rebuild a dataclass from the JSON of ``as_json``; keys of later versions are ignored.

    Raises:
        KeyError, TypeError, ValueError: a key is missing, or a value is not of its field's type.
    """
    if not isinstance(document, dict):
        raise TypeError(f"{document!r} is no object")
    hints = get_type_hints(cls)
    names = [field.name for field in fields(cls) if field.name in document]  # type: ignore[arg-type]
    return cls(**{name: _typed(name, hints[name], document[name]) for name in names})


def _typed(name: str, hint: Any, value: Any) -> Any:
    """Convert a value of JSON to the type of its field; raise TypeError if it has another one."""
    kinds, container = get_args(hint) or (hint,), get_origin(hint)
    if container is tuple:
        return tuple(_typed(name, kinds[0], each) for each in _typed(name, list, value))
    if container is dict:
        return {
            key: _typed(name, kinds[1], each) for key, each in _typed(name, dict, value).items()
        }
    if isinstance(value, dict):
        if Reason in kinds:
            return reason_from_json(value)
        for kind in kinds:
            if own := getattr(kind, "from_json", None):  # of text, with versions
                return own(json.dumps(value))
            if isinstance(kind, type) and is_dataclass(kind):
                return from_json(kind, value)
    if Path in kinds and isinstance(value, str):
        return Path(value)
    is_choice = container is Literal and value in kinds
    if is_choice or type(value) in kinds or (type(value) is int and float in kinds):
        return value
    wanted = " or ".join(str(getattr(kind, "__name__", kind)) for kind in kinds)
    raise TypeError(f"{name} is {value!r}, not {wanted}")


def write_durably(path: Path, text: str) -> None:
    """Replace a file atomically and durably, in a folder that is there.

    A failure or a loss of power leaves the old or the new content, and a failure no other file.

    Raises:
        OSError: the file cannot be written.
    """
    temporary = path.with_suffix(f".{os.getpid()}-{threading.get_native_id()}")
    temporary.unlink(missing_ok=True)  # left by a loss of power, or a stranger's link
    try:
        with temporary.open("x", encoding="utf-8", errors="backslashreplace") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    try:
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    except OSError as error:
        if error.errno not in _NO_FOLDER:
            raise
