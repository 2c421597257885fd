"""Where a Rerun recording goes (``--rerun``): checked, and if need be started, before the flight.

Knows files, ports and the viewer's process; not the SDK.
"""

import socket
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TypeAlias
from urllib.parse import urlsplit

from mavbridge.core.errors import MavbridgeError, PeerError, UserError

VIEWER_HOST = "127.0.0.1"
VIEWER_PORT = 9876
"""Rerun's own default."""
VIEWER_URL = f"rerun+http://{VIEWER_HOST}:{VIEWER_PORT}/proxy"
VIEWER_MEMORY = "2GB"
"""Oldest data goes first beyond this: the viewer shares the machine with the flight."""
CONNECT_TIMEOUT_S = 2.0
SPAWN_TIMEOUT_S = 15.0
SETTLE_S = 1.0
"""A viewer without a display opens its port first and dies right after."""
_POLL_S = 0.1
_SCHEMES = ("rerun", "rerun+http", "rerun+https")


@dataclass(frozen=True, slots=True)
class RrdFile:
    """A recording on disk; replaced if it exists."""

    path: Path


@dataclass(frozen=True, slots=True)
class Viewer:
    """A viewer that listens at a URL."""

    url: str
    process: "subprocess.Popen[bytes] | None" = None
    """If we started it; it is left to the person who looks at it, and outlives us."""


Target: TypeAlias = RrdFile | Viewer


def prepare_target(text: str) -> Target:
    """Make sure that a recording can go where ``--rerun`` says.

    Args:
        text: ``spawn``, ``connect``, ``connect=URL`` or a path that ends in ``.rrd``.

    Raises:
        UserError: none of these, a malformed URL, or a path that cannot be written.
        PeerError: nothing listens at the URL.
        MavbridgeError: the viewer does not start.
    """
    if text == "spawn":
        if _listens(VIEWER_HOST, VIEWER_PORT, timeout_s=_POLL_S):
            return Viewer(VIEWER_URL)
        return spawn_viewer([sys.executable, "-m", "rerun_cli"], port=VIEWER_PORT)
    if text == "connect" or text.startswith("connect="):
        return _reachable(text.removeprefix("connect").removeprefix("=") or VIEWER_URL)
    if text.endswith(".rrd"):
        return _writable(Path(text))
    raise UserError(f"--rerun {text!r} is none of: spawn, connect, connect=URL, FILE.rrd, off")


def _writable(path: Path) -> RrdFile:
    try:
        path.open("wb").close()
    except OSError as error:
        raise UserError(
            f"--rerun: {path} cannot be written ({error.strerror}); name a file in a folder that "
            f"exists and that you may write to"
        ) from error
    return RrdFile(path)


def _reachable(url: str) -> Viewer:
    problem = f"--rerun: {url!r} is not a viewer's address; it looks like {VIEWER_URL}"
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError as error:
        raise UserError(problem) from error
    if parts.scheme not in _SCHEMES or not parts.hostname or port is None or parts.path != "/proxy":
        raise UserError(problem)
    if not _listens(parts.hostname, port, timeout_s=CONNECT_TIMEOUT_S):
        raise PeerError(
            f"no Rerun viewer listens at {url}; start one with `rerun`, let the bridge start it "
            f"(--rerun spawn), or record to a file (--rerun flight.rrd)"
        )
    return Viewer(url)


def _listens(host: str, port: int, *, timeout_s: float) -> bool:
    try:
        socket.create_connection((host, port), timeout_s).close()
    except OSError:
        return False
    return True


def spawn_viewer(command: list[str], *, port: int) -> Viewer:
    """Start a viewer, and see it listen and stay.

    Its own session keeps Ctrl-C from it; its output would tear the status line.

    Raises:
        MavbridgeError: it ended, or did not listen in time.
    """
    options = ["--port", str(port), "--bind", VIEWER_HOST, "--memory-limit", VIEWER_MEMORY]
    with tempfile.TemporaryFile() as errors:
        process = subprocess.Popen(
            [*command, *options, "--hide-welcome-screen", "--expect-data-soon"],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=errors,
            start_new_session=True,
        )
        for _ in range(round(SPAWN_TIMEOUT_S / _POLL_S)):
            listening = _listens(VIEWER_HOST, port, timeout_s=_POLL_S)
            if _ends_within(process, SETTLE_S if listening else _POLL_S):
                raise MavbridgeError(_no_viewer(f"ended at once: {_last_line(errors)}"))
            if listening:
                return Viewer(f"rerun+http://{VIEWER_HOST}:{port}/proxy", process)
        process.terminate()
        process.wait(SPAWN_TIMEOUT_S)
        raise MavbridgeError(_no_viewer(f"did not listen within {SPAWN_TIMEOUT_S:g} s"))


def _ends_within(process: subprocess.Popen[bytes], timeout_s: float) -> bool:
    try:
        process.wait(timeout_s)
    except subprocess.TimeoutExpired:
        return False
    return True


def _no_viewer(what: str) -> str:
    return f"the Rerun viewer {what}; record to a file instead: --rerun flight.rrd"


def _last_line(errors: IO[bytes]) -> str:
    errors.seek(0)
    lines = errors.read().decode(errors="replace").strip().splitlines()
    return lines[-1] if lines else "it gave no reason"
