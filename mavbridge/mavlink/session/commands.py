"""Commands for mode, arming and takeoff, and the vehicle's answers to them."""

from collections.abc import Callable

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.core.clock import Clock
from mavbridge.core.vehicle import AdviceText
from mavbridge.mavlink.codec.messages import CommandAck, CommandRequest
from mavbridge.mavlink.session.vehicle import VehicleSession

_SET_MODE = dialect.MAV_CMD_DO_SET_MODE
_ARM = dialect.MAV_CMD_COMPONENT_ARM_DISARM


class VehicleCommands:
    """Requests to the present vehicle, as often as the caller makes them."""

    def __init__(
        self,
        send: Callable[[CommandRequest], None],
        report: Callable[[str], None],
        clock: Clock,
    ) -> None:
        self._send, self._report, self._clock = send, report, clock
        self._vehicle: VehicleSession | None = None
        self._sent: set[int] = set()
        """Commands that the vehicle has got from us."""
        self._mode: str | None = None
        self.refused_mode: str | None = None
        """Mode of the last request if the vehicle has refused it, else None."""

    def adopt(self, vehicle: VehicleSession) -> None:
        """Switch to a new session of the vehicle, to which nothing was sent yet."""
        self._vehicle, self._mode, self.refused_mode = vehicle, None, None
        self._sent.clear()

    def set_mode(self, mode: str) -> None:
        """Request a flight mode.

        Raises:
            UserError: the vehicle has no mode of this name.
        """
        if self._vehicle is not None:
            request = self._vehicle.profile.modes.command(mode)
            self._mode, self.refused_mode = mode, None
            self._request(request)

    def arm(self) -> None:
        """Request arming."""
        self._request(CommandRequest(_ARM, (1,)))

    def takeoff(self, height_m: float) -> None:
        """Request an autonomous takeoff to a height above ground."""
        if self._vehicle is None:
            return
        now_ns = self._clock.now_ns()
        request = self._vehicle.profile.takeoff(height_m, self._vehicle.condition.amsl_m(now_ns))
        if request is not None:
            self._request(request)
        else:
            unknown = "no takeoff yet: the vehicle does not tell its height above the sea"
            self._report(AdviceText(unknown))

    def _request(self, request: CommandRequest) -> None:
        self._sent.add(request.command)
        self._send(request)

    def receive(self, ack: CommandAck) -> None:
        """Process an ack; report a refusal to the user."""
        if ack.command not in self._sent or ack.result == dialect.MAV_RESULT_IN_PROGRESS:
            return
        is_accepted = ack.result == dialect.MAV_RESULT_ACCEPTED
        if ack.command == _SET_MODE:
            self.refused_mode = None if is_accepted else self._mode
        if is_accepted:
            return
        command = dialect.enums["MAV_CMD"][ack.command].name.removeprefix("MAV_CMD_")
        result = dialect.enums["MAV_RESULT"].get(ack.result)
        reason = result.name.removeprefix("MAV_RESULT_") if result else ack.result
        self._report(f"the vehicle answered {command} with {reason}")
