"""Flight modes: ArduCopter's mode numbers and the control laws from sticks to motor commands."""

from enum import IntEnum

from sitl.ardupilot import rc as pilot
from sitl.ardupilot.control import STEP_S, AttitudeController, boosted, lean_for
from sitl.ardupilot.guided import GuidedControl
from sitl.ardupilot.params import ArduPilotParams
from sitl.ardupilot.rc import Sticks
from sitl.vehicle.dynamics import BodyState, HeightController, mix, shorten
from sitl.vehicle.rotation import Quat, Vec3, horizontal, length

IDLE = (0.03, 0.03, 0.03, 0.03)  # armed on the ground, throttle down

SLOW_DESCENT_HEIGHT_M = 10.0  # LAND descends at WPNAV_SPEED_DN above this, at LAND_SPEED below
RTL_SPEED_MPS = 5.0
RTL_ARRIVED_M = 1.0
POSITION_GAIN_PER_S = 0.8
VELOCITY_GAIN_PER_S = 2.0
HOLD_ACCEL_MPS2 = 2.5  # limit of braking and holding: 14 degrees of lean, as in LOITER and LAND
HOLD_BELOW_MPS = 0.3  # braking ends at this speed, and the present position is held


class Mode(IntEnum):
    """Flight mode: its number in HEARTBEAT.custom_mode, and what it has of the properties below."""

    STABILIZE = 0, "manual_throttle"
    ALT_HOLD = 2, "climb_throttle"
    GUIDED = 4, "is_guided needs_position"
    LOITER = 5, "climb_throttle holds_position needs_position"
    RTL = 6, "lands needs_position"
    LAND = 9, "lands"
    POSHOLD = 16, "climb_throttle holds_position needs_position"
    BRAKE = 17, "holds_position needs_position"
    GUIDED_NOGPS = 20, "is_guided"

    manual_throttle: bool  # the stick is thrust: refused in RC failsafe, and down for arming
    climb_throttle: bool  # the stick is a climb rate, and holds the height when centred
    is_guided: bool
    holds_position: bool  # stops and holds: LOITER and POSHOLD at centred sticks, BRAKE always
    needs_position: bool  # refused to an armed vehicle without a position
    lands: bool  # ends on the ground; touching down stops the motors at once
    piloted: bool
    can_arm: bool

    def __new__(cls, number: int, properties: str = "") -> "Mode":
        mode = int.__new__(cls, number)
        mode._value_ = number
        has = properties.split().__contains__
        mode.manual_throttle, mode.climb_throttle = has("manual_throttle"), has("climb_throttle")
        mode.is_guided, mode.lands = has("is_guided"), has("lands")
        mode.holds_position, mode.needs_position = has("holds_position"), has("needs_position")
        mode.piloted = mode.manual_throttle or mode.climb_throttle
        mode.can_arm = mode.piloted or mode.is_guided
        return mode


