"""One measured flight: ``python -m mavbridge.commands.bench.flight_process --port P ...``.

It is composed and sends as ``mavbridge fly``. A policy without training would fly the vehicle into
the ground, and a vehicle that has crashed takes no sticks: so each chunk is computed in full, and
then its values are replaced by a slow level climb. Only for a simulated vehicle.
"""

import time
from dataclasses import replace

from cyclopts import App
from rich.console import Console

from mavbridge.commands.bench.flight import FlightJob
from mavbridge.commands.bench.missed_slots import (
    GcTimer,
    MissedSlotProbe,
    stolen_ms_since,
    stolen_ns,
)
from mavbridge.commands.bench.results import OURS, Flight, name_of, solves_of, to_json
from mavbridge.config.flight import CameraConfig, FlyConfig, Limits, LinkConfig
from mavbridge.config.policy import PolicyConfig
from mavbridge.core.clock import NS_PER_S, MonotonicClock, period_ns
from mavbridge.core.records import Event, Tick
from mavbridge.flight.app import fly_executable
from mavbridge.flight.policies import load_configured_policy
from mavbridge.observe.timing import FlightTiming, ObserverDrops, TimingReport
from policy.contract import Executable, FloatArray

CLIMB_STICK = 0.3
"""0.3 m/s up in ALT_HOLD: beyond its dead zone, some 20 m in a minute."""
MAX_FEATURE_AGE_S = 5.0
"""A slow engine is to be measured, not released: far from what any of them needs."""
app = App(help=__doc__)


@app.default
def main(job: FlightJob) -> None:
    """Fly once and write the figures."""
    clock = MonotonicClock()
    executable = load_configured_policy(job.policy, clock).executable
    loops = job.rates.loops(is_dual=executable.dual_rate)
    meter = FlightMeter(action_hz=loops.action_hz, vision_hz=loops.max_vision_hz)
    config = FlyConfig(
        link=LinkConfig(connect=f"udp:127.0.0.1:{job.port}"),
        policy=job.policy,
        camera=CameraConfig(camera=job.camera),
        rates=job.rates,
        limits=Limits(max_feature_age=MAX_FEATURE_AGE_S),
        mode="ALT_HOLD",
        arm=True,
        duration=job.duration,
    )
    with GcTimer(clock) as gc_timer:
        probe = MissedSlotProbe(period_ns=period_ns(loops.action_hz), gc_timer=gc_timer)
        console = Console(stderr=True)
        climb = level_climb(executable)
        fly_executable(config, climb, clock=clock, console=console, sinks=(meter, probe))
    job.out.write_text(to_json(_flight(job.policy, executable.engine, meter, probe)))


def level_climb(executable: Executable) -> Executable:
    """An executable that does the same work and returns other sticks."""

    def act(
        encoded: FloatArray, state: FloatArray, history: FloatArray, elapsed_s: float | None
    ) -> FloatArray:
        chunk = executable.act(encoded, state, history, elapsed_s).copy()
        chunk[...] = (CLIMB_STICK, 0.0, 0.0, 0.0)
        return chunk

    return replace(executable, act=act)


class FlightMeter:
    """A ``TickSink`` that measures from the policy's first action on.

    Waiting, handshake and arming are cheap ticks on time: they would flatter a slow engine.
    """

    def __init__(self, *, action_hz: float, vision_hz: float) -> None:
        self._timing = FlightTiming(action_hz=action_hz, vision_hz=vision_hz)
        self._cpu_start_ns: int | None = None
        self.stolen_start_ns: int | None = None
        self.cpu_ns = 0

    def emit(self, event: Event) -> None:
        """Count the event."""
        if isinstance(event, Tick) and event.trace is not None:
            if self._cpu_start_ns is None:
                self._cpu_start_ns, self.stolen_start_ns = time.process_time_ns(), stolen_ns()
            self.cpu_ns = time.process_time_ns() - self._cpu_start_ns
        if self._cpu_start_ns is not None:
            self._timing.emit(event)

    def report(self) -> TimingReport:
        """Figures of the flight so far; names and link are left empty."""
        drops = ObserverDrops(rerun=None, recorder=None)
        return self._timing.report(
            mode="dual", engine="", policy="", autopilot=None, link=None, observer_drops=drops
        )


def _flight(
    policy: PolicyConfig, engine: str, meter: FlightMeter, probe: MissedSlotProbe
) -> Flight:
    report = meter.report()
    action, vision = report.action, report.vision
    return Flight(
        runner=OURS,
        policy=name_of(policy),
        solves=solves_of(policy),
        engine=engine,
        asked_action_hz=action.target_hz,
        asked_vision_hz=vision.target_hz,
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
        stolen_ms=stolen_ms_since(meter.stolen_start_ns),
        missed_by_cause=probe.missed_by_cause,
    )


if __name__ == "__main__":
    app()
