"""Access to files that users name: paths, text encodings, damage, JSON and TOML."""

import codecs
import errno
import json
import os
import re
import stat
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from safetensors import SafetensorError, safe_open

from policy.errors import CheckpointError, PolicyError

CONTRACT_FILE = "mavbridge.toml"
"""File name of a contract beside a policy or dataset, where flights find it without --contract."""
UNANSWERED = "?"
"""Value in a contract file that the user has to replace."""
MAX_TEXT_BYTES = 100_000_000
MAX_TOML_BYTES = 64 * 1024
MAX_TOML_LINE = 2_000
"""Longest line [characters]. Time and memory of ``tomllib`` grow with the square of the dots in a
key, and a key ends with its line: 200 kB of ``a.a.a`` took more than 10 GB."""
_HEAD_BYTES = 4096
_HUGE = re.compile(r"(?:\d_?){309}")
"""Matches integers that no float can hold; each reader would have to catch its OverflowError."""
_WIDE_MARKS = (codecs.BOM_UTF32_LE, codecs.BOM_UTF32_BE, codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)


def user_path(name: str | Path) -> Path:
    """Return the path of a user's flag or setting, with ``~`` expanded."""
    try:
        return Path(name).expanduser()
    except RuntimeError:  # ~ of an unknown account: a file may have that name
        return Path(name)


def library_name(path: Path) -> str:
    """Return an absolute path: FFmpeg and Arrow mistake ``10:30.mp4`` for an address.

    Raises:
        PolicyError: it is not UTF-8; OpenCV crashes on such a path.
    """
    name = os.path.abspath(path)  # noqa: PTH100 - Path.absolute keeps ".."
    try:
        name.encode()
    except UnicodeEncodeError as error:
        raise PolicyError(
            f"{path}: its name, or that of a folder above it, is not UTF-8: rename it"
        ) from error
    return name


def open_regular(path: Path) -> BinaryIO:
    """Open a regular file for reading. Never blocks; a pipe without a writer would.

    Raises:
        OSError: it cannot be opened, or is a pipe, a device or a folder.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(errno.EINVAL, "it is a folder, a pipe or a device, not a file", str(path))
    return os.fdopen(descriptor, "rb")


def stand_in(path: Path) -> tuple[str, str] | None:
    """Return the actual content of an unusable file and the remedy, as ``stand_in_of``, or None."""
    try:
        with open_regular(path) as file:
            return stand_in_of(file.read(_HEAD_BYTES))
    except OSError:
        return None


def stand_in_of(head: bytes) -> tuple[str, str] | None:
    """Return a foreign file's real content, known by its first bytes, and the remedy; else None.

    Recognises empty files, Git LFS pointers, text in UTF-16 or UTF-32, and web pages saved under a
    file's name.
    """
    if head.startswith(_WIDE_MARKS):
        return "text in UTF-16 or UTF-32", "save it as UTF-8"
    start = head[:_HEAD_BYTES].lstrip().lower()
    if not start:
        return "empty, or cut short", "copy it again"
    if start.startswith(b"version https://git-lfs.github.com/"):
        return "a pointer of Git LFS, not the file itself", "fetch it with `git lfs pull`"
    if start.startswith((b"<!doctype html", b"<html")):
        return (
            "a web page, not the file itself",
            "download it again, by the link to the file itself, logged in where that is needed",
        )
    return None


def last_line(said: str | Exception) -> str:
    """Return the last line of a text or an error; the error's type if that is empty."""
    lines = [line.strip() for line in str(said).splitlines() if line.strip()]
    nothing = "(nothing)" if isinstance(said, str) else type(said).__name__
    return lines[-1][:300] if lines else nothing


