"""Vehicle of the link test: times the answers to its attitudes.

It is the simulated ArduPilot, armed and at a standstill in the air: its physics never steps. It
sends ATTITUDE_QUATERNION on a grid, each with a code in its roll rate, and waits for sticks with
the same code: RC_CHANNELS_OVERRIDE (channel 1) or MANUAL_CONTROL (y). All else that a client asks
for is sent half a period away from the attitude, so that it never delays it. Sends are stamped just
before the system call, answers on arrival by the kernel, so that this process adds nothing to the
figures.
"""

import json
import sys
from contextlib import closing
from dataclasses import asdict, dataclass
from itertools import count

from cyclopts import App
from pymavlink.dialects.v20 import ardupilotmega as mav

from mavbridge.core.clock import NS_PER_S, Clock, MonotonicClock
from mavbridge.core.histogram import Histogram
from mavbridge.core.vehicle import Percentiles
from mavbridge.mavlink.transport.sockets import UdpTransport
from sitl.ardupilot.autopilot import ArduCopter
from sitl.ardupilot.params import ArduPilotParams
from sitl.ardupilot.server import ArduPilotServer
from sitl.report import FlightLog
from sitl.vehicle.config import MID_RECEIVER_US, VehicleConfig

ATTITUDE_HZ = 97.0
"""Not 100, so that the phase relative to a client with a 100 Hz clock takes every value."""
CODES = 200
CODE_SPAN = 100
CODE_US = 5
"""PWM step per code: code k is a stick of (k - 100) / 100, which is 1000 + 5 k us. An answer may be
off by 2 us. The codes repeat after 2 s; an answer that has not come by then is lost."""
WARM_ANSWERS = 100
CONNECT_S = 30.0
READY_NS = 10 * NS_PER_S
"""Age of the vehicle at the start: its estimator has a position."""
STREAM_US = 10_000
"""Interval of the other messages that every client gets."""
STREAMS = (
    mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
    mav.MAVLINK_MSG_ID_HIGHRES_IMU,
    mav.MAVLINK_MSG_ID_RC_CHANNELS,
)
ATTITUDES = (mav.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, mav.MAVLINK_MSG_ID_ATTITUDE)
"""Not streamed, although a client asks for them."""
app = App(help=__doc__)


@app.default
def main(*, port: int, attitudes: int) -> None:
    """Send ``attitudes`` to a client that listens on a UDP port, and print the figures as JSON."""
    clock = MonotonicClock()
    transport = UdpTransport(("127.0.0.1", port), clock, listen=False)
    transport.open()
    with closing(transport):
        sys.stdout.write(json.dumps(asdict(LinkVehicle(transport, clock).run(attitudes))))


@dataclass(frozen=True, kw_only=True)
class LinkLatency:
    """Time from the vehicle's send of an attitude to the arrival of its sticks."""

    client: str = ""
    sent: int
    answered: int
    round_trip_ms: Percentiles | None
    """From just before a send to the kernel's stamp of the first answer; None: no answer."""


class RoundTrips:
    """Matches answers with sent codes."""

    def __init__(self) -> None:
        self._pending: dict[int, int] = {}
        self._durations = Histogram()
        self._sent = 0
        self.answered_in_a_row = 0

    def send(self, code: int, at_ns: int) -> None:
        """Note a code as sent; a pending one that was sent as the same code is lost."""
        self.answered_in_a_row = 0 if code in self._pending else self.answered_in_a_row
        self._pending[code] = at_ns
        self._sent += 1

    def answer(self, code: int, arrived_ns: int) -> None:
        """Note an answer; only the first one to each code counts."""
        if (sent_ns := self._pending.pop(code, None)) is not None:
            self.answered_in_a_row += 1
            self._durations.add(arrived_ns - sent_ns)

    def answers(self) -> LinkLatency:
        """Return the figures so far."""
        return LinkLatency(
            sent=self._sent,
            answered=self._durations.count,
            round_trip_ms=self._durations.percentiles_ms(),
        )


class LinkVehicle:
    """Timing vehicle for one client."""

    def __init__(self, transport: UdpTransport, clock: Clock) -> None:
        self._clock = clock
        self._transport = transport
        self._start_ns = clock.now_ns()
        config = VehicleConfig(receiver_us=MID_RECEIVER_US)
        params, boot_ns = ArduPilotParams(config), self._start_ns - READY_NS
        params.set("MAV_GCS_SYSID", 1.0)  # sticks of any sender count: MAVSDK's is not ours
        params.set("MAV_GCS_SYSID_HI", 255.0)
        self._ap = ArduCopter(params, config, boot_ns)
        self._ap.launch((0.0, 0.0, -10.0), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
        self._server = ArduPilotServer(self._ap, 1, FlightLog(boot_ns, None))
        (self._endpoint,) = self._server.links
        for message_id in STREAMS:
            self._endpoint.set_interval(message_id, STREAM_US)
        self._round_trips = RoundTrips()

    def run(self, attitudes: int) -> LinkLatency:
        """Wait for steady answers, then count those to ``attitudes``.

        Raises:
            TimeoutError: no client answered steadily.
        """
        due_ns = self._clock.now_ns()
        for number in count():
            if self._round_trips.answered_in_a_row >= WARM_ANSWERS:
                break
            if self._clock.now_ns() - self._start_ns > CONNECT_S * NS_PER_S:
                raise TimeoutError(f"no client has answered steadily within {CONNECT_S:g} s")
            due_ns = self._exchange(number, due_ns)
        self._round_trips = RoundTrips()  # answers from before do not count
        for number in range(attitudes):
            due_ns = self._exchange(number, due_ns)
        return self._round_trips.answers()

    def _exchange(self, number: int, due_ns: int) -> int:
        """Send one attitude; half a period later read answers and send all other messages.

        Return the time of the next attitude.
        """
        half_ns = round(NS_PER_S / ATTITUDE_HZ / 2)
        self._clock.sleep_until_ns(due_ns)
        ap, code = self._ap, number % CODES
        ap.now_ns = self._clock.now_ns()
        ap.sensed = ap.sensed._replace(rate_body_radps=((code - CODE_SPAN) / CODE_SPAN, 0.0, 0.0))
        self._endpoint.send_now(mav.MAVLINK_MSG_ID_ATTITUDE_QUATERNION)
        data = self._endpoint.take_outgoing()
        self._round_trips.send(code, self._clock.now_ns())
        self._transport.send(data)
        self._clock.sleep_until_ns(due_ns + half_ns)
        for datagram, arrived_ns, _ in self._transport.drain():
            self._server.receive(0, datagram, arrived_ns)
            ap.rc.update(arrived_ns)
            code = round((ap.rc.channels_us[0] - 1000) / CODE_US)
            self._round_trips.answer(code, arrived_ns)
        for message_id in ATTITUDES:
            self._endpoint.set_interval(message_id, -1)
        ap.now_ns = self._clock.now_ns()
        self._server.step(ap.now_ns)
        self._transport.send(self._endpoint.take_outgoing())
        return due_ns + 2 * half_ns


if __name__ == "__main__":
    app()
