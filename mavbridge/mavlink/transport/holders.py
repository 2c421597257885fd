"""Says which process holds a port or a device, to help a user who cannot have it (Linux)."""

from collections.abc import Iterator
from pathlib import Path

_PROC = Path("/proc")
_GUARD = ("mavbridge.guard", "mavbridge/guard/")


def udp_holder(port: int, proc: Path = _PROC) -> str:
    """Who is bound to a local UDP port, as far as can be found out, and what to do about it."""
    holder = _holder({f"socket:[{inode}]" for inode in _udp_inodes(port, proc)}, proc)
    return holder or "another program listens there: stop it"


def device_holder(device: str, proc: Path = _PROC) -> str:
    """Who has a device open and what to do about it, after a semicolon; empty if not found."""
    holder = _holder({str(Path(device).resolve())}, proc)
    return f"; {holder}" if holder else ""


def _udp_inodes(port: int, proc: Path) -> Iterator[str]:
    for name in ("udp", "udp6"):
        try:
            lines = (proc / "net" / name).read_text().splitlines()[1:]
        except OSError:
            continue
        for line in lines:
            fields = line.split()
            if int(fields[1].rpartition(":")[2], 16) == port:
                yield fields[9]


def _holder(targets: set[str], proc: Path) -> str | None:
    for process in proc.glob("[0-9]*") if targets else ():
        try:
            if targets.isdisjoint(str(fd.readlink()) for fd in (process / "fd").iterdir()):
                continue
            words = (process / "cmdline").read_bytes().decode(errors="replace").split("\0")
        except OSError:  # it has ended, or belongs to another user
            continue
        line = " ".join(words).strip()
        if any(word.startswith(_GUARD[0]) or _GUARD[1] in word for word in words):
            return (
                f"the guard of another flight has it (process {process.name}: {line}) and may be "
                f"giving the sticks back: wait until it has, stop it with kill {process.name}"
            )
        return f"process {process.name} ({line}) has it: stop it"
    return None
