"""Ground station or companion computer of a PX4 vehicle: sticks, setpoints, modes, its events."""

import math
import struct
from collections.abc import Callable
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as mav

from helpers.contract_peers import ARM, GCS, TICK_NS, Companion, Peer, named
from sitl.clock import NS_PER_S
from sitl.vehicle.rotation import from_euler

ACCEPTED, REJECTED = mav.MAV_RESULT_ACCEPTED, mav.MAV_RESULT_TEMPORARILY_REJECTED
ALTCTL, POSCTL, OFFBOARD, STAB = (2, 0), (3, 0), (6, 0), (7, 0)
TAKEOFF, LOITER, RTL, LAND = (4, 2), (4, 3), (4, 5), (4, 6)
MID = (0, 0, 500, 0)
EVENT, CURRENT_MODE = 410, 436
STICK_HZ = 50
HOVER_THRUST = 0.484
LOWEST_M, HIGHEST_M, STILL_MPS = 5.0, 40.0, 0.3


class Modes(NamedTuple):
    """CURRENT_MODE, decoded by hand because pymavlink's dialect lacks it."""

    custom_mode: int
    intended_custom_mode: int
    standard_mode: int


def custom(mode: tuple[int, int]) -> int:
    return mode[0] << 16 | mode[1] << 24


def modes_in(messages: list[Any]) -> list[Modes]:
    raw = named(messages, f"UNKNOWN_{CURRENT_MODE}")
    return [decode_current_mode(m) for m in raw]


def decode_current_mode(message: Any) -> Modes:
    payload = bytes(message.get_msgbuf())[10:-2].ljust(9, b"\0")
    return Modes(*struct.unpack("<IIB", payload))


def event_id(message: Any) -> int:
    (number,) = struct.unpack_from("<I", bytes(message.get_msgbuf()), 10)
    return int(number)


def attitude_target(roll_deg: float = 0.0, thrust: float = HOVER_THRUST, yaw: float = 0.0) -> Any:
    q = from_euler(math.radians(roll_deg), 0.0, yaw)
    return mav.MAVLink_set_attitude_target_message(0, 1, 1, 7, q, 0, 0, 0, thrust)


def rate_target(yaw_degps: float) -> Any:
    rates = (0, 0, math.radians(yaw_degps), HOVER_THRUST)
    return mav.MAVLink_set_attitude_target_message(0, 1, 1, 128, [1, 0, 0, 0], *rates)


