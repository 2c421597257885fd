"""Flight in real processes on loopback: sitl, a recording relay, mavbridge."""

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, Literal

from faults.link import Carrier, UdpCarrier
from faults.processes import Process, StageError, child_of, mapped_memory, processes_with
from faults.props import FrameFeed, Transmitter, Viewer
from faults.record import VehicleReport
from faults.relay import Relay
from mavbridge.core.processes import free_port
from mavbridge.core.reasons import Reason, reason_from_json
from sitl.clock import NS_PER_MS, Clock

TIMEOUT_S = 90.0
STARTS = 3
LEANING = 40
"""Consecutive leaning messages of sticks that show that the policy holds its lean."""
STICKS_OVER_NS = 200 * NS_PER_MS
"""Time without a stick of the policy after which its flight is over."""
STALLS = frozenset(("computer", "guard", "flight process", "link"))
"""Places named in reasons at which a busy machine loses time."""
ORDERLY = (0, 4)
"""Exit statuses of a flight that ended in order; 4: a busy machine made the guard end it early."""
MARK = "FAULT_MARK"
"""Environment variable with the file into which a policy of the catalogue writes the start of its
fault, in ns of CLOCK_MONOTONIC."""
PIPE_BLOCK = 4096
CATALOGUE = Path(__file__).parent / "catalogue"
VEHICLE = """
from functools import partial
from sitl import app
app.VehicleConfig = partial(app.VehicleConfig, estimator_ready_s=0.5, position_ready_s=0.5)
raise SystemExit(app.run())
"""
"""``python -m sitl``, but for the seconds that its estimator takes to find its position."""
ProcessName = Literal["flight", "guard", "recorder"]
"""``recorder`` is the process that writes the video of a recording."""


def faulty_policy(name: str) -> str:
    """Return a class of ``catalogue/policies.py`` as a value of ``--policy``."""
    return f"{CATALOGUE / 'policies.py'}:{name}"


