"""Commands for mode and arming: not too often, and what the vehicle answers to them."""

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.mavlink.codec.messages import CommandAck, CommandRequest

_ARM_SPACING_NS = NS_PER_S
"""Each refused request to arm prints the vehicle's reason."""
_MODE_SPACING_NS = 50 * NS_PER_MS
"""A guard: who asks decides how often, and on the way out of a flight a lost request must cost no
second."""
_SET_MODE = dialect.MAV_CMD_DO_SET_MODE
_ARM = dialect.MAV_CMD_COMPONENT_ARM_DISARM
_FORGET_NS = 3 * NS_PER_S
"""A refusal counts no longer once the mode was not asked for during this time."""


def mode_request(numbers: tuple[int, int]) -> CommandRequest:
    """The request for a mode by its two numbers."""
    return CommandRequest(_SET_MODE, (dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, *numbers))


class ModeAndArm:
    """Requests of a mode or of arming, each not too soon after the same one before."""

    def __init__(self) -> None:
        self._sent: dict[int, tuple[int, CommandRequest]] = {}
        self._mode: str | None = None
        self._explained_ns: int | None = None
        self.refused_mode: str | None = None
        """Mode that was asked for last and that the vehicle has refused, or None."""

    def set_mode(self, mode: str, numbers: tuple[int, int], now_ns: int) -> CommandRequest | None:
        """The request for a mode, unless it was sent just now."""
        last_ns = self._sent[_SET_MODE][0] if _SET_MODE in self._sent else now_ns
        if mode != self._mode or now_ns - last_ns > _FORGET_NS:
            self._mode, self.refused_mode = mode, None
        return self._request(mode_request(numbers), now_ns, _MODE_SPACING_NS)

    def arm(self, now_ns: int) -> CommandRequest | None:
        """The request to arm, unless it was sent just now."""
        return self._request(CommandRequest(_ARM, (1,)), now_ns, _ARM_SPACING_NS)

    def takeoff(self, request: CommandRequest, now_ns: int) -> CommandRequest | None:
        """The request to take off, unless one was sent just now, to whatever height."""
        last_ns, _ = self._sent.get(request.command, (None, None))
        if last_ns is not None and now_ns - last_ns < _ARM_SPACING_NS:
            return None
        self._sent[request.command] = now_ns, request
        return request

    def is_time_to_explain(self, now_ns: int) -> bool:
        """Why nothing can be asked for is said again, every three seconds."""
        if self._explained_ns is not None and now_ns - self._explained_ns < _FORGET_NS:
            return False
        self._explained_ns = now_ns
        return True

    def _request(
        self, request: CommandRequest, now_ns: int, spacing_ns: int
    ) -> CommandRequest | None:
        last_ns, last = self._sent.get(request.command, (0, None))
        if request == last and now_ns - last_ns < spacing_ns:
            return None
        self._sent[request.command] = now_ns, request
        return request

    def receive(self, ack: CommandAck) -> str | None:
        """Take an ack; returns a refusal in words for the user."""
        if ack.command not in self._sent or ack.result == dialect.MAV_RESULT_IN_PROGRESS:
            return None
        is_accepted = ack.result == dialect.MAV_RESULT_ACCEPTED
        if ack.command == _SET_MODE:
            self.refused_mode = None if is_accepted else self._mode
        if is_accepted:
            return None
        command = dialect.enums["MAV_CMD"][ack.command].name.removeprefix("MAV_CMD_")
        result = dialect.enums["MAV_RESULT"].get(ack.result)
        reason = result.name.removeprefix("MAV_RESULT_") if result else ack.result
        return f"the vehicle answered {command} with {reason}"
