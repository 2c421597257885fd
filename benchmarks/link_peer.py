"""The other end of the link test: a vehicle that is always armed and only counts answers.

It sends ATTITUDE_QUATERNION on a grid, each with a code in its roll rate, and waits for sticks that
carry the same code: RC_CHANNELS_OVERRIDE (channel 1) or MANUAL_CONTROL (y). What it takes to be
flown (heartbeat, parameters, acknowledgements, the other state messages) is sent half a period away
from the attitude, so that it is never in its way.

Sends are stamped just before the system call, answers by the kernel as they arrive: this process
sleeps meanwhile, and what it does is in nobody's way and in nobody's figures.
"""

import argparse
import json
import sys
from collections.abc import Iterator
from dataclasses import asdict

from pymavlink.dialects.v20 import ardupilotmega as mav

from mavbridge.core.clock import NS_PER_MS, NS_PER_S, MonotonicClock
from mavbridge.core.histogram import Histogram
from mavbridge.mavlink.transport.sockets import UdpTransport

ATTITUDE_HZ = 97.0
"""Not 100: the phase against a client with a 100 Hz clock of its own then takes every value."""
CODES = 1000
CODE_SPAN = 500
"""A code k stands for a stick of (k - 500) / 500, which is 1000 + k us of PWM."""
WARM_ANSWERS = 100
"""In a row, before counting starts."""
CONNECT_S = 30.0
PENDING_LIMIT = 200
"""Answers later than two seconds are lost ones."""
PARAMS = {
    "RCMAP_ROLL": 1.0,
    "RCMAP_PITCH": 2.0,
    "RCMAP_THROTTLE": 3.0,
    "RCMAP_YAW": 4.0,
    "RC_OVERRIDE_TIME": 3.0,
    "RC_OPTIONS": 32.0,
    "FS_THR_VALUE": 975.0,
    "MAV_GCS_SYSID": 255.0,
    "MAV_GCS_SYSID_HI": 255.0,
    "SYSID_MYGCS": 255.0,
} | {
    f"RC{channel}_{part}": value
    for channel in range(1, 5)
    for part, value in (("MIN", 1000.0), ("TRIM", 1500.0), ("MAX", 2000.0), ("REVERSED", 0.0))
}
"""All that a client may ask for; RCn_OPTION stays unanswered."""


def stick_of(code: int) -> float:
    """The stick that stands for a code, in [-1, 1)."""
    return (code - CODE_SPAN) / CODE_SPAN


def code_of(stick: float) -> int:
    """Inverse of ``stick_of``."""
    return round(stick * CODE_SPAN) + CODE_SPAN


