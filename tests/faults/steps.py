"""Steps of a scenario.

A step is a function of the stage and the keys of its table. It returns the time of its fault in ns
of CLOCK_MONOTONIC, or None if it is none. ``do`` is its name, with spaces.
"""

import inspect
import os
import resource
import signal as signals
import socket
import struct
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as dialect

from faults.link import LOOPBACK, LinkFaults, SerialCarrier, UdpCarrier
from faults.processes import Process
from faults.relay import VEHICLE, Message, Override, set_fields
from faults.stage import Stage
from sitl import UsageError
from sitl.clock import NS_PER_MS, NS_PER_S
from sitl.simulated_vehicle import SimulatedVehicle
from sitl.vehicle.config import VehicleConfig

REBOOT_IN_FLIGHT = 20190226
"""Sixth parameter of MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN with which ArduPilot reboots while armed."""
STAMPS = {"time_boot_ms": NS_PER_S // NS_PER_MS, "time_usec": 1_000_000, "tc1": NS_PER_S}
"""Fields with the vehicle's time, and their units per second."""


def wait(stage: Stage, *, s: float) -> None:
    stage.observe(s)


def policy(stage: Stage) -> int:
    """Wait until the policy reports the start of its own fault."""
    return stage.fault_ns()


def ended(stage: Stage) -> int:
    """Wait until the policy has released the sticks by itself."""
    return stage.last_lean_ns()


def signal(stage: Stage, *, name: str, to: str = "flight") -> int:
    """Send a signal; ``group``: the flight process and its children, as a terminal sends it."""
    number = signals.Signals[name]
    if to == "recorder":
        return Process(stage.pid_of("recorder"), stage.clock).kill(number)
    kills = {"flight": stage.kill, "group": stage.kill_group, "guard": stage.guard.kill}
    return kills[to](number)


def terminal(stage: Stage) -> None:
    """Fill the terminal's pipe, which nothing reads any more."""
    stage.fill_output()


def limit(stage: Stage, *, of: str, at: int, to: str = "flight") -> int:
    """Limit a resource of a process (``prlimit(2)``): NOFILE open files, FSIZE bytes of a file (as
    on a full disk), AS address space."""
    at_ns, number, pid = stage.clock.now_ns(), getattr(resource, f"RLIMIT_{of}"), stage.pid_of(to)
    resource.prlimit(pid, number, (at, resource.prlimit(pid, number)[1]))
    return at_ns


def wall_clock(stage: Stage) -> int:
    """Step wall time by an hour, for a bridge that runs with ``catalogue/stepped_clock``."""
    (stage.folder / "stepped").touch()
    return stage.clock.now_ns()


def load(stage: Stage, *, s: float) -> int:
    """Load every core with other programs for a while."""
    at_ns, busy = stage.clock.now_ns(), [sys.executable, "-c", "while True: pass"]
    with ExitStack() as stack:
        for _ in range(os.cpu_count() or 1):
            hog = stack.enter_context(subprocess.Popen(busy))
            stack.callback(hog.kill)
        stage.observe(s)
    return at_ns


def viewer(stage: Stage, *, signal: str) -> int:
    """Send a signal to the viewer, which stops reading or dies."""
    if stage.viewer is None:
        raise UsageError("this flight has no viewer: --rerun {viewer} among its flags")
    at_ns = stage.clock.now_ns()
    stage.viewer.process.send_signal(signals.Signals[signal])
    return at_ns


def images(stage: Stage, *, show: str) -> int:
    """Change the camera's images from now on (``FrameFeed.show``)."""
    if stage.camera is None:
        raise UsageError("this flight has no camera that can be spoilt")
    return stage.camera.show(show)


def messages(
    stage: Stage, *, names: Sequence[str], do_with: str = "drop", field: str = "", value: float = 0
) -> int:
    """Drop, freeze or set a field (or all measurements) of the vehicle's messages."""
    frozen: dict[str, float] = {}

    def change(message: Message) -> bool:
        if message.get_type() not in names:
            return True
        if do_with == "drop":
            return False
        for name in [field] if field else _measured(message):
            if do_with == "freeze":
                set_fields(message, **{name: frozen.setdefault(name, getattr(message, name))})
            else:
                set_fields(message, **{name: value})
        return True

    return stage.relay.rewrite(change)


def _measured(message: Message) -> list[str]:
    """Return the names of numeric fields other than times."""
    names = [n for n in message.get_fieldnames() if isinstance(getattr(message, n), int | float)]
    return [name for name in names if not name.startswith("time")]


def clock(stage: Stage, *, s: float) -> int:
    """Step the vehicle's clock in every message that carries it."""

    def change(message: Message) -> bool:
        for name, units in STAMPS.items():
            if stamp := getattr(message, name, 0):
                set_fields(message, **{name: max(1, stamp + round(s * units))})
        return True

    return stage.relay.rewrite(change)


def pilot(stage: Stage, *, act: str, mode: str = "") -> int:
    """Change the mode, arm, disarm or reboot the vehicle from another station."""
    relay = stage.relay
    if act == "mode":
        return relay.set_mode(mode)
    if act == "reboot":
        number, relay.has_rebooted = dialect.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, True
        return relay.command(number, 1, 0, 0, 0, 0, REBOOT_IN_FLIGHT)
    return {"arm": relay.arm, "disarm": relay.disarm}[act]()


def joystick(stage: Stage, *, hz: float, s: float) -> int:
    """Send sticks of another program with the bridge's system id; return the first's time."""
    sticks = Override(roll=1400, pitch=1500, throttle=1500, yaw=1500)
    began_ns = stage.relay.move_joystick(sticks, is_manual=stage.is_px4)
    for _ in range(round(s * hz)):
        stage.observe(1 / hz)
        stage.relay.move_joystick(sticks, is_manual=stage.is_px4)
    return began_ns


def param(stage: Stage, *, name: str, value: float) -> int:
    """Set a parameter of the vehicle from another station."""
    config = VehicleConfig(autopilot="px4" if stage.is_px4 else "ardupilot")
    kind = SimulatedVehicle(links=0, boot_ns=0, config=config).params.on_wire(name)[1]
    if kind == dialect.MAV_PARAM_TYPE_INT32:
        (value,) = struct.unpack("<f", struct.pack("<i", int(value)))
    message = dialect.MAVLink_param_set_message(*VEHICLE, name.encode(), value, kind)
    return stage.relay.inject(message)


def switch(stage: Stage, *, channel: int, us: int) -> int:
    """Move a stick or a switch of the transmitter, which the scenario must have."""
    at_ns = stage.clock.now_ns()
    stage.transmitter.move(channel, us)
    return at_ns


def radio(stage: Stage) -> int:
    """Cut the transmitter's signal to the receiver."""
    at_ns = stage.clock.now_ns()
    stage.transmitter.switch_off()
    return at_ns


def link(
    stage: Stage, *, way: str = "both", ramp_s: float = 0, ramp_steps: int = 1, **faults: float
) -> int:
    """Impair the link from now on by ``LinkFaults``; without faults, restore it.

    With ``ramp_s`` the delay grows in ``ramp_steps`` equal steps, so that no packet is much later
    than the one before.
    """
    last, moments = LinkFaults(**faults), []
    for step_number in range(1, ramp_steps + 1):
        if moments:
            stage.observe(ramp_s / ramp_steps)
        now = replace(last, delay_ms=last.delay_ms * step_number / ramp_steps)
        moments.append(stage.relay.impair(way, now))
    return moments[0]


def silence(stage: Stage, *, s: float, way: str = "both") -> int:
    """Lose every packet for a while; then restore the link."""
    began_ns = link(stage, way=way, loss=1.0)
    stage.observe(s)
    link(stage, way=way)
    return began_ns


def broken(stage: Stage, *, s: float = 0.0) -> int:
    """Break the link in the way of its kind (``Carrier.fail``), after a silence of ``s``."""
    began_ns = link(stage, loss=1.0) if s else stage.clock.now_ns()
    stage.observe(s)
    stage.relay.carrier.fail()
    if s:
        link(stage)
    return began_ns


def unread(stage: Stage, *, s: float) -> int:
    """Stop reading at the vehicle's end of a serial port for a while."""
    carrier = stage.relay.carrier
    if not isinstance(carrier, SerialCarrier):
        raise UsageError('this flight has no serial port: carrier = "serial" gives it one')
    began_ns = stage.clock.now_ns()
    carrier.is_read = False
    stage.observe(s)
    carrier.is_read = True
    return began_ns


def duplicate_system(stage: Stage, *, s: float, hz: float = 10.0) -> int:
    """Send to the bridge as another, disarmed vehicle of the same system id, from its own port."""
    carrier = stage.relay.carrier
    if not isinstance(carrier, UdpCarrier):
        raise UsageError("only with UDP can a second vehicle send to the bridge")
    other = dialect.MAVLink(None, srcSystem=VEHICLE[0], srcComponent=VEHICLE[1])
    kind = dialect.MAV_AUTOPILOT_PX4 if stage.is_px4 else dialect.MAV_AUTOPILOT_ARDUPILOTMEGA
    heartbeat = dialect.MAVLink_heartbeat_message(dialect.MAV_TYPE_QUADROTOR, kind, 0, 0, 4, 3)
    began_ns = stage.clock.now_ns()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.bind((LOOPBACK, 0))
        for _ in range(round(s * hz)):
            boot_ms = stage.clock.now_ns() // NS_PER_MS % 2**32
            attitude = dialect.MAVLink_attitude_message(boot_ms, 0.5, 0.5, 0, 0, 0, 0)
            sender.sendto(heartbeat.pack(other) + attitude.pack(other), carrier.bridge)
            stage.observe(1 / hz)
    return began_ns


def rates(stage: Stage, *, hz: float, names: Sequence[str]) -> int:
    """Request few messages as a ground station."""
    relay, began_ns = stage.relay, stage.clock.now_ns()
    for name in names:
        number = getattr(dialect, f"MAVLINK_MSG_ID_{name}")
        relay.command(dialect.MAV_CMD_SET_MESSAGE_INTERVAL, number, 1e6 / hz)
    return began_ns


KINDS = {
    function.__name__.replace("_", " "): function
    for function in (
        *(wait, policy, ended, signal, terminal, limit, wall_clock, load, viewer, images, messages),
        *(clock, pilot, joystick, param, switch, radio, link, silence, broken),
        *(unread, duplicate_system, rates),
    )
}


class Step(NamedTuple):
    """One step of a scenario."""

    do: str
    perform: Callable[[Stage], int | None]


def make_step(table: Mapping[str, Any], where: str) -> Step:
    """Make a step from a table; raise UsageError for an unknown kind or key, or a missing key."""
    keys = dict(table)
    name = str(keys.pop("do", None))
    if name not in KINDS:
        raise UsageError(f"{where}: do = {name!r} is none of {', '.join(KINDS)}")
    try:
        bound = inspect.signature(KINDS[name]).bind(None, **keys)
        LinkFaults(**bound.arguments.get("faults", {}))
    except TypeError as error:
        raise UsageError(f"{where}: {name}: {error}") from error
    return Step(name, partial(KINDS[name], **keys))
