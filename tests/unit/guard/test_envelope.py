"""The envelope: each limit, its persistence, and what cannot be watched."""

import math
from dataclasses import replace
from typing import Any

import pytest

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.vehicle import Reading, Telemetry, VehicleStatus
from mavbridge.guard.envelope import Envelope, EnvelopeLimits

MS, S = NS_PER_MS, NS_PER_S
LOW = because(Code.BATTERY)
STATUS = VehicleStatus(
    mode="ALT_HOLD",
    armed=True,
    is_landed=False,
    position_ned_m=(3.0, 4.0, -10.0),
    is_position_valid=True,
)


def tilted(degrees: float, axis: str = "roll") -> tuple[float, float, float, float]:
    half = math.radians(degrees) / 2
    x, y = (math.sin(half), 0.0) if axis == "roll" else (0.0, math.sin(half))
    return math.cos(half), x, y, 0.0


def beyond(quantity: str, value: float, limit: float, unit: str = "m") -> Reason:
    data = {"quantity": quantity, "value": pytest.approx(value), "limit": limit, "unit": unit}
    return because(Code.BEYOND, **data)


class Flight:
    """Readings at one rate, checks at another."""

    def __init__(self, limits: EnvelopeLimits | None = None, *, state_hz: float = 100.0) -> None:
        self.envelope = Envelope(limits or EnvelopeLimits())
        self.period_ns = round(S / state_hz)
        self.now_ns = 100 * S
        self.status = STATUS
        self.attitude: tuple[float, ...] | None = tilted(10)
        self.velocity: tuple[float, ...] | None = (3.0, 0.0, 0.0)

    def run(self, duration_s: float, **status: Any) -> Reason | None:
        """Checks at 400 Hz; returns the reason of the first end."""
        self.status = replace(self.status, **status)
        until_ns = self.now_ns + round(duration_s * S)
        while self.now_ns < until_ns:
            stamp_ns = self.now_ns // self.period_ns * self.period_ns
            telemetry = Telemetry(
                ned_from_body_wxyz=Reading(stamp_ns, self.attitude) if self.attitude else None,
                velocity_ned_mps=Reading(stamp_ns, self.velocity) if self.velocity else None,
            )
            if (end := self.envelope.check(self.now_ns, telemetry, self.status)) is not None:
                return end
            self.now_ns += S // 400
        return None


@pytest.mark.parametrize("axis", ["roll", "pitch"])
@pytest.mark.parametrize("degrees", [63, -63, 90, 179])
def test_too_much_tilt_ends_the_flight(degrees: float, axis: str) -> None:
    flight = Flight()
    flight.attitude = tilted(degrees, axis)
    assert flight.run(0.2) == beyond("tilt", abs(degrees), 60.0, "deg")


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"velocity": (12.0, 0.0, -17.0)}, beyond("speed", math.hypot(12, 17), 20.0, "m/s")),
        ({"position_ned_m": (0.0, 0.0, -121.0)}, beyond("height", 121.0, 120.0)),
        (
            {"position_ned_m": (-240.0, 200.0, -9.0)},
            beyond("distance", math.hypot(240, 200), 300.0),
        ),
        ({"is_position_valid": False}, because(Code.ESTIMATOR_LOST)),
        ({"battery_problem": LOW}, LOW),
        ({"is_landed": True}, because(Code.LANDED)),
    ],
)
def test_each_quantity_ends_the_flight_by_name(change: dict[str, Any], reason: Reason) -> None:
    flight = Flight()
    assert flight.run(0.5) is None
    status = dict(change)  # the parameter is this test's in every run of it
    flight.velocity = status.pop("velocity", flight.velocity)
    assert flight.run(1.0, **status) == reason


@pytest.mark.parametrize("state_hz", [10.0, 100.0, 400.0])
def test_one_bad_reading_ends_no_flight(state_hz: float) -> None:
    flight = Flight(state_hz=state_hz)
    flight.run(0.5)
    for _ in range(5):
        flight.attitude, flight.velocity = tilted(90), (99.0, 0.0, 0.0)
        assert flight.run(1 / state_hz) is None
        flight.attitude, flight.velocity = tilted(0), (0.0, 0.0, 0.0)
        assert flight.run(2 / state_hz) is None


def test_what_has_no_data_is_said_to_be_not_watched() -> None:
    flight = Flight()
    flight.attitude = flight.velocity = None
    nothing = {"position_ned_m": None, "is_position_valid": None, "is_landed": None}
    assert flight.run(1.0, is_charge_known=False, **nothing) is None
    assert flight.envelope.unwatched == [
        "tilt is not watched: no fresh attitude",
        "speed is not watched: no valid velocity",
        "height is not watched: no valid position",
        "distance is not watched: no valid position",
        "estimator is not watched: it reports no valid position",
        "min_battery is not watched: the vehicle reports no charge",
        "landing is not watched: the vehicle does not say whether it is in the air",
    ]