class Px4Companion(Companion):
    """`Companion` for PX4; sends a ground station's heartbeat once a second."""

    def __init__(self, peer: Peer, *, is_gcs: bool = True) -> None:
        super().__init__(peer)
        self._is_gcs = is_gcs
        self._heartbeat_due_ns = peer.now_ns()

    def advance(self, seconds: float) -> list[Any]:
        if self._is_gcs and self.peer.now_ns() >= self._heartbeat_due_ns:
            self._heartbeat_due_ns = self.peer.now_ns() + NS_PER_S
            self.send(mav.MAVLink_heartbeat_message(mav.MAV_TYPE_GCS, 8, 0, 0, 0, 3))
        return super().advance(seconds)

    def set_mode(self, mode: tuple[int, int]) -> int:
        return self.command(mav.MAV_CMD_DO_SET_MODE, 1, *mode)

    def sticks(self, sticks: tuple[int, int, int, int], *, system_id: int = GCS) -> None:
        """Send MANUAL_CONTROL: x, y, z, r."""
        self.send(mav.MAVLink_manual_control_message(1, *sticks, 0), system_id=system_id)

    def holding(self, sticks: tuple[int, int, int, int] = MID) -> Callable[[float], None]:
        """Return a function that sends these sticks, for ``repeat``, ``until`` and ``hears``."""
        return lambda _: self.sticks(sticks)

    def repeat(
        self, send: Callable[[float], None], seconds: float, hz: float = STICK_HZ
    ) -> list[Any]:
        """Call ``send`` with the elapsed time at this rate; return the received messages."""
        start_ns = self.peer.now_ns()
        messages: list[Any] = []
        count = 0
        while (elapsed_ns := self.peer.now_ns() - start_ns) < seconds * NS_PER_S:
            if elapsed_ns * hz >= count * NS_PER_S:
                count += 1
                send(elapsed_ns / NS_PER_S)
            messages += self.advance(TICK_NS / NS_PER_S)
        return messages

    def fly(self, seconds: float, sticks: tuple[int, int, int, int] = MID) -> list[Any]:
        return self.repeat(self.holding(sticks), seconds)

    def stream_setpoint(self, message: Any, seconds: float, hz: float = STICK_HZ) -> list[Any]:
        return self.repeat(lambda _: self.send(message), seconds, hz)

    def until(
        self,
        is_over: Callable[[list[Any]], bool],
        within_s: float,
        send: Callable[[float], None] = lambda _: None,
    ) -> tuple[float, list[Any]]:
        """Continue until the new messages satisfy a condition; return the time and the messages."""
        start_ns, messages = self.peer.now_ns(), list[Any]()
        while self.peer.now_ns() - start_ns < within_s * NS_PER_S:
            send((self.peer.now_ns() - start_ns) / NS_PER_S)
            messages += self.advance(1.0 / STICK_HZ)
            if is_over(messages):
                return (self.peer.now_ns() - start_ns) / NS_PER_S, messages
        raise AssertionError(f"not within {within_s} s")

    def mode(self) -> int:
        name = f"UNKNOWN_{CURRENT_MODE}"
        return decode_current_mode(self.request(CURRENT_MODE, name)).custom_mode

    def track(self) -> None:
        """Stream modes, attitude, position and landed state at high rates."""
        for message_id in (
            mav.MAVLINK_MSG_ID_ATTITUDE,
            mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
            mav.MAVLINK_MSG_ID_EXTENDED_SYS_STATE,
            CURRENT_MODE,
        ):
            assert self.stream(message_id, 50) == ACCEPTED

    def get_ready(self, mode: tuple[int, int]) -> None:
        """Wait until the vehicle can be armed in a mode, with sticks centred; do not arm."""
        self.fly(0.2)
        assert self.set_mode(mode) == ACCEPTED
        for _ in range(600):
            heartbeats = named(self.fly(0.1), "HEARTBEAT")
            if any(
                m.system_status == mav.MAV_STATE_STANDBY and m.custom_mode == custom(mode)
                for m in heartbeats
            ):
                return
        raise AssertionError("the vehicle does not get ready to arm")

    def fly_up(self, mode: tuple[int, int] = ALTCTL) -> None:
        """Climb some metres, level and still, with sticks centred; then enter the mode."""
        self.sticks(MID)
        self.track()
        self.peer.put_in_air()
        if not self.in_the_air:
            self.get_ready(ALTCTL)
            assert self.arm() == ACCEPTED
            is_up = lambda m: any(p.z < -6.0 for p in named(m, "LOCAL_POSITION_NED"))  # noqa: E731
            self.until(is_up, 25.0, self.holding((0, 0, 1000, 0)))
        self._settle()
        self._take(mode)
        self.fly(0.1)
        self.seen.clear()

    def _settle(self) -> None:
        """In POSCTL, brake and reach a height of 5 to 40 m."""
        for count in range(600):
            if count % 100 == 0:  # again, if a busy computer has lost the sticks meanwhile
                self._take(POSCTL)
            states = named(self.fly(0.1, (0, 0, self._climb_stick(), 0)), "LOCAL_POSITION_NED")
            speed_mps = max(abs(v) for m in states[-1:] for v in (m.vx, m.vy, m.vz))
            if self._climb_stick() == MID[2] and speed_mps < STILL_MPS:
                return
        raise AssertionError("the vehicle does not come to rest")

    def _take(self, mode: tuple[int, int]) -> None:
        """Enter a mode with sticks, which is refused until they have arrived for a while."""
        for _ in range(20):
            self.fly(0.1)
            if self.set_mode(mode) == ACCEPTED:
                return
        raise AssertionError(f"the mode {mode} is refused: {self.texts()}")

    def _climb_stick(self) -> int:
        height_m = -named(self.seen, "LOCAL_POSITION_NED")[-1].z
        if LOWEST_M <= height_m <= HIGHEST_M:
            return MID[2]
        return 1000 if height_m < LOWEST_M else 0

    def hears(
        self, text: str, within_s: float = 2.0, send: Callable[[float], None] = lambda _: None
    ) -> bool:
        """True once a status text with this beginning has arrived since ``seen`` was cleared."""
        end_ns = self.peer.now_ns() + round(within_s * NS_PER_S)
        while self.peer.now_ns() < end_ns:
            if any(m.text.startswith(text[:50]) for m in named(self.seen, "STATUSTEXT")):
                return True
            send(0.0)
            self.advance(1.0 / STICK_HZ)
        return False

    def texts(self) -> list[str]:
        """Return the status texts since the last call, without the tab at their end."""
        texts: list[str] = []
        for message in named(self.seen, "STATUSTEXT"):
            if message.chunk_seq:
                texts[-1] += message.text
            else:
                texts.append(message.text)
        self.seen.clear()
        return [text.rstrip("\t") for text in texts]

    def get_int(self, name: str) -> int:
        self.send(mav.MAVLink_param_request_read_message(1, 1, name.encode(), -1))
        message = self.wait("PARAM_VALUE", where=lambda m: m.param_id == name)
        assert message.param_type == mav.MAV_PARAM_TYPE_INT32
        return int(struct.unpack("<i", struct.pack("<f", message.param_value))[0])

    def change(self, name: str, value: float) -> None:
        """Set a parameter of either type until the end of the test."""
        kind = self.read_param(name).param_type
        packed = value
        if kind == mav.MAV_PARAM_TYPE_INT32:
            (packed,) = struct.unpack("<f", struct.pack("<i", int(value)))
        self.set_param(name, packed)

    def refill_delay(self, seconds: float = 5.001) -> None:
        """Give the failsafe its full delay again, part of which earlier failsafes have used up.

        PX4 does so when any parameter changes, so ``seconds`` is not exactly the default of 5 s.
        """
        self.change("COM_FAIL_ACT_T", seconds)
        self.fly(0.1)

    def restore(self) -> None:
        """Leave the vehicle in the air in Hold, or disarmed on the ground."""
        flies = self.in_the_air
        if flies:
            self.set_mode(LOITER)
        self.sticks(MID)
        super().restore()
        if not flies:
            self.command(ARM, 0)
            self.set_mode(LOITER)
        self.sticks(MID)
