"""Pilots who fly the simulated vehicle by its receiver alone, in stepped time."""

import pytest

from sitl import UsageError
from sitl.__main__ import main
from sitl.clock import NS_PER_S, Clock
from sitl.course import make_course
from sitl.pilot.demonstrator import CENTRED
from sitl.pilot.transmitter import (
    DEFAULT_AXES,
    IDLE,
    Hand,
    Transmitter,
    make_pilot,
    prepare_vehicle,
)
from sitl.simulated_vehicle import SimulatedVehicle
from sitl.vehicle.config import STEP_NS, VehicleConfig

COURSE = make_course(5)
DOWN = Hand(IDLE)


def vehicle_of(autopilot, **changes):
    config = VehicleConfig(autopilot=autopilot, **changes)
    made = SimulatedVehicle(links=1, boot_ns=0, config=config, course=COURSE)
    prepare_vehicle(made)
    return made


def pilot_of(name, vehicle, axes=DEFAULT_AXES):
    pilot, _ = make_pilot(name, axes, vehicle=vehicle, course=COURSE, clock=Clock())
    return pilot


class Flight(Transmitter):
    """Holds a hand on the transmitter."""

    def __init__(self, vehicle):
        self.vehicle, self.now_ns, self.hand = vehicle, 0, None
        super().__init__(lambda: self.now_ns)

    def _hand(self, now_ns):
        return self.hand

    def hold(self, hand, seconds):
        self.hand = hand
        for _ in range(round(seconds * NS_PER_S / STEP_NS)):
            self.now_ns += STEP_NS
            if (us := self.latest()) is not None:
                self.vehicle.set_receiver(us)
            self.vehicle.step(self.now_ns)


def flown(autopilot, mode=None):
    """Return a flight that was armed and has climbed by the receiver."""
    flight = Flight(vehicle_of(autopilot))
    flight.hold(DOWN, 7)
    assert mode in (None, flight.vehicle.ap.mode_name)
    assert flight.vehicle.ap.arm()
    flight.hold(Hand(CENTRED._replace(throttle=0.7)), 6)
    return flight


@pytest.mark.parametrize(("autopilot", "mode"), [("ardupilot", "ALT_HOLD"), ("px4", "ALTCTL")])
def test_both_firmwares_are_flown_by_the_receiver(autopilot, mode):
    flight = flown(autopilot, mode)
    vehicle = flight.vehicle
    climbed_m = -vehicle.ap.truth.position_ned_m[2]
    assert climbed_m > 2.0
    assert not vehicle.ap.landed
    flight.hold(Hand(CENTRED._replace(pitch=0.4)), 2)
    assert vehicle.ap.truth.velocity_ned_mps[0] > 1.0, "nose down flies forward, north"
    assert not vehicle.ap.disarm(force=False), "not in the air"
    flight.hold(DOWN, 8)
    assert vehicle.ap.landed
    assert vehicle.ap.disarm(force=False)


@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
def test_a_lost_signal_in_flight_is_a_failsafe(autopilot):
    flight = flown(autopilot)
    vehicle = flight.vehicle
    assert not vehicle.ap.in_failsafe
    flight.hold(None, 3)
    assert vehicle.ap.in_failsafe


def test_the_expert_flies_the_course_lands_and_disarms():
    vehicle = vehicle_of("ardupilot")
    pilot = pilot_of("expert", vehicle)
    switch = []
    was_armed = False
    for _ in range(80 * NS_PER_S // STEP_NS):
        if (us := pilot.latest()) is not None:
            vehicle.set_receiver(us)
            switch.append(us[6])
        vehicle.step(vehicle.ap.now_ns + STEP_NS)
        was_armed |= vehicle.ap.armed
        if was_armed and not vehicle.ap.armed:
            break
    assert was_armed
    assert not vehicle.ap.armed
    assert vehicle.ap.landed
    assert vehicle.log.next_gate is None, "every gate"
    assert not vehicle.log.crashed
    high = [us for us in switch if us == 2000]
    assert 0 < len(high) < len(switch)
    assert switch[-1] == 1000
    pilot.close()


def test_unusable_pilots_are_refused(monkeypatch):
    vehicle = vehicle_of("px4")
    with pytest.raises(UsageError, match="ardupilot alone"):
        pilot_of("expert", vehicle)
    with pytest.raises(UsageError, match="--pilot-axes"):
        pilot_of("gamepad", vehicle, axes="roll=1")
    monkeypatch.setenv("SDL_VIDEODRIVER", "no-such-driver")
    with pytest.raises(UsageError, match="needs a display"):
        pilot_of("gamepad", vehicle)


def test_a_pilot_and_another_hand_on_the_receiver_contradict(capsys):
    for other in (("--rc-in", "5501"), ("--receiver", "mid")):
        flags = ["--connect", "udpout:127.0.0.1:1", "--pilot", "expert", *other]
        assert main(flags) == 2
        assert "leave out --rc-in and --receiver" in capsys.readouterr().err