class CopterControl:
    """Control laws of all modes, with their shared controllers."""

    def __init__(self, params: ArduPilotParams) -> None:
        self._params = params
        self._attitude = AttitudeController(params)
        self._height = HeightController(STEP_S)
        self._home_reached = False
        self._hold_m: complex | None = None  # north + 1j * east
        self.guided = GuidedControl(params, self._attitude, self._height)
        self.sinks_from_ns = 0
        """LAND holds its height until then, after a failsafe chose it."""
        self.thrust = self.collective = 0.0
        """Commanded mean thrust, as a fraction of full, before and after the boost for a lean."""

    @property
    def target(self) -> tuple[Quat, Vec3]:
        return self._attitude.target

    def enter(self, mode: Mode, body: BodyState) -> None:
        self.reset(body)
        self.sinks_from_ns = 0
        self.guided.enter(body, with_position=mode is Mode.GUIDED)

    def reset(self, body: BodyState) -> None:
        """Clear the targets; keep the setpoints of a companion computer."""
        self._attitude.reset(body)
        self._height.reset(body)
        self._home_reached = False
        self._hold_m = None
        self.thrust = self.collective = 0.0

    def idle(self, body: BodyState) -> tuple[float, ...]:
        self.reset(body)
        return IDLE

    def wants_takeoff(self, mode: Mode, sticks: Sticks) -> bool:
        if mode.manual_throttle:
            return sticks.throttle > 0.0
        is_climb = pilot.climb_rate_mps(sticks, self._params) > 0.0
        return mode.climb_throttle and is_climb

    def fly(
        self, mode: Mode, sticks: Sticks, body: BodyState, now_ns: int, *, has_position: bool
    ) -> tuple[float, ...]:
        if mode.is_guided:
            turn, self.thrust = self.guided.fly(body, now_ns, has_position=has_position)
        else:
            waits = now_ns < self.sinks_from_ns
            climb_mps = 0.0 if waits else self._climb_mps(mode, sticks, body)
            turn = self._lean(mode, sticks, body, has_position=has_position)
            if mode.manual_throttle:
                self.thrust = pilot.manual_thrust(sticks, self._params)
            else:
                self.thrust = self.guided.climb(body, climb_mps, "PILOT_ACCEL_Z")
        is_boosted = not mode.manual_throttle
        self.collective = boosted(self.thrust, body, self._params) if is_boosted else self.thrust
        return mix(self.collective, turn)

    def _lean(self, mode: Mode, sticks: Sticks, body: BodyState, *, has_position: bool) -> Vec3:
        """Run one step of a leaning mode. Return the body angular acceleration [rad/s^2]."""
        roll, pitch = pilot.lean_angles(sticks, self._params) if mode.piloted else (0.0, 0.0)
        if roll or pitch or not has_position:
            self._hold_m = None
        elif mode.holds_position:
            roll, pitch = self._lean_to_hold(body)
        elif mode.lands:
            roll, pitch = self._lean_home(mode, body)
        yaw_rate = pilot.yaw_rate_radps(sticks, self._params) if mode.piloted else 0.0
        return self._attitude.lean(body, roll, pitch, yaw_rate)

    def _climb_mps(self, mode: Mode, sticks: Sticks, body: BodyState) -> float:
        if mode.climb_throttle:
            return pilot.climb_rate_mps(sticks, self._params)
        if mode is Mode.BRAKE:
            return 0.0
        height = -body.position_ned_m[2]
        if mode is Mode.RTL and not self._home_reached:
            up = self._params["WPNAV_SPEED_UP"] / 100.0
            return max(0.0, min(up, self._params["RTL_ALT"] / 100.0 - height))
        if height > SLOW_DESCENT_HEIGHT_M:
            return -self._params["WPNAV_SPEED_DN"] / 100.0
        return -self._params["LAND_SPEED"] / 100.0

    def _lean_home(self, mode: Mode, body: BodyState) -> tuple[float, float]:
        """Return the lean that stops the drift, or in RTL flies home from the return height on."""
        wanted_mps = 0j
        if mode is Mode.RTL and not self._home_reached:
            home_m = -horizontal(body.position_ned_m)
            distance = length(home_m)
            if distance < RTL_ARRIVED_M:
                self._home_reached = True
            elif -body.position_ned_m[2] > self._params["RTL_ALT"] / 100.0 - RTL_ARRIVED_M:
                speed = min(RTL_SPEED_MPS, POSITION_GAIN_PER_S * distance)
                wanted_mps = home_m / distance * speed
        return _lean_towards(wanted_mps, body)

    def _lean_to_hold(self, body: BodyState) -> tuple[float, float]:
        """Return the lean that stops the vehicle and then holds its resting position."""
        wanted_mps = 0j
        if self._hold_m is not None:
            wanted_mps = POSITION_GAIN_PER_S * (self._hold_m - horizontal(body.position_ned_m))
        elif length(horizontal(body.velocity_ned_mps)) < HOLD_BELOW_MPS:
            self._hold_m = horizontal(body.position_ned_m)
        return _lean_towards(wanted_mps, body)


def _lean_towards(wanted_mps: complex, body: BodyState) -> tuple[float, float]:
    """Return roll and pitch [rad] that bring the velocity to the wanted one, within the limit."""
    accel_mps2 = VELOCITY_GAIN_PER_S * (wanted_mps - horizontal(body.velocity_ned_mps))
    return lean_for(shorten(accel_mps2, HOLD_ACCEL_MPS2), body)
