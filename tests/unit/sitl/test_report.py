"""Flight log: counts, sticks and crashes."""

from itertools import pairwise

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl.ardupilot.flight_modes import Mode
from sitl.clock import NS_PER_MS, NS_PER_S
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
    assert summary["overrides"]["count"] == 2
    assert summary["releases"] == 2


def test_sticks_are_recorded_when_they_change_with_how_the_vehicle_moved(pilot):
    log, watch = flown(pilot)
    pilot.take_off()
    start_ns = pilot.ap.now_ns
    pilot.hold(0.5, roll=1700, watch=watch)
    pilot.hold(0.5, watch=watch)
    pilot.ap.set_mode(Mode.LAND)
    pilot.hold(0.5, watch=watch)
    entries = log.summary(pilot.ap)["sticks"]
    changes = [
        after
        for before, after in pairwise(entries)
        if (before["us"], before["mode"]) != (after["us"], after["mode"])
    ]
    stamps_s = [entry["t_s"] for entry in entries]
    neutral, landing = changes
    assert entries[0] == {
        "t_s": (start_ns + STEP_NS) / NS_PER_S,
        "us": (1700, 1500, 1500, 1500),
        "mode": "ALT_HOLD",
        "armed": True,
        "failsafe": False,
        "lean_deg": pytest.approx(0.0, abs=0.1),
        "climb_mps": pytest.approx(0.0, abs=0.1),
        "height_m": pytest.approx(6.5, abs=0.1),
    }
    assert (neutral["us"], neutral["mode"]) == ((1500,) * 4, "ALT_HOLD")
    assert neutral["t_s"] == pytest.approx(start_ns / NS_PER_S + 0.5, abs=0.003)
    assert neutral["lean_deg"] == pytest.approx(11.25, abs=0.3)
    assert landing["mode"] == "LAND"
    assert entries[-1]["climb_mps"] == pytest.approx(-0.5, abs=0.1)
    assert max(b - a for a, b in pairwise(stamps_s)) <= 0.051


def test_after_a_stall_a_stick_is_not_recorded_before_it_came():
    vehicle = SimulatedVehicle(links=1, boot_ns=0)
    vehicle.step(STEP_NS)
    override = mav.MAVLink_rc_channels_override_message(1, 1, 1700, *[65535] * 7)
    vehicle.receive(0, override.pack(mav.MAVLink(None, srcSystem=255)), 300 * NS_PER_MS)
    vehicle.step(301 * NS_PER_MS)
    changed = vehicle.log.summary(vehicle.ap)["sticks"][1]
    assert (changed["us"][0], changed["t_s"]) == (1700, 0.3)


def flown(pilot, course=None):
    log = FlightLog(0, course)
    return log, lambda ap: log.on_step(ap)


def test_falling_out_of_the_sky_is_a_crash(pilot):
    log, watch = flown(pilot)
    pilot.take_off(height_m=5.0)
    pilot.ap.disarm(force=True)
    pilot.hold(3.0, watch=watch)
    summary = log.summary(pilot.ap)
    assert summary["crashed"]
    assert summary["impact_speed_mps"] > 5.0
