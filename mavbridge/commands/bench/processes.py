"""Child processes of a benchmark: started, waited for with a deadline, ended in every case."""

import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import mavbridge
from mavbridge.core.errors import UserError

SOURCE_TREE = Path(mavbridge.__file__).parents[1]
PEERS_PYTHON = Path(sys.prefix).parent / ".venv-peers" / "bin" / "python"
"""Beside our own environment, where ``make test`` puts it."""
END_TIMEOUT_S = 10.0


def require_source_tree() -> None:
    """Refuse to run from an installed package, which lacks the runner and the peers.

    Raises:
        UserError: with what to do.
    """
    if not (SOURCE_TREE / "benchmarks" / "naive.py").is_file():
        raise UserError(
            f"mavbridge bench needs the source tree: there is no benchmarks/ in {SOURCE_TREE}. "
            "Clone the repository and use make bench, or an editable install"
        )


def free_udp_port() -> int:
    """A port of the loopback that nobody uses now."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


@contextmanager
def running(*command: str, log: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A process in the source tree, its output in ``log``; ended with the block, at worst killed.

    pymavlink decides between MAVLink 1 and 2 as it is imported, by the environment.
    """
    environment = os.environ | {"MAVLINK20": "1"}
    with log.open("wb") as output:
        process = subprocess.Popen(
            command, cwd=SOURCE_TREE, env=environment, stdout=output, stderr=subprocess.STDOUT
        )
        try:
            yield process
        finally:
            end(process)


def end(process: subprocess.Popen[bytes]) -> None:
    """Ask the process to end, and make sure that it does."""
    if process.poll() is None:
        process.terminate()
    try:
        process.wait(END_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait(END_TIMEOUT_S)


def wait(process: subprocess.Popen[bytes], what: str, log: Path, timeout_s: float) -> None:
    """Wait for a process that ends by itself.

    Raises:
        UserError: it failed, or did not end; with the last that it said.
    """
    try:
        status = process.wait(timeout_s)
    except subprocess.TimeoutExpired as error:
        raise UserError(f"{what} has not ended after {timeout_s:g} s: {_tail(log)}") from error
    if status != 0:
        raise UserError(f"{what} failed with status {status}: {_tail(log)}")


def _tail(log: Path) -> str:
    lines = log.read_text(errors="replace").strip().splitlines()
    return "\n".join(lines[-8:]) or "it said nothing"
