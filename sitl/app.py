"""Real-time flight: sockets, the 400 Hz loop, the camera thread and the final report."""

import os
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, nullcontext
from pathlib import Path
from typing import Literal, NamedTuple

from sitl import UsageError
from sitl.camera.fpv import CameraOptions, FpvRenderer
from sitl.camera.shm import FramePublisher
from sitl.clock import NS_PER_S, Clock, StopRequest, stop_on_signal
from sitl.course import Course
from sitl.link.transport import RcInput, Transport, open_transport
from sitl.pilot.transmitter import ExpertPilot, Pilot, parse_axes
from sitl.report import write_report
from sitl.simulated_vehicle import SimulatedVehicle
from sitl.vehicle.config import STEP_NS, AutopilotName, VehicleConfig

JOIN_TIMEOUT_S = 5.0
LEAST_PRIORITY = 19
"""Niceness while flying on faster than real time, to protect the timing of other flights."""
PilotName = Literal["gamepad", "keyboard", "expert"]
PILOTS: tuple[PilotName, ...] = ("gamepad", "keyboard", "expert")
_PX4_PARAMS = {"COM_RC_IN_MODE": 0.0, "COM_FLTMODE_BOOT": 1.0}
"""Parameters for a pilot: sticks from the receiver only, Altitude mode after boot."""


class PilotOptions(NamedTuple):
    """Pilot that moves the receiver."""

    name: PilotName
    axes: str  # gamepad axes, in the format of ``sitl.pilot.transmitter``
    speed_mps: float  # speed of the expert


def run_vehicle(
    links: Sequence[str],
    config: VehicleConfig,
    course: Course,
    *,
    camera: CameraOptions | None,
    rc_port: int | None,
    pilot: PilotOptions | None = None,
    report: Path | None,
    duration_s: float | None,
    fly_on_s: float = 0.0,
) -> None:
    """Fly for ``duration_s`` (None: endless) or until a signal, then write the report.

    Before the report the vehicle flies on for ``fly_on_s`` without links or pilot.

    Raises:
        UsageError: a link, RC input, pilot, camera name or report folder cannot be used.
    """
    if report is not None and not report.parent.is_dir():
        raise UsageError(f"--report {report}: there is no folder {report.parent}")
    clock = Clock()
    with ExitStack() as stack:
        transports = [stack.enter_context(closing(open_transport(url, clock))) for url in links]
        vehicle = SimulatedVehicle(
            links=len(transports), boot_ns=clock.now_ns(), config=config, course=course
        )
        rc_input: Pilot | None = None
        if rc_port is not None:
            rc_input = stack.enter_context(closing(RcInput(rc_port)))
        if pilot is not None:
            prepare_vehicle(vehicle, config.autopilot)
            rc_input, line = make_pilot(
                pilot, vehicle=vehicle, autopilot=config.autopilot, course=course, clock=clock
            )
            stack.enter_context(closing(rc_input))
            print_status(line)
        stop = stack.enter_context(stop_on_signal())
        with filming(vehicle, course, camera, clock) if camera is not None else nullcontext():
            print_status("ready on " + ", ".join(links))
            end_ns = None if duration_s is None else clock.now_ns() + round(duration_s * NS_PER_S)
            fly(vehicle, transports, clock, stop, end_ns, rc_input=rc_input)
        if fly_on_s:
            os.nice(LEAST_PRIORITY)
            fly_on(vehicle, fly_on_s)
        if report is not None:
            write_report(report, vehicle.log.summary(vehicle.ap, vehicle.bad_frames))
            print_status(f"report written to {report}")


def prepare_vehicle(vehicle: SimulatedVehicle, autopilot: AutopilotName) -> None:
    """Make the vehicle fly by its receiver in ALT_HOLD or ALTCTL. Call before the flight."""
    if autopilot == "px4":
        for name, value in _PX4_PARAMS.items():
            vehicle.params.set(name, value)
        vehicle.reboot()


