"""Commands: ``python -m sitl`` flies, ``camera`` films another vehicle, ``course`` prints one."""

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path

from sitl.app import RunOptions, run_vehicle, tell
from sitl.camera.follow import run_follow
from sitl.course.layout import course_to_json, make_course
from sitl.errors import UsageError
from sitl.stopping import stop_on_signal
from sitl.vehicle.autopilot import VehicleConfig
from sitl.vehicle.conditions import NOMINAL, random_conditions


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; 2 for what the user got wrong."""
    parser = _parser()
    args = parser.parse_args(argv)
    try:
        if args.command == "course":
            return _print_course(args)
        if args.command == "camera":
            return _follow(args)
        return run_vehicle(_options(args))
    except UsageError as error:
        tell(f"error: {error}")
        return 2


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m sitl",
        description="A simulated ArduCopter over MAVLink, with an FPV camera in shared memory.",
        allow_abbrev=False,
    )
    parser.add_argument(
        "--connect",
        action="append",
        metavar="LINK",
        help="udpout:HOST:PORT, udpin:HOST:PORT or tcpin:HOST:PORT; repeat it for several links",
    )
    parser.add_argument(
        "--report", type=Path, metavar="FILE", help="write a JSON report at the end"
    )
    parser.add_argument("--duration", type=_positive, metavar="S", help="stop after this time")
    parser.add_argument(
        "--end-with-course",
        action="store_true",
        help="stop a second after the last gate, or at a crash",
    )
    parser.add_argument(
        "--receiver",
        choices=("idle", "none"),
        default="idle",
        help="RC receiver: idle sticks (default), or none at all",
    )
    parser.add_argument(
        "--conditions",
        type=_natural,
        metavar="SEED",
        help="another vehicle, firmware, wind, light, colours and lens by seed (default: nominal)",
    )
    _add_camera_flags(parser)
    commands = parser.add_subparsers(dest="command", metavar="")
    camera = commands.add_parser(
        "camera", help="film the course from another vehicle's reported pose", allow_abbrev=False
    )
    camera.add_argument("--follow", required=True, metavar="LINK", help="that vehicle's MAVLink")
    _add_camera_flags(camera)
    course = commands.add_parser("course", help="print a course", allow_abbrev=False)
    course.add_argument("--course", type=_natural, default=0, metavar="SEED")
    course.add_argument("--json", action="store_true", help="as JSON instead of a table")
    return parser


def _add_camera_flags(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--camera", type=_shm_name, metavar="shm:NAME", help="publish frames there")
    parser.add_argument("--course", type=_natural, default=0, metavar="SEED", help="gate course")
    parser.add_argument("--image-size", type=_image_size, default=224, metavar="PIXELS")
    parser.add_argument("--fps", type=_positive, default=30.0, metavar="HZ")


def _options(args: argparse.Namespace) -> RunOptions:
    if not args.connect:
        raise UsageError("no link: give at least one, such as --connect udpout:127.0.0.1:14550")
    return RunOptions(
        connect=tuple(args.connect),
        shm_name=args.camera,
        course_seed=args.course,
        image_size=args.image_size,
        fps=args.fps,
        report=args.report,
        duration_s=args.duration,
        vehicle=VehicleConfig(
            receiver=args.receiver == "idle",
            conditions=NOMINAL if args.conditions is None else random_conditions(args.conditions),
        ),
        end_with_course=args.end_with_course,
    )


def _follow(args: argparse.Namespace) -> int:
    if args.camera is None:
        raise UsageError("camera --follow needs --camera shm:NAME to publish to")
    with stop_on_signal() as stop:
        return run_follow(
            args.follow, args.camera, args.course, args.image_size, args.image_size, args.fps, stop
        )


def _print_course(args: argparse.Namespace) -> int:
    course = make_course(args.course)
    if args.json:
        sys.stdout.write(course_to_json(course) + "\n")
        return 0
    sys.stdout.write("gate  north_m  east_m  up_m  yaw_deg  size_m\n")
    for gate in course.gates:
        north, east, down = gate.center_ned_m
        sys.stdout.write(
            f"{gate.index:4d}  {north:7.1f}  {east:6.1f}  {-down:4.1f}  "
            f"{math.degrees(gate.yaw_rad):7.1f}  {gate.size_m:6.1f}\n"
        )
    return 0


def _positive(text: str) -> float:
    value = float(text)
    if not (math.isfinite(value) and value > 0.0):
        raise argparse.ArgumentTypeError(f"must be a positive number, got {text}")
    return value


def _natural(text: str) -> int:
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"must be 0 or more, got {text}")
    return value


def _image_size(text: str) -> int:
    value = int(text)
    if not 16 <= value <= 4096:
        raise argparse.ArgumentTypeError(f"must be within 16..4096 pixels, got {text}")
    return value


def _shm_name(text: str) -> str:
    prefix, _, name = text.partition(":")
    if prefix != "shm" or not name or "/" in name:
        raise argparse.ArgumentTypeError(f"must be shm:NAME, got {text}")
    return name


if __name__ == "__main__":
    sys.exit(main())
