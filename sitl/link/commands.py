"""COMMAND_LONG and COMMAND_INT: one handler a command, each ending in a MAV_RESULT."""

import math
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl.link.endpoint import MavlinkEndpoint
from sitl.vehicle.autopilot import Autopilot
from sitl.vehicle.flight_modes import Mode

ACCEPTED: int = mav.MAV_RESULT_ACCEPTED
DENIED: int = mav.MAV_RESULT_DENIED
UNSUPPORTED: int = mav.MAV_RESULT_UNSUPPORTED
FAILED: int = mav.MAV_RESULT_FAILED
FORCE = 21196.0  # param 2 of ARM_DISARM that overrules every check (MAVLink common.xml)
UINT16_MAX = 65535


class Command(NamedTuple):
    """A received command; ``params`` holds param1..7."""

    number: int
    params: tuple[float, ...]

    def finite(self, *numbers: int) -> bool:
        """True if all of these parameters (counted from 1) are finite numbers."""
        return all(math.isfinite(self.params[number - 1]) for number in numbers)


Handler: TypeAlias = Callable[[Command, Autopilot, MavlinkEndpoint], int]


def execute(command: Command, ap: Autopilot, link: MavlinkEndpoint) -> int:
    """Execute a command that came on a link; returns the MAV_RESULT for its ack."""
    handler = _HANDLERS.get(command.number)
    return UNSUPPORTED if handler is None else handler(command, ap, link)


def mode_by_number(number: float, ap: Autopilot) -> int:
    """Change to a custom mode; returns the MAV_RESULT."""
    try:
        mode = Mode(int(number))
    except ValueError:
        return FAILED
    return ACCEPTED if ap.set_mode(mode) else FAILED


def _arm_disarm(command: Command, ap: Autopilot, _link: MavlinkEndpoint) -> int:
    if not command.finite(1) or command.params[0] not in (0.0, 1.0):
        return UNSUPPORTED
    force = command.params[1] == FORCE
    done = ap.arm(force=force) if command.params[0] else ap.disarm(force=force)
    return ACCEPTED if done else FAILED


def _set_mode(command: Command, ap: Autopilot, _link: MavlinkEndpoint) -> int:
    if not command.finite(1, 2):
        return DENIED
    if not int(command.params[0]) & mav.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED:
        return DENIED
    return mode_by_number(command.params[1], ap)


def _set_interval(command: Command, _ap: Autopilot, link: MavlinkEndpoint) -> int:
    if not command.finite(1, 2) or command.params[2] != 0.0:
        return DENIED
    refusal = link.set_interval(int(command.params[0]), int(command.params[1]))
    if refusal is None:
        return ACCEPTED
    link.send_text(mav.MAV_SEVERITY_INFO, refusal)
    return DENIED


def _get_interval(command: Command, _ap: Autopilot, link: MavlinkEndpoint) -> int:
    if not command.finite(1) or not 0 <= command.params[0] <= UINT16_MAX:
        return DENIED
    link.send_interval(int(command.params[0]))
    return ACCEPTED


def _request_message(command: Command, ap: Autopilot, link: MavlinkEndpoint) -> int:
    if not command.finite(1):
        return DENIED
    if int(command.params[0]) == mav.MAVLINK_MSG_ID_MESSAGE_INTERVAL:
        return _get_interval(Command(command.number, command.params[1:]), ap, link)
    return ACCEPTED if link.send_now(int(command.params[0])) else FAILED


def _send(message_id: int) -> Handler:
    def handler(_command: Command, _ap: Autopilot, link: MavlinkEndpoint) -> int:
        link.send_now(message_id)
        return ACCEPTED

    return handler


def _reboot(command: Command, ap: Autopilot, link: MavlinkEndpoint) -> int:
    if command.params[0] != 1.0:
        return UNSUPPORTED
    if ap.armed:
        return FAILED
    link.reboot_requested = True
    return ACCEPTED


_HANDLERS: dict[int, Handler] = {
    mav.MAV_CMD_NAV_RETURN_TO_LAUNCH: lambda _command, ap, _link: mode_by_number(Mode.RTL, ap),
    mav.MAV_CMD_NAV_LAND: lambda _command, ap, _link: mode_by_number(Mode.LAND, ap),
    mav.MAV_CMD_DO_SET_MODE: _set_mode,
    mav.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN: _reboot,
    mav.MAV_CMD_COMPONENT_ARM_DISARM: _arm_disarm,
    mav.MAV_CMD_GET_HOME_POSITION: _send(mav.MAVLINK_MSG_ID_HOME_POSITION),
    mav.MAV_CMD_GET_MESSAGE_INTERVAL: _get_interval,
    mav.MAV_CMD_SET_MESSAGE_INTERVAL: _set_interval,
    mav.MAV_CMD_REQUEST_MESSAGE: _request_message,
    mav.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: _send(mav.MAVLINK_MSG_ID_AUTOPILOT_VERSION),
}
