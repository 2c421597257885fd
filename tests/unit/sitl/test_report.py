"""Flight log: counts, sticks and crashes."""

from itertools import pairwise

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl.ardupilot.flight_modes import Mode
from sitl.clock import NS_PER_MS, NS_PER_S
from sitl.course import AirborneStart
from sitl.report import FlightLog
from sitl.simulated_vehicle import SimulatedVehicle
from sitl.vehicle.config import STEP_NS


def test_releases_and_foreign_overrides_on_the_link_are_distinguished():
    vehicle = SimulatedVehicle(links=1, boot_ns=0)
    sender = mav.MAVLink(None, srcSystem=255)
    for primary in ([1500] * 8, [1500, 0, *[65535] * 6], [0] * 8, [0, *[65535] * 7], [65535] * 8):
        frame = mav.MAVLink_rc_channels_override_message(1, 1, *primary).pack(sender)
        vehicle.receive(0, frame, 0)
    sender.srcSystem = 42
    vehicle.receive(0, mav.MAVLink_rc_channels_override_message(1, 1, *[0] * 8).pack(sender), 0)
    summary = vehicle.log.summary(vehicle.ap)
    assert summary["overrides"] == 2
    assert summary["releases"] == 2


def test_sticks_are_recorded_when_they_change_with_how_the_vehicle_moved(pilot):
    log = FlightLog(0, None)
    watch = log.on_step
    pilot.take_off()
    start_s = pilot.ap.now_ns / NS_PER_S
    pilot.hold(0.5, roll=1700, watch=watch)
    pilot.ap.set_mode(Mode.LAND)
    pilot.hold(0.5, watch=watch)
    first, *_, last = entries = log.summary(pilot.ap)["sticks"]
    neutral = next(entry for entry in entries if entry["us"] == (1500,) * 4)
    assert first == {
        "t_s": pytest.approx(start_s + STEP_NS / NS_PER_S),
        "us": (1700, 1500, 1500, 1500),
        "mode": "ALT_HOLD",
        "armed": True,
        "failsafe": False,
        "lean_deg": pytest.approx(0.0, abs=0.1),
        "climb_mps": pytest.approx(0.0, abs=0.1),
        "height_m": pytest.approx(6.5, abs=0.1),
    }
    assert neutral["t_s"] == pytest.approx(start_s + 0.5, abs=0.003)
    assert neutral["lean_deg"] == pytest.approx(11.25, abs=0.3)
    assert (last["mode"], last["climb_mps"]) == ("LAND", pytest.approx(-0.5, abs=0.1))
    assert max(b["t_s"] - a["t_s"] for a, b in pairwise(entries)) <= 0.051


def test_after_a_stall_a_stick_is_not_recorded_before_it_came():
    vehicle = SimulatedVehicle(links=1, boot_ns=0)
    vehicle.step(STEP_NS)
    override = mav.MAVLink_rc_channels_override_message(1, 1, 1700, *[65535] * 7)
    vehicle.receive(0, override.pack(mav.MAVLink(None, srcSystem=255)), 300 * NS_PER_MS)
    vehicle.step(301 * NS_PER_MS)
    changed = vehicle.log.summary(vehicle.ap)["sticks"][1]
    assert (changed["us"][0], changed["t_s"]) == (1700, 0.3)


def test_a_vehicle_that_is_put_elsewhere_has_not_flown_there():
    vehicle = SimulatedVehicle(links=1, boot_ns=0)
    far_ned_m = (30.0, 40.0, -5.0)
    vehicle.launch(AirborneStart(position_ned_m=far_ned_m))
    vehicle.step(NS_PER_S // 10)
    assert vehicle.ap.truth.position_ned_m == pytest.approx(far_ned_m, abs=0.5)
    vehicle.reboot()
    vehicle.step(NS_PER_S // 5)
    assert vehicle.ap.truth.position_ned_m == pytest.approx((0.0, 0.0, 0.0), abs=0.5)
    assert vehicle.log.distance_m < 0.5
