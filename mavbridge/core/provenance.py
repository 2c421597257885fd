"""Provenance for records and logs: command line, versions, source revision, file digests."""

import hashlib
import platform
import re
import subprocess
import sys
from collections.abc import Iterable
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import mavbridge
from mavbridge.core.processes import IMPORT_ROOT

PACKAGES = (
    *("torch", "openvino", "numpy", "opencv-python-headless", "pymavlink", "pyserial"),
    *("rerun-sdk", "safetensors", "pyarrow", "av", "websockets"),
)
"""Packages that influence a flight or its recording."""
GIT_TIMEOUT_S = 2.0
_USER_PASSWORD = re.compile(r"(?<=://)([^/@\s:]*):\S*@")
"""Matches up to the last @ of the word: a password may hold any character, / and @ included."""
_NAMED_SECRET = re.compile(
    r"""((?:pass|passwd|password|pwd|pw|token|secret|key|auth|sig|signature)=)"""
    r"""(?:(?!_[a-z]+=)[^&;/?\#\s"'])+""",
    re.IGNORECASE,
)
"""Matches in a query, and in a path as some cameras have it: /user=me_password=it_channel=1."""

_CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069]")


def command_line() -> tuple[str, ...]:
    """Return the words of this process's command line, with the secrets of addresses masked."""
    return tuple(without_secrets(word) for word in ("mavbridge", *sys.argv[1:]))


def without_secrets(text: str) -> str:
    """Mask passwords and keys of the addresses in a text.

    Used for terminal, log, errors and records: ``rtsp://me:it@host`` becomes
    ``rtsp://me:***@host``, ``?token=abc`` becomes ``?token=***``.
    """
    return _NAMED_SECRET.sub(r"\1***", _USER_PASSWORD.sub(r"\1:***@", text))


def printable(text: str) -> str:
    """Make control codes visible, which could steer a terminal; line ends and tabs stay.

    Used for what files, folders and servers say. Marks of writing direction are replaced as well.
    """
    return _CONTROL.sub("\N{REPLACEMENT CHARACTER}", text)


def versions() -> dict[str, str]:
    """Return versions by name: mavbridge, Python, the system, and the installed packages."""
    found = {
        "mavbridge": mavbridge.__version__,
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
    }
    for name in PACKAGES:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


def git_revision(root: Path = IMPORT_ROOT) -> str | None:
    """Return the commit of the checkout that runs, with ``-dirty`` if files differ.

    None if ``root`` is no checkout, such as an installed wheel, or git is missing.
    """
    if not (root / ".git").exists():
        return None
    command = ["git", "-C", str(root), "describe", "--always", "--dirty", "--abbrev=40"]
    try:
        done = subprocess.run(
            [*command, "--exclude=*"],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=GIT_TIMEOUT_S,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() or None if done.returncode == 0 else None


def digests(files: Iterable[Path]) -> dict[str, str]:
    """Return the SHA-256 of each file by its absolute path; unreadable files are left out."""
    found = {}
    for path in files:
        with suppress(OSError), path.open("rb") as file:
            found[str(path.resolve())] = hashlib.file_digest(file, "sha256").hexdigest()
    return found
