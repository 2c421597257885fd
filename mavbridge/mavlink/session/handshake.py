"""From the first heartbeat to a vehicle that can be flown: parameters, calibration, streams.

A state machine without I/O. It is stepped by the link at every tick, so connecting, reconnecting
and a rebooted vehicle are the same thing, and the action loop never waits for any of it.
"""

from collections.abc import Iterator

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.errors import PeerError
from mavbridge.mavlink.codec.calibration import RcCalibration
from mavbridge.mavlink.codec.messages import AutopilotVersion, CommandAck, ParamValue
from mavbridge.mavlink.codec.requests import AskCommand, Request
from mavbridge.mavlink.session import params
from mavbridge.mavlink.session.streams import StreamGroup, StreamKeeper, message_id

_VERSION_TIMEOUT_NS = 400 * NS_PER_MS
_VERSION_ATTEMPTS = 4


class Handshake:
    """Version, then parameters (where the output needs them), then streams, which it keeps up."""

    def __init__(self, *, needs_calibration: bool, wanted: tuple[StreamGroup, ...]) -> None:
        self._needs_calibration = needs_calibration
        self._reader = params.ParamReader(params.FIRST_NAMES if needs_calibration else ())
        self._asked_channels = False
        self._version_attempts = 0
        self._version_asked_ns: int | None = None
        self.version: str | None = None
        self.calibration: RcCalibration | None = None
        self.values: dict[str, float] = {}
        self.streams = StreamKeeper(wanted)

    @property
    def problem(self) -> str | None:
        """What is still missing, or None."""
        if self._needs_calibration and self.calibration is None:
            return "reading the vehicle's radio calibration"
        if not self.streams.settled and self.streams.renewals == 0:
            return "asking the vehicle for telemetry"
        return None

    def receive_param(self, param: ParamValue) -> None:
        """Take a parameter."""
        self._reader.receive(param)

    def receive_version(self, message: AutopilotVersion) -> None:
        """Take the autopilot's version."""
        self.version = message.version

    def receive_ack(self, ack: CommandAck) -> None:
        """Take an acknowledgement."""
        self.streams.receive_ack(ack)

    def step(self, now_ns: int) -> Iterator[Request]:
        """What to send now.

        Raises:
            PeerError: the vehicle cannot be flown as it is set up.
        """
        yield from self._ask_version(now_ns)
        # Streams come after parameters: a vehicle slows its streams down while it sends those.
        if self._needs_calibration and self.calibration is None:
            yield from self._reader.step(now_ns)
            self._advance_params()
            return
        if (request := self.streams.step(now_ns)) is not None:
            yield request

    def _ask_version(self, now_ns: int) -> Iterator[Request]:
        if self.version is not None or self._version_attempts >= _VERSION_ATTEMPTS:
            return
        asked_ns = self._version_asked_ns
        if asked_ns is not None and now_ns - asked_ns < _VERSION_TIMEOUT_NS:
            return
        self._version_asked_ns = now_ns
        self._version_attempts += 1
        yield AskCommand(dialect.MAV_CMD_REQUEST_MESSAGE, (float(message_id("AUTOPILOT_VERSION")),))

    def _advance_params(self) -> None:
        if not self._reader.done:
            return
        self.values.update(self._reader.values)
        if self._asked_channels:
            self.calibration = params.calibration(self.values)
            return
        self._asked_channels = True
        mapping = [f"RCMAP_{stick}" for stick in params.STICKS]
        if lost := [name for name in mapping if name not in self.values]:
            raise PeerError(
                f"the vehicle did not answer for {', '.join(lost)}: without it sticks cannot be "
                "mapped; is this an ArduPilot vehicle with RC input?"
            )
        self._reader = params.ParamReader(params.calibration_names(self.values))
