"""The pilot's transmitter, for a vehicle that takes its receiver from datagrams (``--rc-in``)."""

import socket
import struct

LOW_US, MIDDLE_US, HIGH_US = 1000, 1500, 2000
SWITCH = 6
"""Place of the switch, channel 7."""


class Transmitter:
    """Sticks and a switch; nothing is sent until they are set."""

    def __init__(self, port: int) -> None:
        self._address = ("127.0.0.1", port)

    def send(self, *, switch_us: int, throttle_us: int = MIDDLE_US) -> None:
        """Every other channel is in its middle."""
        values = [MIDDLE_US] * 8
        values[2], values[SWITCH] = throttle_us, switch_us
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.sendto(struct.pack("<8H", *values), self._address)
