"""From the first heartbeat to a vehicle that can be flown: parameters, calibration, streams.

A state machine without I/O. The link steps it at every tick, so connecting, reconnecting and a
rebooted vehicle are all handled alike, and the action loop never waits for any of them.
"""

from collections.abc import Iterator

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.core.clock import NS_PER_MS
from mavbridge.mavlink.codec.calibration import RcCalibration
from mavbridge.mavlink.codec.messages import (
    AutopilotVersion,
    CommandAck,
    CommandRequest,
    ParamValue,
    Request,
)
from mavbridge.mavlink.session import params
from mavbridge.mavlink.session.streams import StreamGroup, StreamRequester, message_id

_VERSION_TIMEOUT_NS = 400 * NS_PER_MS
_VERSION_ATTEMPTS = 4


class Handshake:
    """Asks for the version, then parameters (if the output needs them), then streams."""

    def __init__(self, *, needs_calibration: bool, wanted: tuple[StreamGroup, ...]) -> None:
        self._needs_calibration = needs_calibration
        self._reader = params.ParamReader(params.FIRST_NAMES if needs_calibration else ())
        self._is_reading_channels = False
        self._version_attempts = 0
        self._version_due_ns = 0
        self.version: str | None = None
        self.calibration: RcCalibration | None = None
        self.values: dict[str, float] = {}
        self.streams = StreamRequester(wanted)

    @property
    def problem(self) -> str | None:
        """The step that is not finished, or None."""
        if self._needs_calibration and self.calibration is None:
            return "reading the vehicle's radio calibration"
        if not self.streams.is_settled and self.streams.renewals == 0:
            return "requesting telemetry from the vehicle"
        return None

    def receive(self, body: ParamValue | AutopilotVersion | CommandAck) -> None:
        """Take an answer of the vehicle."""
        match body:
            case ParamValue():
                self._reader.receive(body)
            case AutopilotVersion():
                self.version = body.version
            case CommandAck():
                self.streams.receive_ack(body)

    def step(self, now_ns: int) -> Iterator[Request]:
        """Requests that are due.

        Raises:
            PeerError: the vehicle cannot be flown with its present parameters.
        """
        if (
            self.version is None
            and self._version_attempts < _VERSION_ATTEMPTS
            and now_ns >= self._version_due_ns
        ):
            self._version_due_ns = now_ns + _VERSION_TIMEOUT_NS
            self._version_attempts += 1
            number = float(message_id("AUTOPILOT_VERSION"))
            yield CommandRequest(dialect.MAV_CMD_REQUEST_MESSAGE, (number,))
        # Streams come after parameters: a vehicle slows its streams down while it sends those.
        if self._needs_calibration and self.calibration is None:
            yield from self._reader.step(now_ns)
            self._advance_params()
        elif (request := self.streams.step(now_ns)) is not None:
            yield request

    def _advance_params(self) -> None:
        if not self._reader.is_done:
            return
        self.values.update(self._reader.values)
        if self._is_reading_channels:
            self.calibration = params.calibration(self.values)
        else:
            self._is_reading_channels = True
            self._reader = params.ParamReader(params.calibration_names(self.values))
