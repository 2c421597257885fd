"""Reads JSON and TOML of strangers: what the parsers cannot take is a ``ValueError``, too."""

import errno
import json
import os
import stat
import tomllib
from pathlib import Path
from typing import Any, BinaryIO

MAX_TOML_BYTES = 64 * 1024
MAX_TOML_LINE = 2_000
"""Characters. Memory and time of ``tomllib`` grow with the square of the dots in a key, which has
to end with its line: 200 kB of ``a.a.a`` took more than 10 GB."""


def open_regular(path: Path) -> BinaryIO:
    """Open a file for reading without ever waiting: a pipe without a writer has no end of it.

    Raises:
        OSError: it cannot be opened, or is a pipe, a device or a folder.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(errno.EINVAL, "it is a folder, a pipe or a device, not a file", str(path))
    return os.fdopen(descriptor, "rb")


def parse_json(text: str) -> Any:
    """The value of a text; raises ValueError, also where it is nested too deeply."""
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


def read_toml(path: Path) -> dict[str, Any]:
    """The tables of a file of settings, which people write: it is not large.

    Raises:
        OSError: it cannot be read.
        ValueError: not TOML, nested too deeply, or larger than MAX_TOML_BYTES or a line longer
            than MAX_TOML_LINE.
    """
    with open_regular(path) as file:
        data = file.read(MAX_TOML_BYTES + 1)
    if len(data) > MAX_TOML_BYTES:
        raise ValueError(f"it is larger than {MAX_TOML_BYTES // 1024} KiB")
    text = data.decode()
    if (longest := max(map(len, text.split("\n")))) > MAX_TOML_LINE:
        raise ValueError(
            f"a line of it has {longest} characters, and may have {MAX_TOML_LINE}: write a long "
            "list over several lines"
        )
    try:
        return tomllib.loads(text)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error
