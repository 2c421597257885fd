"""The target of a Rerun recording (``--rerun``), which is ready before the flight begins."""

import socket
import subprocess
import sys
import tempfile
from pathlib import Path
from urllib.parse import urlsplit

from mavbridge.core.errors import MavbridgeError, PeerError, UserError
from mavbridge.core.files import require_writable
from mavbridge.core.processes import child_environment, end

VIEWER_HOST = "127.0.0.1"
VIEWER_PORT = 9876
VIEWER_URL = f"rerun+http://{VIEWER_HOST}:{VIEWER_PORT}/proxy"
VIEWER_MEMORY = "2GB"
"""Above this limit the viewer drops its oldest data: it shares the machine with the flight."""
CONNECT_TIMEOUT_S = 2.0
SPAWN_TIMEOUT_S = 15.0
SETTLE_S = 1.0
"""A viewer without a display opens its port first and exits immediately afterwards."""
_POLL_S = 0.1
_SCHEMES = ("rerun", "rerun+http", "rerun+https")


def prepare_target(text: str) -> Path | str:
    """Return the file that a recording is written to, or the URL of a listening viewer.

    Starts one for ``spawn``; raises as ``check_target`` does, or if that one does not start.
    """
    check_target(text)
    if text.endswith(".rrd"):
        return Path(text)
    if text == "spawn" and not listens(VIEWER_HOST, VIEWER_PORT):
        spawn_viewer([sys.executable, "-m", "rerun_cli"], port=VIEWER_PORT)
    return _url(text)


def _url(text: str) -> str:
    return text.partition("=")[2] or VIEWER_URL


def check_target(text: str) -> None:
    """Run the checks of ``prepare_target`` without starting anything; raise the same errors."""
    if text in ("off", "spawn"):
        return
    if text.endswith(".rrd"):
        require_writable(Path(text), "--rerun")
        return
    if text != "connect" and not text.startswith("connect="):
        raise UserError(f"--rerun {text!r} is none of: spawn, connect, connect=URL, FILE.rrd, off")
    url = _url(text)
    problem = f"--rerun: {url!r} is not a viewer's address; it should look like {VIEWER_URL}"
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError as error:
        raise UserError(problem) from error
    if parts.scheme not in _SCHEMES or not parts.hostname or port is None or parts.path != "/proxy":
        raise UserError(problem)
    if not listens(parts.hostname, port, timeout_s=CONNECT_TIMEOUT_S):
        raise PeerError(
            f"no Rerun viewer listens at {url}: start one with `rerun`, let mavbridge start one "
            "(--rerun spawn), or record to a file (--rerun flight.rrd)"
        )


def listens(host: str, port: int, *, timeout_s: float = _POLL_S) -> bool:
    """True if a server accepts connections at this address."""
    try:
        socket.create_connection((host, port), timeout_s).close()
    except OSError:
        return False
    return True


def spawn_viewer(command: list[str], *, port: int) -> "subprocess.Popen[bytes]":
    """Start a viewer, which stays open after the flight and after Ctrl-C; wait until it listens.

    Raises:
        MavbridgeError: it did not listen in time, or exited within SETTLE_S.
    """
    options = ["--port", str(port), "--bind", VIEWER_HOST, "--memory-limit", VIEWER_MEMORY]
    with tempfile.TemporaryFile() as errors:
        process = subprocess.Popen(
            [*command, *options, "--hide-welcome-screen", "--expect-data-soon"],
            env=child_environment(),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=errors,
            start_new_session=True,
        )
        for _ in range(round(SPAWN_TIMEOUT_S / _POLL_S)):
            is_listening = listens(VIEWER_HOST, port)
            try:
                process.wait(SETTLE_S if is_listening else _POLL_S)
            except subprocess.TimeoutExpired:
                if is_listening:
                    return process
                continue
            errors.seek(0)
            lines = errors.read().decode(errors="replace").strip().splitlines()
            problem = f"exited at once: {lines[-1] if lines else 'it gave no reason'}"
            break
        else:
            end(process)
            problem = f"did not listen within {SPAWN_TIMEOUT_S:g} s"
    raise MavbridgeError(
        f"the Rerun viewer {problem}; record to a file instead: --rerun flight.rrd"
    )
