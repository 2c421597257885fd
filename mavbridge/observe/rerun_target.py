"""A Rerun recording, and its target (``--rerun``), which is ready before the flight begins."""

import socket
import subprocess
import sys
import tempfile
from pathlib import Path
from urllib.parse import urlsplit
from uuid import uuid4

import rerun as rr
import rerun.blueprint as rrb

from mavbridge.core.errors import MavbridgeError, PeerError, UserError

VIEWER_HOST = "127.0.0.1"
VIEWER_PORT = 9876
VIEWER_URL = f"rerun+http://{VIEWER_HOST}:{VIEWER_PORT}/proxy"
VIEWER_MEMORY = "2GB"
"""Beyond this the viewer drops its oldest data: it shares the machine with the flight."""
CONNECT_TIMEOUT_S = 2.0
SPAWN_TIMEOUT_S = 15.0
SETTLE_S = 1.0
"""A viewer without a display opens its port first and exits right after."""
_POLL_S = 0.1
_SCHEMES = ("rerun", "rerun+http", "rerun+https")


class RerunRecording:
    """One recording and its target; every call may block while the viewer does not keep up."""

    def __init__(self, application: str, target: str) -> None:
        """Check the target, and start the viewer if wanted; see ``prepare_target`` for errors."""
        self._target = prepare_target(target)
        rr.unregister_shutdown()  # its atexit hook waits forever for a stalled viewer
        self.stream = rr.RecordingStream(application, recording_id=uuid4())

    def open(self, blueprint: rrb.Blueprint) -> None:
        """Open the file or the connection, with this initial layout of the viewer."""
        if isinstance(self._target, Path):
            self.stream.save(self._target, default_blueprint=blueprint)
        else:
            self.stream.connect_grpc(self._target, default_blueprint=blueprint)

    def close(self) -> None:
        """Deliver the rest and close; raises MavbridgeError if the viewer is gone."""
        try:
            self.stream.flush()
        except RuntimeError as error:
            raise MavbridgeError(f"the viewer did not take the whole recording: {error}") from error
        self.stream.disconnect()


def prepare_target(text: str) -> Path | str:
    """Return the file that a recording is written to, or the URL of a viewer that listens.

    Args:
        text: ``spawn``, ``connect``, ``connect=URL`` or a path that ends in ``.rrd``.

    Raises:
        UserError: an unknown form, a malformed URL, or a path that cannot be written.
        PeerError: nothing listens at the URL.
        MavbridgeError: the viewer does not start.
    """
    if text == "spawn":
        if not _listens(VIEWER_HOST, VIEWER_PORT, timeout_s=_POLL_S):
            spawn_viewer([sys.executable, "-m", "rerun_cli"], port=VIEWER_PORT)
        return VIEWER_URL
    if text == "connect" or text.startswith("connect="):
        return _reachable(text.removeprefix("connect").removeprefix("=") or VIEWER_URL)
    if not text.endswith(".rrd"):
        raise UserError(f"--rerun {text!r} is none of: spawn, connect, connect=URL, FILE.rrd, off")
    path = Path(text)
    try:
        path.open("wb").close()
    except OSError as error:
        raise UserError(
            f"--rerun: {path} cannot be written ({error.strerror}); name a file in an existing "
            "folder that you may write to"
        ) from error
    return path


def _reachable(url: str) -> str:
    problem = f"--rerun: {url!r} is not a viewer's address; it should look like {VIEWER_URL}"
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError as error:
        raise UserError(problem) from error
    if parts.scheme not in _SCHEMES or not parts.hostname or port is None or parts.path != "/proxy":
        raise UserError(problem)
    if not _listens(parts.hostname, port, timeout_s=CONNECT_TIMEOUT_S):
        raise PeerError(
            f"no Rerun viewer listens at {url}: start one with `rerun`, let the bridge start one "
            "(--rerun spawn), or record to a file (--rerun flight.rrd)"
        )
    return url


def _listens(host: str, port: int, *, timeout_s: float) -> bool:
    try:
        socket.create_connection((host, port), timeout_s).close()
    except OSError:
        return False
    return True


def spawn_viewer(command: list[str], *, port: int) -> "subprocess.Popen[bytes]":
    """Start a viewer and wait until it listens and has not exited for SETTLE_S.

    It gets a session of its own, out of reach of Ctrl-C, and stays open after the flight.

    Raises:
        MavbridgeError: it exited, or did not listen in time.
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
            is_listening = _listens(VIEWER_HOST, port, timeout_s=_POLL_S)
            try:
                process.wait(SETTLE_S if is_listening else _POLL_S)
            except subprocess.TimeoutExpired:
                if is_listening:
                    return process
                continue
            errors.seek(0)
            lines = errors.read().decode(errors="replace").strip().splitlines()
            raise _not_started(f"exited at once: {lines[-1] if lines else 'it gave no reason'}")
        process.terminate()
        process.wait(SPAWN_TIMEOUT_S)
        raise _not_started(f"did not listen within {SPAWN_TIMEOUT_S:g} s")


def _not_started(reason: str) -> MavbridgeError:
    return MavbridgeError(
        f"the Rerun viewer {reason}; record to a file instead: --rerun flight.rrd"
    )
