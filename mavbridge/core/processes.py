"""Child processes: logged, waited for with a deadline, always ended."""

import os
import random
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import chain
from pathlib import Path

import mavbridge
from mavbridge import OUR_SAFE_PATH, SAFE_PATH
from mavbridge.core.errors import UserError

IMPORT_ROOT = Path(mavbridge.__file__).parents[1]
"""Folder that holds this mavbridge: the source tree, or site-packages."""
END_TIMEOUT_S = 10.0
LOG_LINES_QUOTED = 8
PORTS_TO_GIVE = range(20_000, 32_768)
"""Below those that Linux and macOS give to a socket that binds no port."""


def free_port(kind: socket.SocketKind = socket.SOCK_DGRAM) -> int:
    """Return a UDP (or, with ``SOCK_STREAM``, TCP) port of the loopback interface, given only once.

    On Linux an abstract socket with its number stays bound until this process ends, so that two
    processes that ask at the same time get two ports. Raises ``UserError`` if no port is free.
    """
    first = random.SystemRandom().randrange(len(PORTS_TO_GIVE))
    for port in chain(PORTS_TO_GIVE[first:], PORTS_TO_GIVE[:first]):
        with (
            socket.socket(socket.AF_UNIX) as claim,
            socket.socket(socket.AF_INET, kind) as probe,
            suppress(OSError),
        ):
            if sys.platform == "linux":
                claim.bind(f"\0mavbridge-port-{port}")
            probe.bind(("127.0.0.1", port))
            claim.detach()
            return port
    raise UserError(
        f"none of the loopback ports {PORTS_TO_GIVE[0]} to {PORTS_TO_GIVE[-1]} is free: end what "
        "uses them (ss -ulnpt names it)"
    )


def child_environment() -> dict[str, str]:
    """Return an environment in which a Python child imports this mavbridge from any folder."""
    import_path = (str(IMPORT_ROOT), os.environ.get("PYTHONPATH", ""))
    return os.environ | {
        "PYTHONPATH": os.pathsep.join(filter(None, import_path)),
        SAFE_PATH: "1",
    }


def user_environment() -> dict[str, str]:
    """Return the environment as the user has set it, for programs of the user."""
    is_ours = os.environ.get(SAFE_PATH) == OUR_SAFE_PATH
    return {k: v for k, v in os.environ.items() if not (is_ours and k == SAFE_PATH)}


@contextmanager
def running(*command: str, log: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Context manager: run a process with its output in ``log``; end it with the block.

    A Python child imports this mavbridge from any working directory.
    """
    with log.open("wb") as out:
        process = subprocess.Popen(
            command, env=child_environment(), stdout=out, stderr=subprocess.STDOUT
        )
        try:
            yield process
        finally:
            end(process)


def end(process: subprocess.Popen[bytes]) -> None:
    """Terminate a process; kill it if it has not ended after ``END_TIMEOUT_S``."""
    if process.poll() is None:
        process.terminate()
    try:
        process.wait(END_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait(END_TIMEOUT_S)


def log_tail(log: Path) -> str:
    """Return the last lines of a log, for an error message."""
    lines = log.read_text(errors="replace").strip().splitlines()
    return "\n".join(lines[-LOG_LINES_QUOTED:]) or "it printed nothing"
