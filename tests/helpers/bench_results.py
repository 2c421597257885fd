from mavbridge.commands.bench.results import (
    BenchResult,
    Flight,
    Kernel,
    Link,
    Machine,
    RateTrial,
    Roofline,
    TopRate,
    Vehicle,
)
from mavbridge.core.records import Percentiles

ENCODE, SAMPLE = "encode", "sample"


def all_equal(value: float) -> Percentiles:
    return Percentiles(p50=value, p99=value, p999=value, max=value)


def make_flight(
    runner: str, engine: str, *, action_hz: float | None, cores: float, wire_ms: float
) -> Flight:
    return Flight(
        runner=runner,
        policy="toge:small",
        engine=engine,
        asked_action_hz=100.0,
        asked_vision_hz=30.0,
        duration_s=60.0,
        action_hz=action_hz,
        vision_hz=15.0,
        missed_slots=12,
        period_ms=all_equal(10.0),
        predict_ms=None,
        encode_ms=all_equal(20.0),
        feature_age_ms=all_equal(50.0),
        state_to_wire_ms=all_equal(wire_ms),
        cpu_cores=cores,
        stolen_ms=None,
        missed_by_cause={"inference": 9, "host": 3} if runner == "mavbridge" else None,
        vehicle=Vehicle(override_hz=99.0, gap_p50_ms=10.0, gap_p99_ms=11.0, gap_max_ms=12.0),
    )


def make_link(client: str, *, round_trip_ms: float, work_ms: float | None) -> Link:
    return Link(
        client=client,
        output="rc channels override",
        sent=600,
        answered=599,
        round_trip_ms=all_equal(round_trip_ms),
        state_to_wire_ms=None,
        work_ms=None if work_ms is None else all_equal(work_ms),
    )


def make_roofline(work: str, precision: str, floor_ms: float) -> Roofline:
    return Roofline(
        work=work,
        precision=precision,
        gflop=2.0,
        weights_mb=40.0,
        gflop_per_s=100.0,
        gb_per_s=10.0,
        floor_ms=floor_ms,
    )


RESULT = BenchResult(
    machine=Machine(cpu="some cpu", cores=2, python="3.11.0", torch="2.13.0"),
    quick=True,
    kernels=(
        Kernel(work=ENCODE, engine="torch", p50_ms=60.0, p99_ms=70.0),
        Kernel(work=SAMPLE, engine="torch", p50_ms=18.0, p99_ms=20.0),
        Kernel(work=ENCODE, engine="quick", p50_ms=15.0, p99_ms=16.0),
    ),
    rooflines=(
        make_roofline(ENCODE, "f32", 20.0),
        make_roofline(ENCODE, "bf16", 5.0),
        make_roofline(SAMPLE, "f32", 3.0),
    ),
    flights=(
        make_flight("mavbridge", "torch", action_hz=50.0, cores=1.0, wire_ms=20.0),
        make_flight("usual runner", "torch", action_hz=25.0, cores=1.0, wire_ms=400.0),
    ),
    top_rates=(
        TopRate(
            label="torch",
            action_hz=None,
            trials=(RateTrial(action_hz=25.0, missed_fraction=0.5, vision_hz=9.0),),
        ),
        TopRate(label="quick", action_hz=250.0, trials=()),
    ),
    links=(
        make_link("mavbridge, 100 Hz clock", round_trip_ms=5.0, work_ms=0.6),
        make_link("bare pymavlink loop", round_trip_ms=0.3, work_ms=None),
    ),
    notes=("MAVSDK-Python 4: not measured, it is not installed",),
)