def make_pilot(
    options: PilotOptions,
    *,
    vehicle: SimulatedVehicle,
    autopilot: AutopilotName,
    course: Course,
    clock: Clock,
) -> tuple[Pilot, str]:
    """Return the pilot and a line about it for the user.

    Raises:
        UsageError: the pilot lacks its package, display or vehicle, or its axes cannot be read.
    """
    name, axes, speed_mps = options
    if name == "expert":
        if autopilot != "ardupilot":
            raise UsageError("--pilot expert knows the sticks of ardupilot alone")
        expert = ExpertPilot(vehicle, course, speed_mps=speed_mps)
        return expert, f"the expert flies at {speed_mps:g} m/s"
    wanted = parse_axes(axes)
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # no banner on import
    try:
        import pygame

        from sitl.pilot import devices
    except ModuleNotFoundError as error:
        if error.name != "pygame":
            raise
        raise UsageError(f"--pilot {name} needs pygame: pip install pygame-ce") from error
    try:
        if name == "keyboard":
            return devices.KeyboardPilot(clock), devices.KEYS_HELP
        pad = devices.PygamePad()
    except pygame.error as error:
        raise UsageError(f"--pilot {name} needs a display: {error}") from error
    found = pad.description or "no gamepad yet: plug one in (until then the receiver has no signal)"
    return devices.GamepadPilot(pad, wanted, clock), f"{found}; {devices.PAD_HELP}"


def fly(
    vehicle: SimulatedVehicle,
    transports: Sequence[Transport],
    clock: Clock,
    stop: StopRequest,
    end_ns: int | None,
    *,
    rc_input: Pilot | None = None,
) -> None:
    """Run the loop on a 2.5 ms grid: receive, advance the vehicle to now, send due messages.

    After a stall the vehicle catches up with the clock; missed grid points are skipped.
    """
    status = _Status(vehicle)
    due_ns = clock.now_ns()
    while not stop.is_set() and (end_ns is None or due_ns < end_ns):
        for link_id, transport in enumerate(transports):
            for received in transport.drain():
                status.on_received(link_id)
                vehicle.receive(link_id, received.data, received.arrived_ns)
        if rc_input is not None and (values_us := rc_input.latest()) is not None:
            vehicle.set_receiver(values_us)
        vehicle.step(clock.now_ns())
        for link_id, transport in enumerate(transports):
            transport.send(vehicle.take_outgoing(link_id))
        status.print_changes()
        missed = max(0, (clock.now_ns() - due_ns) // STEP_NS)
        due_ns += (missed + 1) * STEP_NS
        clock.sleep_until_ns(due_ns)


def fly_on(vehicle: SimulatedVehicle, duration_s: float) -> None:
    """Advance the vehicle as fast as the computer can, without receiving or sending."""
    start_ns = vehicle.ap.now_ns
    for now_ns in range(start_ns, start_ns + round(duration_s * NS_PER_S), STEP_NS):
        vehicle.step(now_ns)
        for link_id in range(len(vehicle.server.links)):
            vehicle.take_outgoing(link_id)


def print_status(line: str) -> None:
    sys.stderr.write(f"sitl: {line}\n")
    sys.stderr.flush()


class _Status:
    """Prints changes: connections, mode, arming and the vehicle's texts."""

    def __init__(self, vehicle: SimulatedVehicle) -> None:
        self._vehicle = vehicle
        self._connected: set[int] = set()
        self._mode = vehicle.ap.mode_name
        self._armed = vehicle.ap.armed
        self._texts = 0

    def on_received(self, link_id: int) -> None:
        if link_id not in self._connected:
            self._connected.add(link_id)
            print_status(f"link {link_id} connected")

    def print_changes(self) -> None:
        ap, log = self._vehicle.ap, self._vehicle.log
        if ap.mode_name != self._mode:
            print_status(f"mode {ap.mode_name}")
        if ap.armed != self._armed:
            print_status("armed" if ap.armed else "disarmed")
        for text in log.texts[self._texts :]:
            print_status(str(text["text"]))
        self._mode, self._armed = ap.mode_name, ap.armed
        self._texts = len(log.texts)


@contextmanager
def filming(
    vehicle: SimulatedVehicle, course: Course, camera: CameraOptions, clock: Clock
) -> Iterator[None]:
    """Context manager: publish the vehicle's FPV view from a separate thread."""
    stop = threading.Event()
    size = (camera.image_size, camera.image_size)
    renderer = FpvRenderer(course, *size, vehicle.ap.config.conditions)
    publisher = FramePublisher(camera.shm_name, *size)
    period_ns = round(NS_PER_S / camera.fps)
    to_end_ns = round(vehicle.ap.config.conditions.frame_time_s / 2 * NS_PER_S)

    def film() -> None:
        due_ns = clock.now_ns()
        while not stop.wait(max(0, due_ns - clock.now_ns()) / NS_PER_S):
            pose = vehicle.pose
            body = pose.body
            image = renderer.render(
                body.position_ned_m, body.ned_from_body_wxyz, body.rate_body_radps
            )
            clock.sleep_until_ns(pose.stamp_ns + to_end_ns)
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
