"""Commands of ``python -m sitl``: fly in real time, film another vehicle, print a course."""

import argparse
import math
import os
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any

from sitl import UsageError
from sitl.camera.follow import film_vehicle
from sitl.camera.fpv import CameraOptions, FpvRenderer
from sitl.camera.shm import FramePublisher
from sitl.clock import NS_PER_S, Clock, StopRequest, next_slot_ns, stop_on_signal, wall_ns
from sitl.course import LOOP_SEEDS, Course, course_to_json, make_course
from sitl.link.transport import RcInput, Transport, open_transport
from sitl.pilot.transmitter import DEFAULT_AXES, PILOTS, Transmitter, make_pilot, prepare_vehicle
from sitl.report import write_report
from sitl.simulated_vehicle import SimulatedVehicle
from sitl.vehicle.config import (
    IDLE_RECEIVER_US,
    MID_RECEIVER_US,
    SIGNING_TICK_NS,
    STEP_NS,
    SigningKey,
    VehicleConfig,
)

JOIN_TIMEOUT_S = 5.0
KEY_BYTES = 32
EPOCH_2015_NS = 1_420_070_400 * NS_PER_S
"""Unix time of the epoch of MAVLink 2 signing timestamps."""
RECEIVERS = {"idle": IDLE_RECEIVER_US, "mid": MID_RECEIVER_US, "none": None}
LOW_PRIORITY = 5
"""Niceness while flying on faster than real time, to protect the timing of other flights."""


def fly(
    vehicle: SimulatedVehicle,
    transports: Sequence[Transport],
    clock: Clock,
    stop: StopRequest,
    end_ns: int | None,
    *,
    rc_input: RcInput | Transmitter | None = None,
) -> None:
    """Run the loop on a 2.5 ms grid: receive, advance the vehicle to now, send due messages.

    After a stall the vehicle catches up with the clock; missed grid points are skipped.
    """
    status = _Status(vehicle)
    due_ns = clock.now_ns()
    while not stop.is_set() and (end_ns is None or due_ns < end_ns):
        for link_id, transport in enumerate(transports):
            for received in transport.drain():
                vehicle.receive(link_id, received.data, received.arrived_ns)
        if rc_input is not None and (values_us := rc_input.latest()) is not None:
            vehicle.set_receiver(values_us)
        vehicle.step(clock.now_ns())
        for link_id, transport in enumerate(transports):
            transport.send(vehicle.take_outgoing(link_id))
        status.print_changes()
        due_ns = next_slot_ns(due_ns, STEP_NS, clock.now_ns())
        clock.sleep_until_ns(due_ns)


def fly_on(vehicle: SimulatedVehicle, duration_s: float, stop: StopRequest) -> None:
    """Advance the vehicle as fast as the computer can, without receiving or sending."""
    status = _Status(vehicle)
    start_ns = vehicle.ap.now_ns
    for now_ns in range(start_ns, start_ns + round(duration_s * NS_PER_S), STEP_NS):
        if stop.is_set():
            break
        vehicle.step(now_ns)
        for link_id in range(len(vehicle.server.links)):
            vehicle.take_outgoing(link_id)
        status.print_changes()


def print_status(line: str) -> None:
    sys.stderr.write(f"sitl: {line}\n")
    sys.stderr.flush()


class _Status:
    """Prints changes: mode, arming and the vehicle's texts."""

    def __init__(self, vehicle: SimulatedVehicle) -> None:
        self._vehicle = vehicle
        self._mode = vehicle.ap.mode_name
        self._armed = vehicle.ap.armed
        self._texts = len(vehicle.log.texts)

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
    vehicle: SimulatedVehicle,
    course: Course,
    camera: CameraOptions,
    clock: Clock,
    flight_stop: StopRequest,
) -> Iterator[None]:
    """Context manager: publish the vehicle's FPV view from a separate thread.

    An error in the thread stops the flight, and is raised at the end of the block.
    """
    stop = threading.Event()
    size = (camera.image_size, camera.image_size)
    renderer = FpvRenderer(course, *size, vehicle.ap.config.conditions)
    period_ns = round(NS_PER_S / camera.fps)
    to_end_ns = round(vehicle.ap.config.conditions.frame_time_s / 2 * NS_PER_S)

    def film(publisher: FramePublisher) -> None:
        due_ns = clock.now_ns()
        while not stop.wait(max(0, due_ns - clock.now_ns()) / NS_PER_S):
            pose = vehicle.pose
            body = pose.body
            image = renderer.render(
                body.position_ned_m, body.ned_from_body_wxyz, body.rate_body_radps
            )
            clock.sleep_until_ns(pose.stamp_ns + to_end_ns)
            publisher.publish(image, pose.stamp_ns)
            due_ns = next_slot_ns(due_ns, period_ns, clock.now_ns())

    with (
        closing(FramePublisher(camera.shm_name, *size)) as publisher,
        ThreadPoolExecutor(1, "sitl-camera") as pool,
    ):
        filmed = pool.submit(film, publisher)
        filmed.add_done_callback(lambda _: flight_stop.set())
        try:
            yield
        finally:
            stop.set()
        filmed.result(JOIN_TIMEOUT_S)


