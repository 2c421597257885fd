from typing import Any

from benchmarks.results import BenchResult, EngineTiming, Flight, LinkLatency
from mavbridge.commands.check.computer import Computer
from mavbridge.core.vehicle import Percentiles


def all_equal(value: float) -> Percentiles:
    return Percentiles(p50=value, p99=value, p999=value, max=value)


def make_flight(runner: str, **changes: Any) -> Flight:
    """Make a flight of 60 s with eager torch, requested at 100 and 30 Hz."""
    fields: dict[str, Any] = {
        "runner": runner,
        "policy": "toge:small",
        "solves": "1 step",
        "engine": "torch",
        "asked_stick_hz": 200.0,
        "asked_action_hz": 100.0,
        "asked_vision_hz": 30.0,
        "duration_s": 60.0,
        "stick_hz": 201.0,
        "action_hz": 50.0,
        "vision_hz": 15.0,
        "missed_slots": 12,
        "lateness_ms": all_equal(0.25) if runner == "mavbridge" else None,
        "chunks": 3000,
        "late_chunks": 7,
        "period_ms": all_equal(10.0),
        "predict_ms": None,
        "encode_ms": all_equal(20.0),
        "feature_age_ms": all_equal(50.0),
        "state_to_wire_ms": all_equal(20.0),
        "cpu_cores": 1.0,
        "guard_cpu_cores": 0.125,
        "guard_waited_ms": 90.0,
        "host_took_ms": 33.0,
    }
    return Flight(**(fields | changes))


def make_timing(work: str, engine: str, p50_ms: float) -> EngineTiming:
    return EngineTiming(policy="toge", work=work, engine=engine, p50_ms=p50_ms, p99_ms=p50_ms + 1)


def make_link(client: str, *, round_trip_ms: float) -> LinkLatency:
    return LinkLatency(
        client=client, sent=600, answered=599, round_trip_ms=all_equal(round_trip_ms)
    )


COMPUTER = Computer(
    model="",
    cpu="some cpu",
    machine="x86_64",
    cores=2,
    kernel="6.1",
    governor="",
    versions={"python": "3.11.0", "torch": "2.13.0"},
)
RESULT = BenchResult(
    machine=COMPUTER,
    engines=(
        make_timing("encode", "torch", 60.0),
        make_timing("sample", "torch", 18.0),
        make_timing("encode", "quick", 15.0),
        make_timing("encode", "roofline f32", 20.0),
        make_timing("encode", "roofline bf16", 5.0),
        make_timing("sample", "roofline f32", 3.0),
    ),
    flights=(
        make_flight("mavbridge"),
        make_flight("baseline", action_hz=25.0, state_to_wire_ms=all_equal(400.0)),
    ),
    links=(
        make_link("mavbridge", round_trip_ms=0.6),
        make_link("bare pymavlink loop", round_trip_ms=0.3),
    ),
    notes=("MAVSDK-Python 4: not measured, it is not installed",),
)
