"""The vehicle in real time: sockets, the 400 Hz loop, the camera thread, the report at the end."""

import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

from sitl.camera.fpv import FpvRenderer
from sitl.camera.shm import FramePublisher
from sitl.clock import NS_PER_S, Clock, MonotonicClock
from sitl.course.layout import Course, make_course
from sitl.errors import UsageError
from sitl.link.transport import Transport, open_transport
from sitl.report import write_report
from sitl.simulated_vehicle import SimulatedVehicle
from sitl.stopping import StopRequest, stop_on_signal
from sitl.vehicle.autopilot import STEP_NS, VehicleConfig

JOIN_TIMEOUT_S = 5.0


@dataclass(frozen=True, slots=True, kw_only=True)
class RunOptions:
    """What ``python -m sitl`` was asked for."""

    connect: tuple[str, ...]
    shm_name: str | None
    """Where the camera publishes; None = no camera."""
    course_seed: int
    image_size: int
    fps: float
    report: Path | None
    duration_s: float | None
    """None = until a signal."""
    vehicle: VehicleConfig
    end_with_course: bool = False
    """End a second after the last gate, or at a crash."""


def run_vehicle(options: RunOptions) -> int:
    """Fly until the duration is over or a signal comes; the exit code.

    Raises:
        UsageError: a link, the camera's name or the report's folder cannot be used.
    """
    if options.report is not None and not options.report.parent.is_dir():
        raise UsageError(f"--report {options.report}: there is no folder {options.report.parent}")
    clock = MonotonicClock()
    course = make_course(options.course_seed)
    with ExitStack() as stack:
        transports = [
            stack.enter_context(closing(open_transport(url, clock))) for url in options.connect
        ]
        vehicle = SimulatedVehicle(
            links=len(transports), boot_ns=clock.now_ns(), config=options.vehicle, course=course
        )
        stop = stack.enter_context(stop_on_signal())
        if options.shm_name is not None:
            stack.enter_context(filming(options, options.shm_name, course, vehicle, clock))
        tell("ready on " + ", ".join(options.connect))
        end_ns = (
            clock.now_ns() + round(options.duration_s * NS_PER_S) if options.duration_s else None
        )
        fly(vehicle, transports, clock, stop, end_ns, end_with_course=options.end_with_course)
    if options.report is not None:
        write_report(options.report, vehicle.log.summary(vehicle.ap, vehicle.bad_frames))
        tell(f"report written to {options.report}")
    return 0


def fly(
    vehicle: SimulatedVehicle,
    transports: Sequence[Transport],
    clock: Clock,
    stop: StopRequest,
    end_ns: int | None,
    *,
    end_with_course: bool = False,
) -> None:
    """The loop: take in what has come, advance to now, send what is due, on a 2.5 ms grid.

    After a stall the vehicle catches up with the clock, and the grid goes on from now.
    """
    console = _Console(vehicle)
    due_ns = clock.now_ns()
    while not stop.is_set() and (end_ns is None or due_ns < end_ns):
        for link_id, transport in enumerate(transports):
            for received in transport.drain():
                console.heard(link_id)
                vehicle.receive(link_id, received.data, received.arrived_ns)
        vehicle.step(clock.now_ns())
        for link_id, transport in enumerate(transports):
            transport.send(vehicle.take_outgoing(link_id))
        console.update()
        if end_with_course and vehicle.log.verdict(vehicle.ap.now_ns) is not None:
            return
        missed = max(0, (clock.now_ns() - due_ns) // STEP_NS)
        due_ns += (missed + 1) * STEP_NS
        clock.sleep_until_ns(due_ns)


def tell(line: str) -> None:
    """One line for the person at the terminal."""
    sys.stderr.write(f"sitl: {line}\n")
    sys.stderr.flush()


class _Console:
    """Says what changes: who connects, modes, arming, the vehicle's own words."""

    def __init__(self, vehicle: SimulatedVehicle) -> None:
        self._vehicle = vehicle
        self._heard: set[int] = set()
        self._mode = vehicle.ap.mode
        self._armed = vehicle.ap.armed
        self._texts = 0
        self._crashed = False

    def heard(self, link_id: int) -> None:
        """Something came in on a link."""
        if link_id not in self._heard:
            self._heard.add(link_id)
            tell(f"link {link_id} connected")

    def update(self) -> None:
        """Compare with the last step."""
        ap = self._vehicle.ap
        if ap.mode is not self._mode:
            self._mode = ap.mode
            tell(f"mode {ap.mode.name}")
        if ap.armed != self._armed:
            self._armed = ap.armed
            tell("armed" if ap.armed else "disarmed")
        crash = self._vehicle.log.crash
        if crash is not None and not self._crashed:
            tell(f"crash: hit {crash.hit} at {crash.speed_mps:.1f} m/s")
        self._crashed = crash is not None
        for text in self._vehicle.log.texts[self._texts :]:
            self._texts += 1
            tell(str(text["text"]))


@contextmanager
def filming(
    options: RunOptions, shm_name: str, course: Course, vehicle: SimulatedVehicle, clock: Clock
) -> Iterator[None]:
    """The FPV camera in its own thread, for as long as the context lasts."""
    stop = threading.Event()
    renderer = FpvRenderer(
        course, options.image_size, options.image_size, options.vehicle.conditions
    )
    publisher = FramePublisher(shm_name, options.image_size, options.image_size)
    period_ns = round(NS_PER_S / options.fps)

    def film() -> None:
        due_ns = clock.now_ns()
        while not stop.wait(max(0, due_ns - clock.now_ns()) / NS_PER_S):
            pose = vehicle.pose
            image = renderer.render(pose.body.position_ned_m, pose.body.ned_from_body_wxyz)
            publisher.publish(image, pose.stamp_ns)
            due_ns += period_ns * max(1, -(-(clock.now_ns() - due_ns) // period_ns))

    thread = threading.Thread(target=film, name="sitl-camera", daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join(JOIN_TIMEOUT_S)
        publisher.close()