def run(argv: Sequence[str] | None = None) -> int:
    args = _parser().parse_args(argv)
    try:
        args.run(args)
    except UsageError as error:
        print_status(f"error: {error}")
        return 2
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m sitl",
        description="A simulated ArduCopter or PX4 that speaks MAVLink, with an FPV camera in "
        "shared memory over a course of gates.",
        allow_abbrev=False,
    )
    parser.set_defaults(run=_fly, course=0, laps=1, image_size=224, fps=30.0)
    # A default of a command would replace a flag that is given before the command.
    keeps: dict[str, Any] = {"allow_abbrev": False, "argument_default": argparse.SUPPRESS}
    add = parser.add_argument
    connect_help = "MAVLink: udpout:HOST:PORT, udpin:HOST:PORT or tcpin:HOST:PORT; repeatable"
    add("--connect", "--connect-onboard", action="append", metavar="LINK", help=connect_help)
    names = ("ardupilot", "px4")
    add("--autopilot", choices=names, default=names[0], help="firmware (default: ardupilot)")
    add("--report", type=Path, metavar="FILE", help="write a report (docs/formats.md)")
    add("--duration", type=_SECONDS, metavar="S", help="stop after S seconds")
    fly_on_help = "before the report, fly S seconds more without links, faster than real time"
    add("--fly-on", type=_SECONDS, default=0.0, metavar="S", help=fly_on_help)
    receiver_help = "RC receiver: throttle down, every stick centred, or none (default: mid; "
    receiver_help += "none with PX4, which looks at one only if COM_RC_IN_MODE tells it to)"
    add("--receiver", choices=tuple(RECEIVERS), help=receiver_help)
    rc_help = "take the receiver's values from UDP datagrams on this port (sitl/link/transport.py)"
    add("--rc-in", type=_PORT, metavar="PORT", help=rc_help)
    pilot_help = "a gamepad, or the expert over the course moves the receiver"
    add("--pilot", choices=PILOTS, help=pilot_help)
    axes_help = f"axes of the gamepad, a minus reverses one (default: {DEFAULT_AXES})"
    add("--pilot-axes", default=DEFAULT_AXES, metavar="AXES", help=axes_help)
    key_help = "sign with this key (MAVLink 2): a file of 32 bytes or 64 hexadecimal digits"
    add("--signing-key-file", type=Path, metavar="FILE", help=key_help)
    _add_camera_flags(parser)
    commands = parser.add_subparsers(title="other commands", metavar="COMMAND")
    camera_help = "film the course from another vehicle's reported pose"
    camera = commands.add_parser("camera", help=camera_help, **keeps)
    camera.set_defaults(run=_film)
    follow_help = "its MAVLink link: udp:HOST:PORT or udpin: to listen, udpout: or tcp: to connect"
    camera.add_argument("--follow", required=True, metavar="LINK", help=follow_help)
    _add_camera_flags(camera)
    course = commands.add_parser("course", help="print a course", **keeps)
    course.set_defaults(run=_print_course)
    _add_course_flags(course)
    json_help = "print JSON instead of a table"
    course.add_argument("--json", action="store_true", default=False, help=json_help)
    return parser


