"""Ways to end a flight that leans under its policy."""

from collections.abc import Callable

from pymavlink.dialects.v20 import ardupilotmega as dialect

from helpers.output_flights import OutputFlight
from mavbridge.core.clock import NS_PER_S
from sitl.ardupilot.flight_modes import Mode as ArduMode
from sitl.px4.modes import Phase as LostPhase

FORCE = 21196
"""Parameter 2 of a disarming that is not refused in flight."""
RAMP_S = 0.3


def later(flight: OutputFlight, seconds: float, act: Callable[[], object]) -> None:
    """Call ``act`` after this time."""
    flight.clock.schedule(flight.clock.now_ns() + round(seconds * NS_PER_S), act)


def death(flight: OutputFlight) -> None:
    flight.die()


def hang(flight: OutputFlight) -> None:
    """Stop the flight process for a second, and let it continue."""
    flight.is_flight_process_stopped = True

    def go_on() -> None:
        flight.is_flight_process_stopped = False

    later(flight, 1.0, go_on)


def not_a_number(flight: OutputFlight) -> None:
    flight.return_nan()


def stick_ramp(flight: OutputFlight) -> None:
    """Move another station's joystick: centred for half a second, then a fast ramp."""
    period_s = 0.02
    for step in range(200):
        share = min(max(step * period_s - 0.5, 0.0) / RAMP_S, 1.0)
        x = round(800 * share)
        later(flight, step * period_s, lambda x=x: joystick(flight, x))  # type: ignore[misc]


def joystick(flight: OutputFlight, x: int) -> None:
    """Send one MANUAL_CONTROL of another station over a separate link."""
    flight.station(lambda mav: mav.manual_control_encode(1, x, 0, 500, 0, 0), system=42)


def disarming(flight: OutputFlight) -> None:
    flight.command(dialect.MAV_CMD_COMPONENT_ARM_DISARM, 0, FORCE)


def deaf_guard(flight: OutputFlight) -> None:
    """Lose all messages of the vehicle for two seconds."""
    _silence(flight, up_s=0.0, down_s=2.0)


def deaf_vehicle_short(flight: OutputFlight) -> None:
    """Lose all messages to the vehicle for 0.3 s."""
    _silence(flight, up_s=0.3, down_s=0.0)


def deaf_vehicle(flight: OutputFlight) -> None:
    """Lose all messages to the vehicle for 1.5 s."""
    _silence(flight, up_s=1.5, down_s=0.0)


def cut_link(flight: OutputFlight) -> None:
    """Lose all messages in both directions for 1.5 s."""
    _silence(flight, up_s=1.5, down_s=1.5)


def _silence(flight: OutputFlight, *, up_s: float, down_s: float) -> None:
    for direction, seconds in ((flight.up, up_s), (flight.down, down_s)):
        direction.is_silent = seconds > 0

        def speak(direction=direction) -> None:  # type: ignore[no-untyped-def]
            direction.is_silent = False

        later(flight, seconds, speak)


def end(flight: OutputFlight) -> None:
    """End the flight process as by SIGTERM or Ctrl-C."""
    flight.stop()


def failsafe(flight: OutputFlight) -> None:
    """Change the mode by a failsafe of the vehicle itself."""
    if flight.is_px4:
        flight.px4.commander.lost_sticks.phase = LostPhase.ACTING
    else:
        flight.ardupilot.gcs_failsafe.active = True
        flight.ardupilot.set_mode(ArduMode.RTL)


def death_without_position(flight: OutputFlight) -> None:
    """Kill the flight process while modes that hold a position are refused."""
    flight.lose_position()
    later(flight, 0.05, flight.die)
