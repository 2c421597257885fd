"""COMMAND_LONG and COMMAND_INT: one handler a command, each ending in a MAV_RESULT."""

import math
from collections.abc import Callable
from typing import TypeAlias

from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl.ardupilot.autopilot import Autopilot
from sitl.ardupilot.flight_modes import Mode
from sitl.ardupilot.link.endpoint import MavlinkEndpoint
from sitl.ardupilot.simple import Axes

ACCEPTED: int = mav.MAV_RESULT_ACCEPTED
DENIED: int = mav.MAV_RESULT_DENIED
UNSUPPORTED: int = mav.MAV_RESULT_UNSUPPORTED
FAILED: int = mav.MAV_RESULT_FAILED
FORCE = 21196.0  # param 2 of ARM_DISARM that overrules every check (MAVLink common.xml)
FORCE_REBOOT = 20190226.0  # param 6 of PREFLIGHT_REBOOT_SHUTDOWN: also while armed (ArduPilot)
UINT16_MAX = 65535
SIMPLE_MODE, SWITCH_LOW = 3.0, 0.0  # params of DO_AUX_FUNCTION

Params7: TypeAlias = tuple[float, ...]  # param1..7 of a command, the first at index 0
Handler: TypeAlias = Callable[[Params7, Autopilot, MavlinkEndpoint], int]


def execute(number: int, params: Params7, ap: Autopilot, link: MavlinkEndpoint) -> int:
    """Execute a command that came on a link; returns the MAV_RESULT for its ack."""
    handler = _HANDLERS.get(number)
    return UNSUPPORTED if handler is None else handler(params, ap, link)


def mode_by_number(number: float, ap: Autopilot) -> int:
    """Change to a custom mode; returns the MAV_RESULT."""
    try:
        mode = Mode(int(number))
    except ValueError:
        return FAILED
    return ACCEPTED if ap.set_mode(mode) else FAILED


def _are_finite(params: Params7) -> bool:
    return all(map(math.isfinite, params))


def _arm_disarm(params: Params7, ap: Autopilot, _link: MavlinkEndpoint) -> int:
    if params[0] not in (0.0, 1.0):
        return UNSUPPORTED
    force = params[1] == FORCE
    done = ap.arm(force=force) if params[0] else ap.disarm(force=force)
    return ACCEPTED if done else FAILED


def _set_mode(params: Params7, ap: Autopilot, _link: MavlinkEndpoint) -> int:
    if not _are_finite(params[:2]):
        return DENIED
    if not int(params[0]) & mav.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED:
        return DENIED
    return mode_by_number(params[1], ap)


def _set_interval(params: Params7, _ap: Autopilot, link: MavlinkEndpoint) -> int:
    if not _are_finite(params[:2]) or params[2] != 0.0:
        return DENIED
    refusal = link.set_interval(int(params[0]), int(params[1]))
    if refusal is None:
        return ACCEPTED
    link.send_text(mav.MAV_SEVERITY_INFO, refusal)
    return DENIED


def _get_interval(params: Params7, _ap: Autopilot, link: MavlinkEndpoint) -> int:
    if not _are_finite(params[:1]) or not 0 <= params[0] <= UINT16_MAX:
        return DENIED
    link.send_interval(int(params[0]))
    return ACCEPTED


def _request_message(params: Params7, ap: Autopilot, link: MavlinkEndpoint) -> int:
    if not _are_finite(params[:1]):
        return DENIED
    if int(params[0]) == mav.MAVLINK_MSG_ID_MESSAGE_INTERVAL:
        return _get_interval(params[1:], ap, link)
    return ACCEPTED if link.send_now(int(params[0])) else FAILED


def _take_off(params: Params7, ap: Autopilot, _link: MavlinkEndpoint) -> int:
    height_m = params[6]
    return ACCEPTED if math.isfinite(height_m) and ap.take_off(height_m) else FAILED


def _aux_function(params: Params7, ap: Autopilot, _link: MavlinkEndpoint) -> int:
    """Simple mode off is the one function that this vehicle takes from a command."""
    if params[:2] != (SIMPLE_MODE, SWITCH_LOW):
        return FAILED
    ap.simple.axes = Axes.VEHICLE
    return ACCEPTED


def _send(message_id: int) -> Handler:
    def handler(_params: Params7, _ap: Autopilot, link: MavlinkEndpoint) -> int:
        link.send_now(message_id)
        return ACCEPTED

    return handler


def _reboot(params: Params7, ap: Autopilot, link: MavlinkEndpoint) -> int:
    if ap.armed and params[5] != FORCE_REBOOT:
        return FAILED
    if params[0] not in (1.0, 3.0):
        return UNSUPPORTED
    link.reboot_requested = True
    return ACCEPTED


_HANDLERS: dict[int, Handler] = {
    mav.MAV_CMD_NAV_RETURN_TO_LAUNCH: lambda _params, ap, _link: mode_by_number(Mode.RTL, ap),
    mav.MAV_CMD_NAV_TAKEOFF: _take_off,
    mav.MAV_CMD_NAV_LAND: lambda _params, ap, _link: mode_by_number(Mode.LAND, ap),
    mav.MAV_CMD_DO_SET_MODE: _set_mode,
    mav.MAV_CMD_DO_AUX_FUNCTION: _aux_function,
    mav.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN: _reboot,
    mav.MAV_CMD_COMPONENT_ARM_DISARM: _arm_disarm,
    mav.MAV_CMD_GET_HOME_POSITION: _send(mav.MAVLINK_MSG_ID_HOME_POSITION),
    mav.MAV_CMD_GET_MESSAGE_INTERVAL: _get_interval,
    mav.MAV_CMD_SET_MESSAGE_INTERVAL: _set_interval,
    mav.MAV_CMD_REQUEST_MESSAGE: _request_message,
    mav.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: _send(mav.MAVLINK_MSG_ID_AUTOPILOT_VERSION),
}
