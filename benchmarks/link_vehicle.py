"""Vehicle of the link test: always armed; times the answers to its attitudes.

It sends ATTITUDE_QUATERNION on a grid, each with a code in its roll rate, and waits for sticks with
the same code: RC_CHANNELS_OVERRIDE (channel 1) or MANUAL_CONTROL (y). A client's other needs
(heartbeat, parameters, acknowledgements, other state messages) are sent half a period away from the
attitude, so that they never delay it. Sends are stamped just before the system call, answers on
arrival by the kernel, so that this process adds nothing to the figures.
"""

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from itertools import count
from pathlib import Path

from cyclopts import App
from pymavlink.dialects.v20 import ardupilotmega as mav

from mavbridge.core.clock import NS_PER_MS, NS_PER_S, Clock, MonotonicClock
from mavbridge.core.histogram import Histogram
from mavbridge.core.vehicle import Percentiles
from mavbridge.mavlink.transport.sockets import UdpTransport

ATTITUDE_HZ = 97.0
"""Not 100, so that the phase relative to a client with a 100 Hz clock takes every value."""
CODES = 200
CODE_SPAN = 100
CODE_US = 5
"""PWM step per code: code k is a stick of (k - 100) / 100, which is 1000 + 5 k us. An answer may be
off by 2 us."""
WARM_ANSWERS = 100
CONNECT_S = 30.0
PENDING_LIMIT = 150
"""Largest number of pending answers (1.5 s); older ones count as lost. Smaller than CODES."""
SENT_MESSAGES = (
    mav.MAVLINK_MSG_ID_ATTITUDE_QUATERNION,
    mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
    mav.MAVLINK_MSG_ID_RAW_IMU,
    mav.MAVLINK_MSG_ID_RC_CHANNELS,
)
"""Messages whose interval may be set; others are denied."""
PARAMS = {
    "RCMAP_ROLL": 1.0,
    "RCMAP_PITCH": 2.0,
    "RCMAP_THROTTLE": 3.0,
    "RCMAP_YAW": 4.0,
    "RC_OVERRIDE_TIME": 3.0,
    "RC_OPTIONS": 32.0,
    "FS_THR_ENABLE": 1.0,
    "FS_THR_VALUE": 975.0,
    "MAV_GCS_SYSID": 255.0,
    "MAV_GCS_SYSID_HI": 255.0,
    "SYSID_MYGCS": 255.0,
} | {
    f"RC{channel}_{part}": value
    for channel in range(1, 5)
    for part, value in (("MIN", 1000.0), ("TRIM", 1500.0), ("MAX", 2000.0), ("REVERSED", 0.0))
}
"""All parameters that a client may request; RCn_OPTION stays unanswered."""
app = App(help=__doc__)


@app.default
def main(*, port: int, attitudes: int, out: Path) -> None:
    """Send ``attitudes`` to a client that listens on a UDP port, and write the figures."""
    clock = MonotonicClock()
    transport = UdpTransport(("127.0.0.1", port), clock, listen=False)
    transport.open()
    try:
        out.write_text(json.dumps(asdict(LinkVehicle(transport, clock).run(attitudes))))
    finally:
        transport.close()


def stick_of(code: int) -> float:
    """Return the stick for a code, in [-1, 1)."""
    return (code - CODE_SPAN) / CODE_SPAN


def code_of(stick: float) -> int:
    """Inverse of ``stick_of``."""
    return round(stick * CODE_SPAN) + CODE_SPAN


def code_of_pwm(pwm_us: int) -> int:
    """Return the code in a channel of RC_CHANNELS_OVERRIDE."""
    return round((pwm_us - 1000) / CODE_US)


@dataclass(frozen=True, kw_only=True)
class LinkLatency:
    """Time from the vehicle's send of an attitude to the arrival of its sticks."""

    client: str = ""
    sent: int
    answered: int
    round_trip_ms: Percentiles | None
    """From just before a send to the kernel's stamp of the first answer; None: no answer."""


