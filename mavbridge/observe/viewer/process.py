"""Rerun's programs: started, and waited for until they listen."""

import socket
import subprocess
import tempfile
from collections.abc import Sequence

from mavbridge.core.errors import MavbridgeError
from mavbridge.core.processes import child_environment

SPAWN_TIMEOUT_S = 15.0
SETTLE_S = 1.0
"""A viewer without a display opens its port first and exits right after."""
_POLL_S = 0.1


def start_listening(
    command: Sequence[str], *, name: str, host: str, ports: Sequence[int]
) -> "subprocess.Popen[bytes]":
    """Start a program and wait until it listens on all ports and has not exited for SETTLE_S.

    It gets a session of its own, out of reach of Ctrl-C.

    Raises:
        MavbridgeError: it exited, or did not listen in time.
    """
    with tempfile.TemporaryFile() as errors:
        process = subprocess.Popen(
            command,
            env=child_environment(),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=errors,
            start_new_session=True,
        )
        for _ in range(round(SPAWN_TIMEOUT_S / _POLL_S)):
            is_listening = all(listens(host, port) for port in ports)
            try:
                process.wait(SETTLE_S if is_listening else _POLL_S)
            except subprocess.TimeoutExpired:
                if is_listening:
                    return process
                continue
            errors.seek(0)
            lines = errors.read().decode(errors="replace").strip().splitlines()
            reason = f"exited at once: {lines[-1] if lines else 'it gave no reason'}"
            raise _not_started(name, reason)
        process.terminate()
        process.wait(SPAWN_TIMEOUT_S)
        raise _not_started(name, f"did not listen within {SPAWN_TIMEOUT_S:g} s")


def listens(host: str, port: int, *, timeout_s: float = _POLL_S) -> bool:
    """Whether a server accepts connections there."""
    try:
        socket.create_connection((host, port), timeout_s).close()
    except OSError:
        return False
    return True


def _not_started(name: str, reason: str) -> MavbridgeError:
    return MavbridgeError(f"{name} {reason}; record to a file instead: --rerun flight.rrd")
