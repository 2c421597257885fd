"""Ground station or companion computer of an ArduCopter: overrides, modes, how to fly up."""

from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mav

from helpers.contract_peers import ARM, GCS, Companion, named, texts_in, velocity_target

STABILIZE, ACRO, ALT_HOLD, GUIDED, LOITER, RTL, LAND = 0, 1, 2, 4, 5, 6, 9
POSHOLD, BRAKE, GUIDED_NOGPS = 16, 17, 20
ACCEPTED, DENIED, UNSUPPORTED, FAILED = (
    mav.MAV_RESULT_ACCEPTED,
    mav.MAV_RESULT_DENIED,
    mav.MAV_RESULT_UNSUPPORTED,
    mav.MAV_RESULT_FAILED,
)
HEIGHT_M = 8.0
TOO_LOW_M, TOO_HIGH_M = 2.0, 15.0  # relative to the wanted height; a descent takes long
STILL_MPS = 0.25


class CopterCompanion(Companion):
    def set_mode(self, number: int) -> int:
        return self.command(mav.MAV_CMD_DO_SET_MODE, 1, number)

    def override(self, *channels_us: int, system_id: int = GCS, target: int = 1) -> None:
        """Send RC_CHANNELS_OVERRIDE. Channels 1 to 8 that are not given are ignored."""
        primary = (*channels_us, *[65535] * (8 - len(channels_us)))[:8]
        aux = (*channels_us[8:], *[0] * (10 - len(channels_us[8:])))
        message = mav.MAVLink_rc_channels_override_message(target, 0, *primary, *aux)
        self.send(message, system_id=system_id)

    def hold(
        self,
        seconds: float,
        *,
        roll: int = 1500,
        pitch: int = 1500,
        thr: int = 1500,
        yaw: int = 1500,
    ) -> list[Any]:
        """Hold the sticks by overrides at 50 Hz; return the messages received meanwhile."""
        messages = []
        for _ in range(round(seconds * 50.0)):
            self.override(roll, pitch, thr, yaw)
            messages += self.advance(0.02)
        return messages

    def channels(self) -> tuple[int, ...]:
        """Return the channels that the vehicle uses; RC_CHANNELS must be streaming."""
        message = self.wait("RC_CHANNELS")
        return tuple(getattr(message, f"chan{n}_raw") for n in range(1, 17))

    def get_ready(self, mode: int, *, needs_position: bool = False) -> None:
        """Wait until arming is possible, with throttle down and the rest centred; do not arm."""
        assert self.set_mode(mode) == ACCEPTED
        self.stream(mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED, 20)
        for _ in range(300):
            self.send_command(mav.MAV_CMD_REQUEST_MESSAGE, mav.MAVLINK_MSG_ID_SYS_STATUS)
            messages = self.hold(0.2, thr=1000)
            has_position = bool(named(messages, "LOCAL_POSITION_NED"))
            health = [m.onboard_control_sensors_health for m in named(messages, "SYS_STATUS")]
            is_healthy = health and health[-1] & mav.MAV_SYS_STATUS_PREARM_CHECK
            if is_healthy and (has_position or not needs_position):
                return
        raise AssertionError(f"the vehicle does not get ready to arm: {self.texts()}")

    def fly_up(self, mode: int = ALT_HOLD) -> None:
        """Reach a height, level and still, in this mode; neutral sticks have just been sent."""
        for message_id in (
            mav.MAVLINK_MSG_ID_ATTITUDE,
            mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
            mav.MAVLINK_MSG_ID_RC_CHANNELS,
        ):
            self.stream(message_id, 50)
        self.stream(mav.MAVLINK_MSG_ID_HEARTBEAT, 10)
        self.override(1500, 1500, 1500, 1500)
        self.peer.put_in_air()
        if self.in_the_air:
            assert self.set_mode(GUIDED) == ACCEPTED
        else:
            self._take_off()
        self._settle()
        assert self.set_mode(mode) == ACCEPTED

    def texts(self) -> list[str]:
        return texts_in(self.seen)

    def arming_refusal(self) -> str:
        self.send_command(ARM, 1)
        return str(self.wait("STATUSTEXT", where=lambda m: m.text.startswith("Arm:")).text)

    def _take_off(self) -> None:
        self.get_ready(GUIDED, needs_position=True)
        assert self.arm() == ACCEPTED, self.texts()
        assert self.command(mav.MAV_CMD_NAV_TAKEOFF, *[0] * 6, HEIGHT_M) == ACCEPTED
        for _ in range(150):
            if any(m.z < 1.0 - HEIGHT_M for m in named(self.hold(0.1), "LOCAL_POSITION_NED")):
                return
        raise AssertionError("the vehicle does not take off")

    def _settle(self) -> None:
        for _ in range(400):
            self.override(1500, 1500, 1500, 1500)
            for state in named(self.advance(0.05), "LOCAL_POSITION_NED")[-1:]:
                too_low_m = HEIGHT_M + state.z
                speeds_mps = (abs(state.vx), abs(state.vy), abs(state.vz))
                is_there = -TOO_HIGH_M < too_low_m < TOO_LOW_M
                if is_there and max(speeds_mps) < STILL_MPS:
                    return
                up_mps = 0.0 if is_there else max(-2.5, min(2.5, too_low_m))
                self.send(velocity_target(vz=-up_mps))
        raise AssertionError("the vehicle does not come to rest")

    def come_down(self) -> None:
        """Get to the ground and disarm; wait until the height estimate recovers from the impact."""
        super().come_down()
        self.stream(mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED, 20)
        for _ in range(15):
            if all(abs(m.vz) < STILL_MPS for m in named(self.advance(1.0), "LOCAL_POSITION_NED")):
                return

    def restore(self) -> None:
        """Leave the vehicle in the air in BRAKE, or on the ground with its receiver's sticks."""
        flies = self.in_the_air
        if flies:
            self.set_mode(BRAKE)
        super().restore()
        if not flies:
            self.command(ARM, 0)
        self.override(*[0] * 8)
        self.advance(0.02)
