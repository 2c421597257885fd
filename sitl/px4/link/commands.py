"""COMMAND_LONG and COMMAND_INT: one handler a command, each ending in a MAV_RESULT or silence."""

import math
from collections.abc import Callable
from typing import TypeAlias

from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl.px4.autopilot import Autopilot
from sitl.px4.link.endpoint import MavlinkEndpoint
from sitl.px4.link.messages import HOME
from sitl.px4.modes import Mode, mode_of

ACCEPTED: int = mav.MAV_RESULT_ACCEPTED
REJECTED: int = mav.MAV_RESULT_TEMPORARILY_REJECTED
DENIED: int = mav.MAV_RESULT_DENIED
UNSUPPORTED: int = mav.MAV_RESULT_UNSUPPORTED
FAILED: int = mav.MAV_RESULT_FAILED
FORCE = 21196.0  # param 2 of ARM_DISARM that overrules a refusal to disarm (MAVLink common.xml)

Params7: TypeAlias = tuple[float, ...]  # param1..7 of a command, the first at index 0
Handler: TypeAlias = Callable[[Params7, Autopilot, MavlinkEndpoint], int | None]


def execute(number: int, params: Params7, ap: Autopilot, link: MavlinkEndpoint) -> int | None:
    """Execute a command that came on a link; the MAV_RESULT for its ack, or None for no ack."""
    handler = _HANDLERS.get(number)
    return UNSUPPORTED if handler is None else handler(params, ap, link)


def change_mode(base_mode: float, main: float, sub: float, ap: Autopilot, *, says_why: bool) -> int:
    """Change to a custom mode; returns the MAV_RESULT.

    A refusal becomes a text only if ``says_why``: PX4 explains itself to ground stations alone.
    """
    if not all(map(math.isfinite, (base_mode, main, sub))):
        return REJECTED
    mode = mode_of(int(main), int(sub))
    if not int(base_mode) & mav.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED or mode is None:
        return REJECTED
    return _to_mode(mode, ap, says_why=says_why)


def _to_mode(mode: Mode, ap: Autopilot, *, says_why: bool = True) -> int:
    if mode is Mode.AUTO_TAKEOFF:
        ap.prepare_takeoff(None)
    return ACCEPTED if ap.commander.set_mode(mode, says_why=says_why) else REJECTED


def _arm_disarm(params: Params7, ap: Autopilot, _link: MavlinkEndpoint) -> int | None:
    if params[0] not in (0.0, 1.0):
        return None
    force = params[1] == FORCE
    done = ap.commander.arm() if params[0] else ap.commander.disarm(force=force)
    return ACCEPTED if done else REJECTED


def _takeoff(params: Params7, ap: Autopilot, _link: MavlinkEndpoint) -> int:
    """Param 7 is an altitude above sea level; NaN: MIS_TAKEOFF_ALT above here."""
    height_m = params[6] - HOME.alt_m
    ap.prepare_takeoff(height_m if math.isfinite(height_m) else None)
    return ACCEPTED if ap.commander.set_mode(Mode.AUTO_TAKEOFF) else REJECTED


def _set_interval(params: Params7, _ap: Autopilot, link: MavlinkEndpoint) -> int:
    is_plain = params[2] in (0.0,) and params[6] in (0.0,)
    if not is_plain or not all(map(math.isfinite, params[:2])):
        return FAILED
    return ACCEPTED if link.set_interval(int(params[0]), int(params[1])) else FAILED


def _get_interval(params: Params7, _ap: Autopilot, link: MavlinkEndpoint) -> int:
    if not math.isfinite(params[0]) or not 0 <= params[0] <= 0xFFFF:
        return FAILED
    link.send_interval(int(params[0]))
    return ACCEPTED


def _request_message(params: Params7, _ap: Autopilot, link: MavlinkEndpoint) -> int:
    is_known = math.isfinite(params[0]) and link.send_now(int(params[0]))
    return ACCEPTED if is_known else DENIED


def _terminate(params: Params7, ap: Autopilot, _link: MavlinkEndpoint) -> int:
    if params[0] > 0.5:
        ap.commander.terminate()
    return ACCEPTED


def _reboot(params: Params7, _ap: Autopilot, _link: MavlinkEndpoint) -> int:
    """Zero asks for nothing; a reboot is refused while armed, and always in SITL."""
    return ACCEPTED if math.isfinite(params[0]) and int(params[0]) == 0 else DENIED


def _go(mode: Mode) -> Handler:
    return lambda _params, ap, _link: _to_mode(mode, ap)


_HANDLERS: dict[int, Handler] = {
    mav.MAV_CMD_NAV_RETURN_TO_LAUNCH: _go(Mode.AUTO_RTL),
    mav.MAV_CMD_NAV_LAND: _go(Mode.AUTO_LAND),
    mav.MAV_CMD_NAV_TAKEOFF: _takeoff,
    mav.MAV_CMD_DO_FLIGHTTERMINATION: _terminate,
    mav.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN: _reboot,
    mav.MAV_CMD_COMPONENT_ARM_DISARM: _arm_disarm,
    mav.MAV_CMD_GET_MESSAGE_INTERVAL: _get_interval,
    mav.MAV_CMD_SET_MESSAGE_INTERVAL: _set_interval,
    mav.MAV_CMD_REQUEST_MESSAGE: _request_message,
}