def why_unreadable(path: Path, error: Exception, kind: str = "") -> str:
    """Return why a library could not read a file: its real content, or one line of the error.

    ``kind`` is the expected format.
    """
    try:
        open_regular(path).close()  # safetensors calls a forbidden file missing
    except OSError as failure:
        return f"{path}: {str(failure.strerror).lower()}"
    if (found := stand_in(path)) is not None:
        what, advice = found
        return f"{path} is {what}: {advice}"
    expected = f" as {kind}" if kind else ""
    return (
        f"{path} cannot be read{expected} ({last_line(error)}); it may be damaged or cut short: "
        "copy it again"
    )


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield the path of an empty draft; on success it replaces ``path``, else it is deleted.

    The file has the permissions of the umask: safetensors makes files that only the owner can read.
    """
    draft = path.with_name(f"{path.name}.{os.getpid()}.partial")
    try:
        draft.touch()
        mode = stat.S_IMODE(draft.stat().st_mode)
        yield draft
        draft.chmod(mode)
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)


@contextmanager
def open_safetensors(path: Path, framework: str) -> Iterator[Any]:
    """Open a safetensors file; raise CheckpointError if it is damaged, also during later reads."""
    try:
        with safe_open(library_name(path), framework=framework) as file:
            yield file
    except (TypeError, AttributeError) as error:  # NumPy has no bfloat16 and no float8
        raise CheckpointError(
            f"{path} holds numbers of a type that {framework} lacks ({error}): save them as float32"
        ) from error
    except (OSError, SafetensorError) as error:
        raise CheckpointError(why_unreadable(path, error)) from error


def read_text(path: Path, max_bytes: int = MAX_TEXT_BYTES) -> str:
    """Read a UTF-8 text file, with or without a byte order mark.

    Raises:
        OSError: it cannot be opened.
        ValueError: it is not UTF-8, or larger than ``max_bytes``; the message names its
            content.
    """
    with open_regular(path) as file:
        data = file.read(max_bytes + 1)
    if len(data) > max_bytes:
        raise ValueError(f"it is larger than {max_bytes // 1024} KiB")
    return decode_text(data)


def decode_text(data: bytes) -> str:
    """Decode UTF-8 text, with or without a byte order mark; raise ValueError as ``read_text``."""
    if data.strip() and (found := stand_in_of(data)) is not None:
        raise ValueError(f"it is {found[0]}: {found[1]}")
    if b"\0" in data:
        raise ValueError(
            "it holds zero bytes, as UTF-16 or after a loss of power: save it as UTF-8"
        )
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise ValueError(f"it is not UTF-8 text (line {line}): save it as UTF-8") from error


def _require_small_numbers(text: str) -> None:
    if (found := _HUGE.search(text)) is not None:
        line = text.count("\n", 0, found.start()) + 1
        raise ValueError(f"a number in it has more than 308 digits (line {line})")


def parse_json(text: str) -> Any:
    """Parse JSON; raise ValueError for deep nesting and integers that no float can hold, too."""
    _require_small_numbers(text)
    if not text.strip():
        raise ValueError("it is empty, or cut short")
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


def parse_object(text: str, error: type[PolicyError], what: str) -> dict[str, Any]:
    """Parse a JSON object; raise ``error``, which names it as ``what``, for anything else."""
    try:
        data = parse_json(text)
    except ValueError as failure:
        raise error(f"{what} is not JSON: {failure}") from failure
    if not isinstance(data, dict):
        raise error(f"{what} is not a JSON object")
    return data


def read_json(path: Path) -> Any:
    """Read a JSON file; raise OSError, or ValueError as ``read_text`` and ``parse_json``."""
    return parse_json(read_text(path))


def read_object(path: Path, error: type[PolicyError], kind: str) -> dict[str, Any]:
    """Read a JSON object in a folder of this ``kind``; raise ``error`` if there is none."""
    try:
        return parse_object(read_text(path), error, str(path))
    except OSError as failure:
        raise error(f"{path}: {failure.strerror}: is it a {kind}?") from failure
    except ValueError as failure:
        raise error(f"{path} is not JSON: {failure}") from failure


def read_toml(path: Path) -> dict[str, Any]:
    """Read TOML that a person wrote.

    Raises:
        OSError: it cannot be opened.
        ValueError: not UTF-8, larger than MAX_TOML_BYTES, a line longer than MAX_TOML_LINE, not
            TOML, nested too deeply, or with an integer that no float can hold.
    """
    text = read_text(path, MAX_TOML_BYTES)
    if (longest := max(map(len, text.split("\n")))) > MAX_TOML_LINE:
        raise ValueError(
            f"a line of it has {longest} characters, and may have {MAX_TOML_LINE}: write a long "
            "list over several lines"
        )
    _require_small_numbers(text)
    try:
        return tomllib.loads(text)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error
