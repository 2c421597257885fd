"""A Rerun viewer without a window, that can stop reading or die."""

import socket
import subprocess
import threading
from importlib.util import find_spec
from pathlib import Path

from sitl import UsageError

START_S = 15.0
POLL_S = 0.1


class Viewer:
    """Rerun's own program, listening on loopback while the context lasts."""

    def __init__(self) -> None:
        spec = find_spec("rerun_cli")
        if spec is None or spec.origin is None:
            raise UsageError("a fault of the viewer needs Rerun's program: pip install rerun-sdk")
        with socket.create_server(("127.0.0.1", 0)) as probe:
            self._port: int = probe.getsockname()[1]
        binary = Path(spec.origin).parent / "rerun"
        self.process = subprocess.Popen(
            [binary, "--serve-grpc", "--bind", "127.0.0.1", "--port", str(self._port)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        self.target = f"connect=rerun+http://127.0.0.1:{self._port}/proxy"
        """For ``--rerun``."""

    def __enter__(self) -> "Viewer":
        pause = threading.Event()
        for _ in range(round(START_S / POLL_S)):
            try:
                socket.create_connection(("127.0.0.1", self._port), POLL_S).close()
            except OSError:
                pause.wait(POLL_S)
            else:
                return self
        self.__exit__()
        raise UsageError(f"Rerun's program does not listen after {START_S:.0f} s")

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.wait(START_S)