def test_a_reading_is_watched_until_it_is_500_ms_old() -> None:
    envelope = Envelope(EnvelopeLimits())
    telemetry = Telemetry(
        ned_from_body_wxyz=Reading(0, tilted(90)), velocity_ned_mps=Reading(0, (99.0, 0.0, 0.0))
    )
    old = ["tilt is not watched: no fresh attitude", "speed is not watched: no valid velocity"]
    for now_ns, unwatched in ((500 * MS, []), (501 * MS, old), (2 * S, old)):
        assert envelope.check(now_ns, telemetry, STATUS) is None
        assert envelope.unwatched == unwatched


@pytest.mark.parametrize("name", ["attitude", "velocity"])
def test_a_gap_in_the_readings_starts_the_count_again(name: str) -> None:
    flight = Flight(state_hz=400.0)
    flight.run(0.1)
    good, bad = getattr(flight, name), {"attitude": tilted(90), "velocity": (99.0, 0.0, 0.0)}[name]
    for reading in (bad, None, bad, None, bad):
        setattr(flight, name, reading)
        assert flight.run(0.04) is None
    setattr(flight, name, good)
    assert flight.run(0.1) is None


@pytest.mark.parametrize(
    ("change", "persist_ms"),
    [
        ({"position_ned_m": (0.0, 0.0, -121.0)}, 300),
        ({"position_ned_m": (301.0, 0.0, -9.0)}, 300),
        ({"is_position_valid": False}, 600),
        ({"battery_problem": LOW}, 600),
        ({"is_landed": True}, 600),
    ],
)
def test_what_the_vehicle_says_must_be_out_for_just_so_long(
    change: dict[str, Any], persist_ms: int
) -> None:
    envelope, status = Envelope(EnvelopeLimits()), replace(STATUS, **change)
    envelope.check(0, Telemetry(), STATUS)
    for now_ns in (1 * S, 1 * S + persist_ms * MS - 1):
        assert envelope.check(now_ns, Telemetry(), status) is None
    assert envelope.check(1 * S + persist_ms * MS, Telemetry(), status) is not None


def test_readings_must_be_out_for_50_ms_by_their_own_stamps() -> None:
    envelope = Envelope(EnvelopeLimits())

    def ends(stamp_ns: int) -> bool:
        telemetry = Telemetry(ned_from_body_wxyz=Reading(stamp_ns, tilted(90)))
        return envelope.check(S, telemetry, STATUS) is not None

    first_ns = S - 100 * MS
    assert [ends(first_ns + after_ns) for after_ns in (0, 50 * MS - 1, 50 * MS)] == [
        *(False, False, True)
    ]


def test_what_is_at_its_limit_is_inside_and_small_limits_count() -> None:
    limits = EnvelopeLimits(height_m=0.5)
    assert Flight(limits).run(1.0, position_ned_m=(0.0, 0.0, -0.5)) is None
    told = Flight(limits).run(1.0, position_ned_m=(0.0, 0.0, -0.6))
    assert told == beyond("height", 0.6, 0.5)


def test_a_new_flight_counts_anew() -> None:
    flight = Flight()
    assert flight.run(0.5, battery_problem=LOW) is None
    flight.envelope.reset()
    assert flight.run(0.5) is None
    assert flight.run(0.2) == LOW


def test_a_vehicle_that_has_not_taken_off_has_not_landed() -> None:
    flight = Flight()
    assert flight.run(5.0, is_landed=True) is None
    assert flight.run(1.0, is_landed=False) is None
    assert flight.run(1.0, is_landed=True, armed=False) is None  # disarming is told elsewhere
    assert flight.run(1.0, armed=True) == because(Code.LANDED)
    flight.envelope.reset()
    assert flight.run(5.0) is None


@pytest.mark.parametrize("limit", [0.0, math.inf])
def test_zero_and_infinity_switch_a_limit_off(limit: float) -> None:
    limits = EnvelopeLimits(tilt_deg=limit, height_m=limit, speed_mps=limit, distance_m=limit)
    flight = Flight(limits)
    flight.attitude, flight.velocity = tilted(180), (500.0, 0.0, 0.0)
    assert flight.run(2.0, position_ned_m=(9e3, 0.0, -9e3)) is None
    flight.attitude = flight.velocity = None
    assert flight.run(2.0, position_ned_m=None) is None
    assert flight.envelope.unwatched == []


def test_of_two_reasons_the_first_is_told() -> None:
    told = Flight().run(1.0, position_ned_m=(400.0, 0.0, -200.0))
    assert told == beyond("height", 200.0, 120.0)


def test_an_estimator_that_says_nothing_is_said_to_be_not_watched() -> None:
    missing = "estimator is not watched: it reports no valid position"
    silent = Flight()
    silent.run(0.1)
    silent.run(0.1, is_position_valid=None)
    assert missing in silent.envelope.unwatched
    never = Flight()
    never.run(0.1, is_position_valid=False)
    assert missing in never.envelope.unwatched


def test_without_a_position_from_the_start_none_is_lost() -> None:
    flight = Flight()
    assert flight.run(5.0, is_position_valid=False, position_ned_m=None) is None


def test_in_the_air_counts_while_armed() -> None:
    flight = Flight()
    assert flight.run(1.0, armed=False, is_landed=False) is None
    assert flight.run(2.0, armed=True, is_landed=True) is None
