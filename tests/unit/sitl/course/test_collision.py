import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl.course import BAR_M, DEPTH_M, VEHICLE_RADIUS_M, AirborneStart, Course, Gate, struck_gate
from sitl.simulated_vehicle import SimulatedVehicle
from sitl.vehicle.config import STEP_NS, VehicleConfig

GATE = Gate(center_ned_m=(10.0, 0.0, -2.0), yaw_rad=0.0, size_m=2.4, index=0)
FAR_GATE = Gate(center_ned_m=(20.0, 0.0, -2.0), yaw_rad=0.0, size_m=2.4, index=1)
COURSE = Course(seed=0, gates=(GATE, FAR_GATE))
FREE_M = 1.2 - VEHICLE_RADIUS_M
OUTER_M = 1.2 + BAR_M + VEHICLE_RADIUS_M
FRONT_M = 10.0 - DEPTH_M / 2 - VEHICLE_RADIUS_M


@pytest.mark.parametrize(
    ("start", "end", "struck"),
    [
        pytest.param((5, 0, -2), (15, 0, -2), None, id="through the middle"),
        pytest.param((5, 1.36, -2), (15, 1.36, -2), 0, id="right bar"),
        pytest.param((5, -1.36, -2), (15, -1.36, -2), 0, id="left bar"),
        pytest.param((5, 0, -3.36), (15, 0, -3.36), 0, id="top bar"),
        pytest.param((5, 0, -0.64), (15, 0, -0.64), 0, id="bottom bar"),
        pytest.param((5, FREE_M - 0.01, -2), (15, FREE_M - 0.01, -2), None, id="just inside"),
        pytest.param((5, FREE_M + 0.01, -2), (15, FREE_M + 0.01, -2), 0, id="touches inside"),
        pytest.param((5, OUTER_M - 0.01, -2), (15, OUTER_M - 0.01, -2), 0, id="touches outside"),
        pytest.param((5, OUTER_M + 0.01, -2), (15, OUTER_M + 0.01, -2), None, id="just outside"),
        pytest.param((5, 1.36, -2), (FRONT_M - 0.01, 1.36, -2), None, id="stops short of it"),
        pytest.param((5, 1.36, -2), (FRONT_M + 0.01, 1.36, -2), 0, id="arrives"),
        pytest.param((9.9, 0, -2), (9.9, 3, -2), 0, id="sideways from inside"),
        pytest.param((10, 1.36, -2), (10, 1.36, -2), 0, id="stands in it"),
        pytest.param((25, 1.36, -2), (15, 1.36, -2), 1, id="the second one, from behind"),
        pytest.param((5, 1.36, -9), (15, 1.36, -9), None, id="high above"),
    ],
)
def test_a_straight_way(start, end, struck):
    assert struck_gate(COURSE, start, end) == struck


@pytest.mark.parametrize(("firmware", "speed_mps"), [("ardupilot", 6.0), ("px4", 3.4)])
def test_a_struck_frame_is_a_crash_told_once_and_ends_the_count(firmware, speed_mps):
    """PX4's airframe has more drag."""
    config = VehicleConfig(autopilot=firmware, estimator_ready_s=0.0, position_ready_s=0.0)
    vehicle = SimulatedVehicle(links=1, boot_ns=0, config=config, course=COURSE)
    start = AirborneStart(position_ned_m=(7.0, 1.1, -2.0), velocity_ned_mps=(6.0, 0.0, 0.0))
    vehicle.launch(start)
    for _ in range(100):
        heartbeat = mav.MAVLink_heartbeat_message(mav.MAV_TYPE_GCS, 8, 0, 0, 0, 3)
        vehicle.receive(0, heartbeat.pack(mav.MAVLink(None, srcSystem=255)), vehicle.ap.now_ns)
        vehicle.step(vehicle.ap.now_ns + 4 * STEP_NS)
    parser = mav.MAVLink(None)
    told = [
        (message.severity, message.text)
        for message in parser.parse_buffer(vehicle.take_outgoing(0))
        if message.get_type() == "STATUSTEXT" and "Crash" in message.text
    ]
    summary = vehicle.log.summary(vehicle.ap)
    assert vehicle.ap.truth.position_ned_m[0] > 10.0, "flies on"
    assert summary["crashed"]
    assert summary["crash"]["speed_mps"] == pytest.approx(speed_mps, abs=1.0)
    assert summary["gates"]["passed"] == []
    assert told == [(2, f"Crash: hit gate 0 at {vehicle.log.crash.speed_mps:.1f} m/s")]
