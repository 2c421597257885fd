"""Compiled graphs on disk, so that the second start of a policy is a quick one.

Any problem with a file or its folder only means that a graph is compiled again. Entries carry a
checksum, because an engine that reads half a file may crash.
"""

import contextlib
import hashlib
import os
from pathlib import Path

MAX_ENTRIES = 24
"""Files kept, about eight policies of two graphs each, some at two precisions; the least recently
used is dropped first."""
MAX_BYTES = 2_000_000_000
"""Size of all files together: the graphs of a large policy are as large as its weights."""
_DIGEST_BYTES = hashlib.sha256().digest_size


def user_cache_folder() -> Path:
    """XDG base directory specification: $XDG_CACHE_HOME or ~/.cache; an own folder in it."""
    base = os.environ.get("XDG_CACHE_HOME", "")
    # The specification says to ignore a relative path.
    root = Path(base) if Path(base).is_absolute() else Path("~/.cache").expanduser()
    return root / "mavbridge"


class CompileCache:
    """Bytes by key, in one folder of a file each."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def load(self, key: str) -> bytes | None:
        """The bytes stored under ``key``; None if there are none, or they are damaged."""
        path = self._path(key)
        try:
            content = path.read_bytes()
            path.touch()
        except OSError:
            return None
        digest, blob = content[:_DIGEST_BYTES], content[_DIGEST_BYTES:]
        return blob if hashlib.sha256(blob).digest() == digest else None

    def store(self, key: str, blob: bytes) -> None:
        """Keep ``blob`` if possible; the oldest beyond ``MAX_ENTRIES`` or ``MAX_BYTES`` go."""
        path = self._path(key)
        partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            partial.write_bytes(hashlib.sha256(blob).digest() + blob)
            partial.replace(path)
            self._make_room()
        except OSError:
            with contextlib.suppress(OSError):
                partial.unlink(missing_ok=True)

    def _path(self, key: str) -> Path:
        return self._folder / f"{hashlib.sha256(key.encode()).hexdigest()}.graph"

    def _make_room(self) -> None:
        entries = []
        for path in self._folder.glob("*.graph*"):  # leftovers of a killed process count too
            with contextlib.suppress(FileNotFoundError):  # another process made room
                stat = path.stat()
                entries.append((stat.st_mtime_ns, path, stat.st_size))
        total = 0
        for place, (_, path, size) in enumerate(sorted(entries, reverse=True)):
            total += size
            if place >= MAX_ENTRIES or total > MAX_BYTES:
                path.unlink(missing_ok=True)