class LinkPeer:
    """One vehicle, one client."""

    def __init__(self, port: int, attitudes: int) -> None:
        self._wanted = attitudes
        self._clock = MonotonicClock()
        self._transport = UdpTransport(("127.0.0.1", port), self._clock, listen=False)
        self._mav = mav.MAVLink(None, srcSystem=1, srcComponent=1)
        self._mav.robust_parsing = True
        self._start_ns = self._clock.now_ns()
        self._pending: dict[int, int] = {}
        self._channels_us = [1500] * 8
        self._answered_in_a_row = 0
        self._is_counting = False
        self._output = ""
        self.sent = 0
        self.round_trip = Histogram()

    def run(self) -> None:
        """Until enough attitudes were sent.

        Raises:
            TimeoutError: nobody answered.
        """
        self._transport.open()
        try:
            self._run()
        finally:
            self._transport.close()

    def _run(self) -> None:
        half_ns = round(NS_PER_S / ATTITUDE_HZ / 2)
        index = 0
        due_ns = self._clock.now_ns()
        while self.sent < self._wanted or index % 2:
            due_ns += half_ns
            self._clock.sleep_until_ns(due_ns)
            if index % 2 == 0:
                self._send_attitude(index // 2)
            else:
                self._take_answers()
                self._keep_house(index // 2)
            index += 1
            self._watch()
        self._take_answers()

    def _watch(self) -> None:
        if self._is_counting:
            return
        if self._answered_in_a_row >= WARM_ANSWERS:
            self._is_counting = True
            self._pending.clear()
        elif self._clock.now_ns() - self._start_ns > CONNECT_S * NS_PER_S:
            raise TimeoutError(f"no client has answered steadily within {CONNECT_S:g} s")

    def _send_attitude(self, number: int) -> None:
        code = number % CODES
        data = self._pack(
            mav.MAVLink_attitude_quaternion_message(
                self._boot_ms(), 1.0, 0.0, 0.0, 0.0, stick_of(code), 0.0, 0.0
            )
        )
        while len(self._pending) >= PENDING_LIMIT:
            self._pending.pop(next(iter(self._pending)))
            self._answered_in_a_row = 0
        self._pending[code] = self._clock.now_ns()
        self.sent += self._is_counting
        self._transport.send(data)

    def _take_answers(self) -> None:
        for chunk in self._transport.drain():
            for message in self._mav.parse_buffer(chunk.data) or ():
                self._take(message, chunk.arrived_ns)

    def _take(self, message: mav.MAVLink_message, arrived_ns: int) -> None:
        name = message.get_type()
        if name == "RC_CHANNELS_OVERRIDE":
            self._channels_us[:4] = [getattr(message, f"chan{k}_raw") for k in range(1, 5)]
            self._answered(name, message.chan1_raw - 1000, arrived_ns)
        elif name == "MANUAL_CONTROL":
            self._answered(name, code_of(message.y / 1000), arrived_ns)
        elif name == "COMMAND_LONG":
            self._put(mav.MAVLink_command_ack_message(message.command, mav.MAV_RESULT_ACCEPTED))
        elif name == "PARAM_REQUEST_READ" and message.param_id in PARAMS:
            self._put(self._param(message.param_id))

    def _answered(self, output: str, code: int, arrived_ns: int) -> None:
        sent_ns = self._pending.pop(code, None)
        if sent_ns is None:
            return
        self._output = output
        self._answered_in_a_row += 1
        if self._is_counting:
            self.round_trip.add(arrived_ns - sent_ns)

    def _param(self, name: str) -> mav.MAVLink_message:
        return mav.MAVLink_param_value_message(
            name.encode(), PARAMS[name], mav.MAV_PARAM_TYPE_REAL32, len(PARAMS), 0
        )

    def _keep_house(self, number: int) -> None:
        self._transport.send(b"".join(self._pack(message) for message in self._house(number)))

    def _house(self, number: int) -> Iterator[mav.MAVLink_message]:
        boot_ms = self._boot_ms()
        yield mav.MAVLink_local_position_ned_message(boot_ms, 0.0, 0.0, -10.0, 0.0, 0.0, 0.0)
        yield mav.MAVLink_raw_imu_message(boot_ms * 1000, 0, 0, -1000, 0, 0, 0, 0, 0, 0)
        if number % 4 == 0:
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

    def _put(self, message: mav.MAVLink_message) -> None:
        self._transport.send(self._pack(message))

    def summary(self) -> str:
        """JSON for whoever started this."""
        round_trip = self.round_trip.percentiles_ms()
        return json.dumps(
            {
                "output": self._output,
                "sent": self.sent,
                "answered": self.round_trip.count,
                "round_trip_ms": None if round_trip is None else asdict(round_trip),
            }
        )


def main() -> int:
    """Count, and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, allow_abbrev=False)
    parser.add_argument("--port", type=int, required=True, help="UDP, where the client listens")
    parser.add_argument("--attitudes", type=int, required=True, help="to send once it answers")
    args = parser.parse_args()
    peer = LinkPeer(args.port, args.attitudes)
    try:
        peer.run()
    except TimeoutError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    sys.stdout.write(peer.summary() + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