class Stage:
    """One bridge and one simulated vehicle."""

    def __init__(self, folder: Path, relay: Relay, shm: str, vehicle: tuple[str, ...]) -> None:
        """``vehicle`` are the flags of the simulated vehicle, which starts at once."""
        self.folder = folder
        self.relay = relay
        self.clock = Clock()
        self._shm = shm
        self._vehicle_flags = vehicle
        self.cameras: tuple[str, ...] = ()
        """Names of the policy's cameras if it has several: all show the vehicle's camera."""
        self._vehicle = self._start_vehicle()
        self._flags: tuple[str, ...] = ()
        self._is_read = True
        self._bridge: subprocess.Popen[str] | None = None
        self._lines: list[str] = []
        self._news = threading.Condition()
        self._reader: threading.Thread | None = None
        self._guard: Process | None = None
        self.camera: FrameFeed | None = None
        """The camera, if the vehicle has none of its own."""
        self.viewer: Viewer | None = None
        self.variables: dict[str, str] = {}
        """Additional environment variables of the bridge."""
        self.memory: set[str] = set()
        """Names of shared memory that the bridge has had; see ``wait_for_lean``."""
        self.temporary = folder / "temporary"
        """Folder for the bridge's temporary files."""
        self.temporary.mkdir()
        self.transmitter: Transmitter | None = None
        """The pilot's transmitter, if it can be moved."""
        self.prepare: Callable[[], object] | None = None
        """Called before each start of the bridge, once the vehicle has been heard."""

    @property
    def is_px4(self) -> bool:
        return "px4" in self._vehicle_flags

    def _start_vehicle(self) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-c", VEHICLE, "--report", str(self.folder / "fc.json")]
        command += ["--connect", f"udpout:127.0.0.1:{self.relay.port}"]
        return subprocess.Popen([*command, *self._vehicle_flags], stderr=subprocess.DEVNULL)

    def start(self, *flags: str, is_read: bool = True) -> None:
        """Start the bridge in its own process group; without ``is_read``, never read its output."""
        self._flags, self._is_read = flags, is_read
        if self.prepare is not None:
            if not self.relay.has_heard.wait(TIMEOUT_S):
                raise StageError("the vehicle has sent nothing")
            self.prepare()
        self._bridge = subprocess.Popen(
            [*self.command(self.folder / "report.json"), *flags],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=self.environment() | ({} if is_read else {"PYTHONUNBUFFERED": ""}),
            process_group=0,
        )
        if is_read:
            self._reader = threading.Thread(target=self._read, name="reader")
            self._reader.start()

    def command(self, report: Path) -> list[str]:
        command = [sys.executable, "-m", "mavbridge", "--connect", self.relay.carrier.address]
        sources = [f"{name}=shm:{self._shm}" for name in self.cameras] or [f"shm:{self._shm}"]
        cameras = [flag for source in sources for flag in ("--camera", source)]
        return [*command, *cameras, "--report", str(report)]

    def environment(self) -> dict[str, str]:
        """Return our environment, with 200 columns and a file for the mark of a policy's fault."""
        ours = {"COLUMNS": "200", MARK: str(self._mark), "TMPDIR": str(self.temporary)}
        return os.environ | ours | self.variables

    @property
    def _mark(self) -> Path:
        return self.folder / "mark"

    def _read(self) -> None:
        for line in self._bridge.stdout:
            with self._news:
                self._lines.append(line)
                self._news.notify_all()

    def wait_for(self, text: str) -> bool:
        with self._news:
            return self._news.wait_for(
                lambda: any(text in line for line in self._lines), timeout=TIMEOUT_S
            )

    def wait_for_lean(self) -> None:
        """Wait until the policy holds its lean; keep the guard's id for after its parent's death.

        If a busy machine made the guard end the flight early, restart vehicle and bridge.
        """
        sent = self.relay.sent

        def is_leaning() -> bool:
            return self.relay.is_leaning(LEANING)

        def is_over() -> bool:
            last = next((row for row in reversed(sent) if row.steers), None)
            return self.relay.has_flown.is_set() and last is not None and not last.climbs

        for _ in range(STARTS):
            if not self.relay.wait_until(lambda: is_leaning() or is_over(), TIMEOUT_S):
                raise StageError(f"the policy has not flown:\n{self.output}")
            self.guard.has_ended(0)  # finds it while its parent lives
            if is_leaning():
                self.memory |= mapped_memory(self.bridge_pid)
                return
            self._start_over()
        raise StageError(f"the flight ended {STARTS} times before its fault:\n{self.output}")

    def fly(self, *flags: str) -> tuple[int, str]:
        """Start a bridge that ends by itself; return its exit status and all of its output.

        The flight is repeated if a busy machine delayed its attitude, which no test here is about.
        """
        self.start(*flags)
        for _ in range(STARTS - 1):
            status, output = self.end()
            if status != ORDERLY[1] or not was_stalled(self.folder / "report.json"):
                return status, output
            self._lines.clear()
            self._start_over()
        return self.end()

    def _start_over(self) -> None:
        self.close()
        self._vehicle.kill()
        self._vehicle.wait(TIMEOUT_S)
        self.relay.forget()
        self.relay.has_heard.clear()
        if "--record" in self._flags:
            shutil.rmtree(self._flags[self._flags.index("--record") + 1])
        self._lines.append("--- starting over: the machine was too busy to fly\n")
        self._vehicle = self._start_vehicle()
        self.start(*self._flags, is_read=self._is_read)

    @property
    def output(self) -> str:
        return "".join(self._lines)

    def fill_output(self) -> None:
        """Fill the unread pipe, so that the bridge's next write to it would block."""
        fd = os.open(f"/proc/{self.bridge_pid}/fd/1", os.O_WRONLY | os.O_NONBLOCK)
        for block in (PIPE_BLOCK, 1):
            with suppress(BlockingIOError):
                while True:
                    os.write(fd, b"." * block)
        os.close(fd)

    def observe(self, seconds: float) -> None:
        threading.Event().wait(seconds)

    def fault_ns(self) -> int:
        """Wait for the policy's own fault; return its start."""
        if not self.relay.wait_until(self._mark.exists, TIMEOUT_S):
            raise StageError(f"the policy's fault has not begun:\n{self.output}")
        return int(self._mark.read_text())

    @property
    def bridge_pid(self) -> int:
        return self._bridge.pid

    @property
    def guard(self) -> Process:
        """The guard process; first use it while the bridge lives."""
        if self._guard is None:
            self._guard = Process(child_of(self.bridge_pid, b"mavbridge.guard"), self.clock)
        return self._guard

    def pid_of(self, name: ProcessName) -> int:
        if name == "recorder":
            return child_of(self.bridge_pid, b"spawn_main")
        return self.guard.pid if name == "guard" else self.bridge_pid

    def processes(self) -> list[tuple[int, str]]:
        """Return id and command of every running process of the bridge."""
        return processes_with(f"{MARK}={self._mark}")

    def last_lean_ns(self) -> int:
        """Wait until the policy's sticks have ceased; return the time of the last one."""
        sent = self.relay.sent

        def is_over() -> bool:
            leans = [row.at_ns for row in sent[-3 * LEANING :] if row.leans]
            return not leans or self.clock.now_ns() - leans[-1] > STICKS_OVER_NS

        if not self.relay.wait_until(is_over, TIMEOUT_S):
            raise StageError(f"the policy goes on flying:\n{self.output}")
        return [row.at_ns for row in sent if row.leans][-1]

    def kill(self, number: signal.Signals) -> int:
        """Send a signal to the bridge alone; return the time."""
        at_ns = self.clock.now_ns()
        self._bridge.send_signal(number)
        return at_ns

    def kill_group(self, number: signal.Signals) -> int:
        """Send a signal to the whole process group, as a terminal does; return the time."""
        at_ns = self.clock.now_ns()
        with suppress(ProcessLookupError):
            os.killpg(self.bridge_pid, number)
        return at_ns

    def end(self) -> tuple[int, str]:
        bridge = self._bridge
        try:
            bridge.wait(TIMEOUT_S)
        except subprocess.TimeoutExpired as error:
            raise StageError(f"the bridge has not ended:\n{self.output}") from error
        finally:
            self.close()
        return bridge.returncode, self.output

    def close(self) -> None:
        if self._guard is not None:
            self._guard.close()
            self._guard = None
        if self._bridge is None:
            return
        if self._bridge.poll() is None:
            self._bridge.kill()
            self._bridge.wait()
        if self._reader is not None:
            self._reader.join(TIMEOUT_S)
            self._reader = None
        if self._bridge.stdout is not None:
            self._bridge.stdout.close()

    def end_vehicle(self) -> None:
        self._vehicle.terminate()
        self._vehicle.wait(TIMEOUT_S)

    def report(self) -> Any:
        return json.loads((self.folder / "report.json").read_text())

    def release_codes(self) -> set[str]:
        """Return codes of all reasons for which the policy lost the sticks, inner ones included."""
        reasons = release_reasons(self.folder / "report.json")
        return {code.value for reason in reasons for code in reason.codes}

    def vehicle_report(self) -> VehicleReport:
        """Return the vehicle's report. Call after the ``staged`` block, which ends the vehicle."""
        return json.loads((self.folder / "fc.json").read_text())


