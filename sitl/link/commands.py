"""COMMAND_LONG and COMMAND_INT: one function a command, each ending in a MAV_RESULT."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl.vehicle.autopilot import Autopilot
from sitl.vehicle.flight_modes import Mode

FORCE = 21196.0
"""Param 2 of ARM_DISARM that overrules every check (MAVLink common.xml)."""
UINT16_MAX = 65535


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """A command as it came in; ``params`` holds param1..7."""

    number: int
    params: tuple[float, ...]

    def finite(self, *numbers: int) -> bool:
        """Whether all of these parameters (counted from 1) are numbers."""
        return all(math.isfinite(self.params[number - 1]) for number in numbers)


class Requester(Protocol):
    """What commands need of the link that they came on."""

    def set_interval(self, message_id: int, interval_us: int) -> str | None:
        """Change a stream; the reason if refused."""
        ...

    def send_interval(self, message_id: int) -> None:
        """Send MESSAGE_INTERVAL."""
        ...

    def send_now(self, message_id: int) -> bool:
        """Send one message now; False if it is unknown."""
        ...

    def say(self, severity: int, text: str) -> None:
        """Send a STATUSTEXT on this link."""
        ...

    def reboot(self) -> None:
        """Ask for a reboot after this command."""
        ...


def execute(command: Command, ap: Autopilot, link: Requester) -> int:
    """Carry the command out; the MAV_RESULT for its ack."""
    handler = _HANDLERS.get(command.number)
    return mav.MAV_RESULT_UNSUPPORTED if handler is None else handler(command, ap, link)


def mode_by_number(number: float, ap: Autopilot) -> int:
    """Change to a custom mode; the MAV_RESULT."""
    try:
        mode = Mode(int(number))
    except ValueError:
        return int(mav.MAV_RESULT_FAILED)
    return int(mav.MAV_RESULT_ACCEPTED if ap.set_mode(mode) else mav.MAV_RESULT_FAILED)


def _arm_disarm(command: Command, ap: Autopilot, link: Requester) -> int:
    if not command.finite(1) or command.params[0] not in (0.0, 1.0):
        return int(mav.MAV_RESULT_UNSUPPORTED)
    force = command.params[1] == FORCE
    done = ap.arm(force=force) if command.params[0] else ap.disarm(force=force)
    return int(mav.MAV_RESULT_ACCEPTED if done else mav.MAV_RESULT_FAILED)


def _set_mode(command: Command, ap: Autopilot, link: Requester) -> int:
    if not command.finite(1, 2):
        return int(mav.MAV_RESULT_DENIED)
    if not int(command.params[0]) & mav.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED:
        return int(mav.MAV_RESULT_DENIED)
    return mode_by_number(command.params[1], ap)


def _land(command: Command, ap: Autopilot, link: Requester) -> int:
    return mode_by_number(Mode.LAND, ap)


def _return_to_launch(command: Command, ap: Autopilot, link: Requester) -> int:
    return mode_by_number(Mode.RTL, ap)


def _set_interval(command: Command, ap: Autopilot, link: Requester) -> int:
    if not command.finite(1, 2) or command.params[2] != 0.0:
        return int(mav.MAV_RESULT_DENIED)
    refusal = link.set_interval(int(command.params[0]), int(command.params[1]))
    if refusal is None:
        return int(mav.MAV_RESULT_ACCEPTED)
    link.say(mav.MAV_SEVERITY_INFO, refusal)
    return int(mav.MAV_RESULT_DENIED)


def _get_interval(command: Command, ap: Autopilot, link: Requester) -> int:
    if not command.finite(1) or not 0 <= command.params[0] <= UINT16_MAX:
        return int(mav.MAV_RESULT_DENIED)
    link.send_interval(int(command.params[0]))
    return int(mav.MAV_RESULT_ACCEPTED)


def _request_message(command: Command, ap: Autopilot, link: Requester) -> int:
    if not command.finite(1):
        return int(mav.MAV_RESULT_DENIED)
    if int(command.params[0]) == mav.MAVLINK_MSG_ID_MESSAGE_INTERVAL:
        return _get_interval(Command(number=command.number, params=command.params[1:]), ap, link)
    sent = link.send_now(int(command.params[0]))
    return int(mav.MAV_RESULT_ACCEPTED if sent else mav.MAV_RESULT_FAILED)


def _sender_of(message_id: int) -> Callable[[Command, Autopilot, Requester], int]:
    def send(command: Command, ap: Autopilot, link: Requester) -> int:
        link.send_now(message_id)
        return int(mav.MAV_RESULT_ACCEPTED)

    return send


def _reboot(command: Command, ap: Autopilot, link: Requester) -> int:
    if command.params[0] != 1.0:
        return int(mav.MAV_RESULT_UNSUPPORTED)
    if ap.armed:
        return int(mav.MAV_RESULT_FAILED)
    link.reboot()
    return int(mav.MAV_RESULT_ACCEPTED)


_HANDLERS: dict[int, Callable[[Command, Autopilot, Requester], int]] = {
    mav.MAV_CMD_NAV_RETURN_TO_LAUNCH: _return_to_launch,
    mav.MAV_CMD_NAV_LAND: _land,
    mav.MAV_CMD_DO_SET_MODE: _set_mode,
    mav.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN: _reboot,
    mav.MAV_CMD_COMPONENT_ARM_DISARM: _arm_disarm,
    mav.MAV_CMD_GET_HOME_POSITION: _sender_of(mav.MAVLINK_MSG_ID_HOME_POSITION),
    mav.MAV_CMD_GET_MESSAGE_INTERVAL: _get_interval,
    mav.MAV_CMD_SET_MESSAGE_INTERVAL: _set_interval,
    mav.MAV_CMD_REQUEST_MESSAGE: _request_message,
    mav.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: _sender_of(mav.MAVLINK_MSG_ID_AUTOPILOT_VERSION),
}