def _add_camera_flags(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--camera", type=_shm_name, metavar="shm:NAME", help="publish frames under this name")
    _add_course_flags(parser)
    size_help = "side of the square image (default: 224)"
    add("--image-size", type=_IMAGE_SIZE, metavar="PIXELS", help=size_help)
    add("--fps", type=_FPS, metavar="HZ", help="frame rate (default: 30)")


def _add_course_flags(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--course", type=_SEED, metavar="SEED", help="seed of the gates (default: 0)")
    laps_help = f"laps of a loop, a course from seed {LOOP_SEEDS} on (default: 1)"
    add("--laps", type=_LAPS, metavar="N", help=laps_help)


def _fly(args: argparse.Namespace) -> None:
    """Fly until the end or a signal, fly on without links or pilot, then write the report."""
    urls = args.connect or []
    if not urls:
        raise UsageError("no link: give at least one, such as --connect udpout:127.0.0.1:14550")
    if args.pilot and (args.rc_in or args.receiver):
        raise UsageError("--pilot moves the receiver: leave out --rc-in and --receiver")
    if args.report is not None:
        with _writing(args.report):
            is_new = not args.report.exists()
            args.report.open("a").close()
            if is_new:
                args.report.unlink()
    config, course = _config(args), make_course(args.course, args.laps)
    clock = Clock()
    with ExitStack() as stack:
        transports = [stack.enter_context(closing(open_transport(url, clock))) for url in urls]
        vehicle = SimulatedVehicle(
            links=len(transports), boot_ns=clock.now_ns(), config=config, course=course
        )
        rc_input: RcInput | Transmitter | None = None
        if args.rc_in is not None:
            rc_input = stack.enter_context(closing(RcInput(args.rc_in)))
        if args.pilot is not None:
            prepare_vehicle(vehicle)
            rc_input, line = make_pilot(
                args.pilot, args.pilot_axes, vehicle=vehicle, course=course, clock=clock
            )
            stack.enter_context(closing(rc_input))
            print_status(line)
        stop = stack.enter_context(stop_on_signal())
        films = args.camera is not None
        with filming(vehicle, course, _camera(args), clock, stop) if films else nullcontext():
            print_status("ready on " + ", ".join(urls))
            is_endless = args.duration is None
            end_ns = None if is_endless else clock.now_ns() + round(args.duration * NS_PER_S)
            fly(vehicle, transports, clock, stop, end_ns, rc_input=rc_input)
        if args.fly_on:
            os.nice(LOW_PRIORITY)
            with stop_on_signal() as stop:  # the signal that ended the flight does not count
                fly_on(vehicle, args.fly_on, stop)
        if args.report is not None:
            with _writing(args.report):
                write_report(args.report, vehicle.log.summary(vehicle.ap))
            print_status(f"report written to {args.report}")


@contextmanager
def _writing(report: Path) -> Iterator[None]:
    """Context manager: raise UsageError if the report cannot be written."""
    try:
        yield
    except OSError as error:
        raise UsageError(f"--report {report}: {error.strerror}; name another file") from error


def _config(args: argparse.Namespace) -> VehicleConfig:
    has_receiver = args.autopilot != "px4" or args.pilot
    receiver = args.receiver or ("mid" if has_receiver else "none")
    return VehicleConfig(
        autopilot=args.autopilot,
        receiver_us=RECEIVERS[receiver],
        signing=args.signing_key_file and _signing_key(args.signing_key_file),
    )


def _signing_key(path: Path) -> SigningKey:
    try:
        data = path.read_bytes()
        key = data if len(data) == KEY_BYTES else bytes.fromhex(data.decode("utf-8-sig").strip())
    except (OSError, ValueError) as error:
        raise UsageError(f"--signing-key-file {path}: {error}") from error
    if len(key) != KEY_BYTES:
        raise UsageError(f"--signing-key-file {path}: want {KEY_BYTES} bytes, got {len(key)}")
    zero_ns = wall_ns() - Clock().now_ns()
    return SigningKey(key, (zero_ns - EPOCH_2015_NS) // SIGNING_TICK_NS)


def _film(args: argparse.Namespace) -> None:
    if args.camera is None:
        raise UsageError(
            "camera --follow needs --camera shm:NAME, the name to publish frames under"
        )
    course = make_course(args.course, args.laps)
    with stop_on_signal() as stop:
        film_vehicle(args.follow, course, _camera(args), stop.is_set)


def _camera(args: argparse.Namespace) -> CameraOptions:
    return CameraOptions(shm_name=args.camera, image_size=args.image_size, fps=args.fps)


def _print_course(args: argparse.Namespace) -> None:
    course = make_course(args.course, args.laps)
    if args.json:
        sys.stdout.write(course_to_json(course) + "\n")
        return
    sys.stdout.write("gate  north_m  east_m  up_m  yaw_deg  size_m\n")
    for gate in course.gates:
        north, east, down = gate.center_ned_m
        sys.stdout.write(
            f"{gate.index:4d}  {north:7.1f}  {east:6.1f}  {-down:4.1f}  "
            f"{math.degrees(gate.yaw_rad):7.1f}  {gate.size_m:6.1f}\n"
        )


def _number(
    parse: type[int] | type[float], low: float, high: float, wanted: str
) -> Callable[[str], float]:
    """Return a flag's type: a number within [low, high]."""

    def convert(text: str) -> float:
        with suppress(ValueError):
            if low <= (value := parse(text)) <= high:
                return value
        raise argparse.ArgumentTypeError(f"must be {wanted}, got {text!r}")

    return convert


_SECONDS = _number(float, sys.float_info.min, 1e6, "a positive number of seconds, at most 1e6")
_FPS = _number(float, 0.1, 1000, "0.1 to 1000 Hz")
_SEED = _number(int, 0, math.inf, "a whole number, 0 or more")
_LAPS = _number(int, 1, 10_000, "a number of laps, 1 to 10000")
_PORT = _number(int, 1, 65535, "a port, 1 to 65535")
_IMAGE_SIZE = _number(int, 16, 4096, "16 to 4096 pixels")


def _shm_name(text: str) -> str:
    prefix, _, name = text.partition(":")
    if prefix != "shm" or not name or "/" in name:
        raise argparse.ArgumentTypeError(f"must be shm:NAME, such as shm:fpv, got {text!r}")
    return name
