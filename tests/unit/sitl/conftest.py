"""An ArduPilot without its link, flown by overrides and steps; the far ends of both firmwares."""

import math
from collections.abc import Callable

import pytest

from helpers.ends import Ends, px4_ends
from sitl.ardupilot.autopilot import ArduCopter
from sitl.ardupilot.flight_modes import Mode
from sitl.ardupilot.params import ArduPilotParams
from sitl.clock import NS_PER_S
from sitl.vehicle.config import STEP_NS, VehicleConfig
from sitl.vehicle.rotation import to_euler

STEPS_PER_STICK_UPDATE = 8


class Pilot:
    """Holds the sticks of one autopilot at 50 Hz."""

    def __init__(self, config: VehicleConfig) -> None:
        self.ap = ArduCopter(ArduPilotParams(), config, boot_ns=0)

    def hold(
        self,
        seconds: float,
        *,
        roll: int = 1500,
        pitch: int = 1500,
        thr: int = 1500,
        yaw: int = 1500,
        watch: Callable[[ArduCopter], None] = lambda ap: None,
    ) -> None:
        """Hold these sticks; ``watch`` sees every step."""
        for index in range(round(seconds * NS_PER_S / STEP_NS)):
            if index % STEPS_PER_STICK_UPDATE == 0:
                self.ap.rc.override([roll, pitch, thr, yaw, *[65535] * 4], self.ap.now_ns)
            self.ap.step()
            watch(self.ap)

    def silence(self, seconds: float) -> None:
        for _ in range(round(seconds * NS_PER_S / STEP_NS)):
            self.ap.step()

    def take_off(self, height_m: float = 5.0) -> None:
        """Arm in ALT_HOLD, climb, level off."""
        self.hold(3.5, thr=1000)
        assert self.ap.set_mode(Mode.ALT_HOLD)
        assert self.ap.arm(force=False), self.texts()
        while self.height_m < height_m:
            self.hold(0.1, thr=2000)
        self.hold(3.0)
        self.ap.texts.clear()

    @property
    def height_m(self) -> float:
        return -self.ap.truth.position_ned_m[2]

    def angles_deg(self) -> list[float]:
        return [math.degrees(angle) for angle in to_euler(self.ap.truth.ned_from_body_wxyz)]

    def texts(self) -> list[str]:
        """Status texts since the last call."""
        texts = [text.text for text in self.ap.texts]
        self.ap.texts.clear()
        return texts


@pytest.fixture
def pilot() -> Pilot:
    return Pilot(VehicleConfig())


@pytest.fixture
def station() -> Ends:
    """The far end of an ArduPilot's link."""
    return Ends()


@pytest.fixture
def ends() -> Ends:
    """The far end of a PX4's link."""
    return px4_ends()
