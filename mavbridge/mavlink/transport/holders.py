"""Reasons why a port or device cannot be opened and, on Linux, the process that holds it."""

import errno
from collections.abc import Iterator
from pathlib import Path

from serial.tools import list_ports

from mavbridge.core.address import SocketAddress, spelled

_PROC = Path("/proc")
_GUARD = ("mavbridge.guard", "mavbridge/guard/")


def udp_obstacle(address: SocketAddress, error: OSError) -> str:
    """Return advice about an address on which we cannot listen."""
    if error.errno == errno.EADDRINUSE:
        return f"{udp_holder(address[1])}, or choose another port"
    if error.errno == errno.EADDRNOTAVAIL:
        return f"this computer has no such address; udpout:{spelled(*address)} sends there"
    return "check the address"


def serial_obstacle(device: str, error: OSError | ValueError) -> str:
    """Return the obstacle to opening a serial port, with advice."""
    if isinstance(error, FileNotFoundError) or not Path(device).exists():
        names = ", ".join(sorted(info.device for info in list_ports.comports()))
        here = f"present: {names}" if names else "this computer has none: is it plugged in?"
        return f"there is no such port; {here}"
    code = getattr(error, "errno", None)
    if code == errno.EACCES:
        return "no permission: join its group (sudo usermod -aG dialout $USER, then log in anew)"
    if code == errno.ENOTTY or "ioctl" in str(error):  # pyserial may hide the number
        return "it is no serial port"
    holder = device_holder(device)
    if holder or code in (errno.EBUSY, errno.EAGAIN):
        return f"it is in use{holder or '; stop the program that has it'}"
    return f"{error}"


def udp_holder(port: int, proc: Path = _PROC) -> str:
    """Return the process bound to a local UDP port, as far as known, with advice."""
    holder = _holder({f"socket:[{inode}]" for inode in _udp_inodes(port, proc)}, proc)
    return holder or "another program listens there: stop it"


def device_holder(device: str, proc: Path = _PROC) -> str:
    """Return "; ", the process that has a device open, and advice; empty if not found."""
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
        except OSError:  # the process has ended, or belongs to another user
            continue
        line = " ".join(words).strip()
        if any(word.startswith(_GUARD[0]) or _GUARD[1] in word for word in words):
            return (
                f"the guard of another flight has it (process {process.name}: {line}) and may be "
                f"giving the sticks back: wait until it has, stop it with kill {process.name}"
            )
        return f"process {process.name} ({line}) has it: stop it"
    return None
