"""The pilot's transmitter, moved by datagrams to ``--rc-in`` of the simulated vehicle."""

import socket
import struct

from sitl.faults.record import NEUTRAL_US, RECEIVER_US, Receiver

HOST = "127.0.0.1"
CHANNELS = 8
SWITCH_ON_US = 2000
"""Channels above the mode switch (5), at the start."""


class Transmitter:
    """Eight channels that stay as they are until they are moved."""

    def __init__(self, port: int, receiver: Receiver) -> None:
        """``receiver`` says where its throttle rests."""
        self.flags = ("--rc-in", str(port))
        """Flags of the simulated vehicle."""
        self._address = (HOST, port)
        sticks_us = RECEIVER_US.get(receiver, NEUTRAL_US)
        self._channels_us = [*sticks_us, 1500, *[SWITCH_ON_US] * (CHANNELS - 5)]

    def move(self, channel: int, value_us: int) -> None:
        """Move a stick or switch, numbered from 1, to a value in us."""
        self._channels_us[channel - 1] = value_us
        self.send(self._channels_us)

    def switch_on(self) -> None:
        """Send the channels as they are."""
        self.send(self._channels_us)

    def switch_off(self) -> None:
        """The receiver hears nothing any more."""
        self.send([0] * CHANNELS)

    def send(self, values_us: list[int]) -> None:
        """One datagram, which the vehicle acts on until the next one."""
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.sendto(struct.pack(f"<{CHANNELS}H", *values_us), self._address)
