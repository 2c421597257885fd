"""MAVLink framing of one link of the vehicle, without I/O: what every firmware here shares."""

from collections.abc import Iterator
from typing import Any, TypeAlias

from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl.vehicle.config import SigningKey

Message: TypeAlias = Any  # a pymavlink message (the library has no types)


class Framing:
    """Bytes in, messages out; messages in, bytes out. A restart of the vehicle leaves it alone."""

    def __init__(self, signing: SigningKey | None) -> None:
        self.bad_frames = 0
        """Garbage, truncated frames and wrong checksums; with a key also wrong signatures."""
        self._mav = mav.MAVLink(None, srcSystem=1, srcComponent=mav.MAV_COMP_ID_AUTOPILOT1)
        self._mav.robust_parsing = True
        if signing is not None:
            self._mav.signing.secret_key = signing.key
            self._mav.signing.timestamp = signing.timestamp
            self._mav.signing.sign_outgoing = True
        self._outgoing = bytearray()

    def parse(self, data: bytes) -> Iterator[Message]:
        """Complete messages in these bytes; unreadable frames are counted and skipped."""
        for message in self._mav.parse_buffer(data) or ():
            if message.get_type() == "BAD_DATA":
                self.bad_frames += 1
            else:
                yield message

    def pack(self, message: Message, system_id: int) -> None:
        """Queue a message of the vehicle."""
        self._mav.srcSystem = system_id
        self._outgoing += message.pack(self._mav)
        self._mav.seq = (self._mav.seq + 1) % 256

    def pass_on(self, frame: bytes) -> None:
        """Queue another sender's frame as it is."""
        self._outgoing += frame

    def take_outgoing(self) -> bytes:
        """Everything queued since the last call: whole frames, in order."""
        taken = bytes(self._outgoing)
        self._outgoing.clear()
        return taken