def release_reasons(report: Path) -> list[Reason]:
    """Return all reasons for which the policy lost the sticks, from the bridge's report."""
    releases = json.loads(report.read_text())["releases"] if report.exists() else []
    return [reason_from_json(release["reason"]) for release in releases]


def was_stalled(report: Path) -> bool:
    """True if a busy machine made the guard end the flight."""
    return any(STALLS & {*places(reason)} for reason in release_reasons(report))


def places(reason: Reason) -> Iterator[object]:
    """Yield the places at which time was spent, from a reason and its inner reasons."""
    for name, value in reason.data:
        if name == "place":
            yield value
        elif isinstance(value, Reason):
            yield from places(value)


@contextmanager
def staged(
    folder: Path, *vehicle_flags: str, renders: bool = True, carrier: Carrier | None = None
) -> Iterator[Stage]:
    """Context manager: a vehicle and a relay, ready for ``Stage.start``; both end with the block.

    Without ``renders`` the camera shows noise, costs nothing and can be made faulty. ``carrier``
    leads from the relay to the bridge; None: UDP.
    """
    port = free_port()
    shm = f"test-{port}-{os.getpid()}"
    clock = Clock()
    with ExitStack() as stack:
        relay = stack.enter_context(Relay(carrier or UdpCarrier(port), clock))
        filming = ("--camera", f"shm:{shm}") if renders else ()
        stage = Stage(folder, relay, shm, (*filming, *vehicle_flags))
        stack.callback(stage.end_vehicle)
        if not renders:
            stage.camera = stack.enter_context(FrameFeed(shm, clock))
        stack.callback(stage.close)
        yield stage
