"""One flight of mavbridge, measured: ``python -m mavbridge.commands.bench.flight_process ...``.

The composition is that of ``mavbridge fly``, sending included. Untrained weights would fly the
vehicle into the ground, and a vehicle that has crashed takes no sticks: so every chunk is computed
in full, and then its values are replaced by a slow level climb. Only for a simulated vehicle.
"""

import argparse
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from mavbridge.commands.bench import engines
from mavbridge.commands.bench.flights import OURS_NAME
from mavbridge.commands.bench.meter import FlightMeter
from mavbridge.commands.bench.results import Flight, to_json
from mavbridge.commands.bench.witness import GcWatch, Witness, read_counters
from mavbridge.config.flight import CameraConfig, FlyConfig, Limits, LinkConfig
from mavbridge.config.policy import PolicyConfig
from mavbridge.config.rates import Rates, period_ns
from mavbridge.core.clock import NS_PER_S, MonotonicClock
from mavbridge.flight.app import fly_executable
from mavbridge.observe.timing import TimingReport
from policy.contract import Executable, FloatArray

CLIMB_STICK = 0.3
"""0.3 m/s up in ALT_HOLD: beyond its dead zone, some 20 m in a minute."""
MAX_FEATURE_AGE_S = 5.0
"""A slow engine is to be measured, not released: the limit is far from what any of them needs."""


def main() -> None:
    """Fly once and write the figures."""
    args = arguments(__doc__)
    clock = MonotonicClock()
    executable = level_climb(engines.load(args.policy, args.engine, head_steps=args.head_steps))
    meter = FlightMeter(action_hz=args.action_hz, vision_hz=args.vision_hz)
    with GcWatch(clock) as collector:
        witness = Witness(
            period_ns=period_ns(args.action_hz), read=lambda: read_counters(collector.total_ns)
        )
        fly_executable(
            _config(args),
            executable,
            clock=clock,
            console=Console(stderr=True),
            sinks=(meter, witness),
        )
    meter.end()
    report = meter.report(engine=executable.engine, policy=executable.name, link=None)
    args.out.write_text(to_json(_flight(args, report, meter, witness)))


def arguments(description: str | None) -> argparse.Namespace:
    """The command line that all runners of the flight test share."""
    parser = argparse.ArgumentParser(description=description, allow_abbrev=False)
    parser.add_argument("--port", type=int, required=True, help="UDP, where the vehicle sends")
    parser.add_argument("--camera", required=True, help="shm:NAME")
    policies = (engines.FLIGHT_POLICY, engines.SHIPPED_POLICY)
    parser.add_argument("--policy", default=engines.FLIGHT_POLICY, choices=policies)
    parser.add_argument("--engine", default=engines.EAGER, choices=engines.ENGINES)
    parser.add_argument("--head-steps", type=int, help="of a warm start")
    parser.add_argument("--action-hz", type=float, required=True)
    parser.add_argument("--vision-hz", type=float, required=True)
    parser.add_argument("--duration", type=float, required=True, help="seconds, once engaged")
    parser.add_argument("--out", type=Path, required=True, help="JSON with the figures")
    return parser.parse_args()


def level_climb(executable: Executable) -> Executable:
    """The same work, other sticks."""

    def act(
        encoded: FloatArray, state: FloatArray, history: FloatArray, elapsed_s: float | None
    ) -> FloatArray:
        chunk = executable.act(encoded, state, history, elapsed_s).copy()
        chunk[...] = (CLIMB_STICK, 0.0, 0.0, 0.0)
        return chunk

    return replace(executable, act=act)


def _config(args: argparse.Namespace) -> FlyConfig:
    return FlyConfig(
        link=LinkConfig(connect=f"udp:127.0.0.1:{args.port}"),
        policy=PolicyConfig(policy=args.policy, dual_rate=True),
        camera=CameraConfig(camera=args.camera),
        rates=Rates(visual_rate=args.vision_hz, action_rate=args.action_hz),
        limits=Limits(max_feature_age=MAX_FEATURE_AGE_S),
        mode="ALT_HOLD",
        arm=True,
        duration=args.duration,
    )


def _flight(
    args: argparse.Namespace, report: TimingReport, meter: FlightMeter, witness: Witness
) -> Flight:
    action, vision = report.action, report.vision
    return Flight(
        runner=OURS_NAME,
        policy=args.policy,
        engine=report.engine,
        asked_action_hz=args.action_hz,
        asked_vision_hz=args.vision_hz,
        duration_s=report.duration_s,
        action_hz=action.rate_hz,
        vision_hz=vision.rate_hz,
        missed_slots=action.missed_slots,
        period_ms=action.period_ms,
        predict_ms=action.predict_ms,
        encode_ms=vision.encode_ms,
        feature_age_ms=report.feature_age_ms,
        state_to_wire_ms=report.state_to_wire_ms,
        cpu_cores=round(meter.cpu_ns / (report.duration_s * NS_PER_S), 3),
        stolen_ms=meter.stolen_ms,
        missed_by_cause=witness.missed_by_cause,
        head_steps=args.head_steps,
    )


if __name__ == "__main__":
    main()
