"""Environment of the bridge: a camera without a renderer, a transmitter, a viewer, a watch."""

import os
import socket
import struct
import subprocess
import threading
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

import numpy as np

from faults.record import NEUTRAL_US, RECEIVER_US, Receiver
from mavbridge.core.processes import free_port
from sitl import UsageError
from sitl.camera.shm import FramePublisher
from sitl.clock import NS_PER_MS, Clock

SIDE = 32
"""Side of the square images [px], as required by the policies of the catalogue."""
OTHER_SIDE = 48
FRAME_PERIOD_S, WATCH_PERIOD_S = 1 / 30, 0.005
JOIN_S = 5.0
ImageFault = Literal[
    "none", "gone", "frozen", "black", "late", "torn", "resized", "closed", "garbage", "cut"
]
SILENT = ("gone", "closed", "garbage", "cut")
LATE_NS = 500 * NS_PER_MS
CHANNELS = 8
SWITCH_ON_US = 2000
"""Initial value of the channels above the mode switch (5)."""
VIEWER_START_S, VIEWER_POLL_S = 15.0, 0.1


class Worker:
    """Thread that runs ``_run`` while the context lasts."""

    def __init__(self, name: str) -> None:
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(JOIN_S)

    def _run(self) -> None:
        raise NotImplementedError


class FrameFeed(Worker):
    """Publishes noise at 30 Hz, or faulty images."""

    def __init__(self, name: str, clock: Clock) -> None:
        super().__init__("frame-feed")
        self._clock = clock
        self._name = name
        self._fault: ImageFault = "none"

    def show(self, fault: ImageFault) -> int:
        """Publish this fault from the next frame on; return the time.

        ``gone``: nothing, as after the death of the writer; ``frozen``, ``black``: the same image
        repeatedly; ``late``: stamps half a second old; ``torn``: frames that never become complete;
        ``resized``: another writer with larger images takes the name over; ``closed``: the writer
        ends in order; ``garbage``: a file without images takes the name over; ``cut``: the file is
        truncated to zero under its readers.
        """
        self._fault = fault
        return self._clock.now_ns()

    def _run(self) -> None:
        publisher, side = FramePublisher(self._name, SIDE, SIDE), SIDE
        path, size_bytes = publisher.path, publisher.path.stat().st_size
        random = np.random.default_rng(0)
        image = np.zeros((side, side, 3), dtype=np.uint8)
        done: ImageFault = "none"
        while not self._stop.wait(FRAME_PERIOD_S):
            fault = self._fault
            if fault != done and fault == "resized":
                before, side = publisher, OTHER_SIDE
                publisher = FramePublisher(self._name, side, side)
                before.close()
            elif fault != done and fault == "closed":
                publisher.close()
            elif fault != done and fault == "cut":
                os.truncate(path, 0)
            elif fault != done and fault == "garbage":
                draft = path.with_name(f".{path.name}.draft")
                draft.write_bytes(b"no images " * 10)
                draft.replace(path)
            done = fault
            if fault in SILENT:
                continue
            if fault == "black":
                image = np.zeros_like(image)
            elif fault != "frozen":
                image = random.integers(0, 256, (side, side, 3), dtype=np.uint8)
            stamp_ns = self._clock.now_ns() - (LATE_NS if fault == "late" else 0)
            publisher.publish(image, stamp_ns, is_whole=fault != "torn")
        if done == "cut":
            os.truncate(path, size_bytes)  # ``close`` writes it again
        publisher.close()
        path.unlink(missing_ok=True)


class StallWatch(Worker):
    """Wakes every 5 ms and keeps its worst lateness, which is that of this computer."""

    def __init__(self) -> None:
        super().__init__("stall-watch")
        self.longest_ms = 0.0

    def _run(self) -> None:
        clock = Clock()
        last_ns = clock.now_ns()
        while not self._stop.wait(WATCH_PERIOD_S):
            now_ns = clock.now_ns()
            late_ms = (now_ns - last_ns) / NS_PER_MS - WATCH_PERIOD_S * 1e3
            self.longest_ms = max(self.longest_ms, late_ms)
            last_ns = now_ns


class Transmitter:
    """The pilot's eight channels, sent to ``--rc-in``; each keeps its value until it is moved."""

    def __init__(self, receiver: Receiver) -> None:
        """``receiver`` gives the rest position of the throttle."""
        port = free_port()
        self.flags = ("--rc-in", str(port))
        """Flags of the simulated vehicle."""
        self._address = ("127.0.0.1", port)
        sticks_us = RECEIVER_US.get(receiver, NEUTRAL_US)
        self._channels_us = [*sticks_us, 1500, *[SWITCH_ON_US] * (CHANNELS - 5)]

    def move(self, channel: int, value_us: int) -> None:
        """Move a stick or switch, numbered from 1."""
        self._channels_us[channel - 1] = value_us
        self.switch_on()

    def switch_on(self) -> None:
        self._send(self._channels_us)

    def switch_off(self) -> None:
        """Stop the signal: the receiver hears nothing any more."""
        self._send([0] * CHANNELS)

    def _send(self, values_us: list[int]) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.sendto(struct.pack(f"<{CHANNELS}H", *values_us), self._address)


class Viewer:
    """Rerun's own program without a window, on loopback, while the context lasts."""

    def __init__(self) -> None:
        spec = find_spec("rerun_cli")
        if spec is None or spec.origin is None:
            raise UsageError("a fault of the viewer needs Rerun's program: pip install rerun-sdk")
        self._port = free_port(socket.SOCK_STREAM)
        binary = Path(spec.origin).parent / "rerun"
        self.process = subprocess.Popen(
            [binary, "--serve-grpc", "--bind", "127.0.0.1", "--port", str(self._port)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        self.target = f"connect=rerun+http://127.0.0.1:{self._port}/proxy"
        """Value for ``--rerun``."""

    def __enter__(self) -> "Viewer":
        pause = threading.Event()
        for _ in range(round(VIEWER_START_S / VIEWER_POLL_S)):
            try:
                socket.create_connection(("127.0.0.1", self._port), VIEWER_POLL_S).close()
            except OSError:
                pause.wait(VIEWER_POLL_S)
            else:
                return self
        self.__exit__()
        raise UsageError(f"Rerun's program does not listen after {VIEWER_START_S:.0f} s")

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.wait(VIEWER_START_S)