class RoundTrips:
    """Matches answers with sent codes; counts none before ``start``."""

    def __init__(self) -> None:
        self._pending: dict[int, int] = {}
        self._durations = Histogram()
        self._sent = 0
        self._is_counting = False
        self.answered_in_a_row = 0

    def start(self) -> None:
        """Start counting."""
        self._is_counting = True
        self._pending.clear()

    def send(self, code: int, at_ns: int) -> None:
        """Note a code as sent; drop the oldest pending codes over the limit as lost."""
        while len(self._pending) >= PENDING_LIMIT:
            self._pending.pop(next(iter(self._pending)))
            self.answered_in_a_row = 0
        self._pending[code] = at_ns
        self._sent += self._is_counting

    def answer(self, code: int, arrived_ns: int) -> None:
        """Note an answer; only the first one to each code counts."""
        sent_ns = self._pending.pop(code, None)
        if sent_ns is None:
            return
        self.answered_in_a_row += 1
        if self._is_counting:
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
        self._mav = mav.MAVLink(None, srcSystem=1, srcComponent=1)
        self._mav.robust_parsing = True
        self._start_ns = clock.now_ns()
        self._channels_us = [1500] * 8
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
        self._round_trips.start()
        for number in range(attitudes):
            due_ns = self._exchange(number, due_ns)
        return self._round_trips.answers()

    def _exchange(self, number: int, due_ns: int) -> int:
        """Send one attitude; half a period later read answers and send all other messages.

        Return the time of the next attitude.
        """
        half_ns = round(NS_PER_S / ATTITUDE_HZ / 2)
        self._clock.sleep_until_ns(due_ns)
        code = number % CODES
        data = self._pack(
            mav.MAVLink_attitude_quaternion_message(
                self._boot_ms(), 1.0, 0.0, 0.0, 0.0, stick_of(code), 0.0, 0.0
            )
        )
        self._round_trips.send(code, self._clock.now_ns())
        self._transport.send(data)
        self._clock.sleep_until_ns(due_ns + half_ns)
        for chunk in self._transport.drain():
            for message in self._mav.parse_buffer(chunk.data) or ():
                self._receive(message, chunk.arrived_ns)
        self._transport.send(b"".join(map(self._pack, self._telemetry(number))))
        return due_ns + 2 * half_ns

    def _receive(self, message: mav.MAVLink_message, arrived_ns: int) -> None:
        name = message.get_type()
        if name == "RC_CHANNELS_OVERRIDE":
            self._channels_us[:4] = [getattr(message, f"chan{k}_raw") for k in range(1, 5)]
            self._round_trips.answer(code_of_pwm(message.chan1_raw), arrived_ns)
        elif name == "MANUAL_CONTROL":
            self._round_trips.answer(code_of(message.y / 1000), arrived_ns)
        elif name == "COMMAND_LONG":
            is_denied = (
                message.command == mav.MAV_CMD_SET_MESSAGE_INTERVAL
                and message.param1 not in SENT_MESSAGES
            )
            result = mav.MAV_RESULT_DENIED if is_denied else mav.MAV_RESULT_ACCEPTED
            self._transport.send(
                self._pack(mav.MAVLink_command_ack_message(message.command, result))
            )
        elif name == "PARAM_REQUEST_READ" and message.param_id in PARAMS:
            value, kind = PARAMS[message.param_id], mav.MAV_PARAM_TYPE_REAL32
            reply = mav.MAVLink_param_value_message(
                message.param_id.encode(), value, kind, len(PARAMS), 0
            )
            self._transport.send(self._pack(reply))

    def _telemetry(self, number: int) -> Iterator[mav.MAVLink_message]:
        boot_ms = self._boot_ms()
        yield mav.MAVLink_local_position_ned_message(boot_ms, 0.0, 0.0, -10.0, 0.0, 0.0, 0.0)
        yield mav.MAVLink_raw_imu_message(boot_ms * 1000, 0, 0, -1000, 0, 0, 0, 0, 0, 0)
        if number % 2 == 0:
            channels_us = (*self._channels_us, *[0] * 10)
            yield mav.MAVLink_rc_channels_message(boot_ms, 8, *channels_us, 255)
        if number % round(ATTITUDE_HZ) == 0:
            yield mav.MAVLink_heartbeat_message(
                mav.MAV_TYPE_QUADROTOR,
                mav.MAV_AUTOPILOT_ARDUPILOTMEGA,
                mav.MAV_MODE_FLAG_SAFETY_ARMED | mav.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED,
                mav.COPTER_MODE_ALT_HOLD,
                mav.MAV_STATE_ACTIVE,
                3,
            )

    def _boot_ms(self) -> int:
        return (self._clock.now_ns() - self._start_ns) // NS_PER_MS

    def _pack(self, message: mav.MAVLink_message) -> bytes:
        data: bytes = message.pack(self._mav)
        self._mav.seq = (self._mav.seq + 1) % 256
        return data


if __name__ == "__main__":
    app()
