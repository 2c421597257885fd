"""Rerun's web viewer and the server that feeds it (``--serve``), in a separate process.

The server keeps received data for browsers that connect late, so memory is bounded there, outside
the flight. A slow browser blocks the server, never the flight's loops. The server shows data from
any program that sends to its data port. Pages of other origins cannot; the flight gets none of it.
"""

import socket
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple
from urllib.parse import quote

from mavbridge.core.address import host_port, spelled
from mavbridge.core.errors import MavbridgeError, UserError
from mavbridge.core.processes import child_environment

SPAWN_TIMEOUT_S = 15.0
SETTLE_S = 1.0
"""A viewer without a display opens its port first and exits immediately afterwards."""
_POLL_S = 0.1


def start_listening(
    command: Sequence[str], *, name: str, host: str, ports: Sequence[int]
) -> "subprocess.Popen[bytes]":
    """Start a program and wait until it listens on all ports and has not exited for SETTLE_S.

    The program gets a separate session, so that Ctrl-C does not reach it.

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
    """True if a server accepts connections at this address."""
    try:
        socket.create_connection((host, port), timeout_s).close()
    except OSError:
        return False
    return True


def _not_started(name: str, reason: str) -> MavbridgeError:
    return MavbridgeError(f"{name} {reason}; record to a file instead: --rerun flight.rrd")


SERVER_MEMORY = "1GB"
"""Above this limit the server drops its oldest data."""
LOOPBACK = ("127.0.0.1", "::1")
_ANY = ("0.0.0.0", "::")  # noqa: S104 - compared with, where the user asks for it
_DIE_WITH_PARENT = """
import ctypes, os, sys
ctypes.CDLL(None).prctl(1, 15)  # PR_SET_PDEATHSIG, SIGTERM
os.nice(10)  # the flight comes first
os.execv(sys.argv[1], sys.argv[1:])
"""
"""Linux ends the server together with the flight's process, even after kill -9."""


class ServeAddress(NamedTuple):
    """Address of the page; the next port carries the data of the flight."""

    host: str
    """An IP address."""
    port: int

    @property
    def data_port(self) -> int:
        """Port of the gRPC server that the page connects to."""
        return self.port + 1

    @property
    def data_url(self) -> str:
        """URL of the gRPC server from this computer."""
        host = "127.0.0.1" if self.host in _ANY else self.host
        return f"rerun+http://{spelled(host, self.data_port)}/proxy"

    @property
    def page_url(self) -> str:
        """Address for a browser; it tells the page where the data are."""
        host = socket.gethostname() if self.host in _ANY else self.host
        data_url = f"rerun+http://{spelled(host, self.data_port)}/proxy"
        return f"http://{spelled(host, self.port)}/?url={quote(data_url, safe=':/')}"


def serve_address(text: str) -> ServeAddress:
    """Parse the value of ``--serve``, and check that both of its ports are free.

    Raises:
        UserError: not HOST:PORT, or listening on a port fails.
    """
    host, first = host_port(text) or ("", 65535)
    if first == 65535:
        raise UserError(
            f"--serve {text!r} is not understood; use HOST:PORT, such as 127.0.0.1:9090, with a "
            "port up to 65534: the next one carries the data"
        )
    for port in (first, first + 1):
        try:
            found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
            with socket.create_server(found[4], family=found[0]):
                pass
        except OSError as error:
            raise UserError(
                f"--serve {text}: cannot listen on {host} port {port} ({error.strerror}); choose "
                "another port (the page takes this one, the data the next)"
            ) from error
    if len(found[4]) == 4 and found[4][3]:
        raise UserError(f"--serve {text}: Rerun's server takes no link-local address; use [::]")
    return ServeAddress(str(found[4][0]), first)


def start_web_server(address: ServeAddress) -> "subprocess.Popen[bytes]":
    """Start the server and wait until it listens; raise MavbridgeError if it does not.

    Open pages keep their data when it ends.
    """
    options = {
        "--bind": address.host,
        "--port": str(address.data_port),
        "--web-viewer-port": str(address.port),
        "--server-memory-limit": SERVER_MEMORY,
    }
    if address.host not in LOOPBACK:  # otherwise its own page cannot read the data
        host = "*" if address.host in _ANY else address.host
        options["--cors-allow-origin"] = f"http://{spelled(host, address.port)}"
    flags = [word for option in options.items() for word in option]
    return start_listening(
        [sys.executable, "-c", _DIE_WITH_PARENT, str(_binary()), "--serve-web", *flags],
        name="Rerun's web server",
        host="127.0.0.1" if address.host in _ANY else address.host,
        ports=(address.port, address.data_port),
    )


def _binary() -> Path:
    """Return Rerun's program itself: its Python wrapper would die without ending it."""
    spec = find_spec("rerun_cli")
    if spec is None or spec.origin is None:
        raise MavbridgeError("--serve needs Rerun's program, which is not installed: rerun_cli")
    return Path(spec.origin).parent / "rerun"
