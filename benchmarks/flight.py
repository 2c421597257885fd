"""One flight of both loops against the simulated vehicle, each in a process of its own.

``fly`` starts the vehicle and ``python -m benchmarks.flight --port P ...``, which is composed and
sends as ``mavbridge fly``. A policy without training would fly the vehicle into the ground, and a
vehicle that has crashed takes no sticks: so each chunk is computed in full, and then its values are
replaced by a slow level climb. Only for a simulated vehicle.
"""

import json
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import get_type_hints

from cyclopts import App, Parameter

from benchmarks.missed_slots import GuardProbe, stolen_ms_since, stolen_ns
from benchmarks.results import OURS, Flight, from_json, name_of, solves_of, to_json
from mavbridge.commands.output import print_status
from mavbridge.config.flight import CameraConfig, EnvelopeConfig, FlyConfig, LinkConfig
from mavbridge.config.policy import PolicyConfig
from mavbridge.config.rates import Rates
from mavbridge.core.clock import NS_PER_S, Clock, MonotonicClock
from mavbridge.core.errors import PeerError, UserError
from mavbridge.core.processes import end, free_port, running, wait
from mavbridge.core.reasons import Reason
from mavbridge.core.records import Event, Tick
from mavbridge.flight.app import fly_policy
from mavbridge.flight.guard_process import start_guard
from mavbridge.flight.plan import plan_flight
from mavbridge.flight.policies import load_configured_policy
from mavbridge.guard.values import EndRequest
from mavbridge.observe.output import flight_console
from mavbridge.observe.timing import FlightTiming, ObserverDrops, TimingReport
from policy.contract import FloatArray
from policy.protocol import PolicyRunner

FLIGHT_PROCESS = "benchmarks.flight"
STARTING_S = 300.0
"""Most that a process may take beside its flight: imports, compiling an engine, arming. A network
of 263 M parameters compiles for one or two minutes."""
CLIMB_STICK = 0.3
"""0.3 m/s up in ALT_HOLD: beyond its dead zone, some 20 m in a minute."""
NO_CEILING = EnvelopeConfig(max_height=0.0)
"""Ten minutes of that are beyond the usual 120 m."""
LEAST_SHARE = 0.95
"""Share of the asked duration; a flight that ended earlier is no measurement."""
MAX_AGE_S = 5.0
"""A slow engine is to be measured, not released: far from what any of them needs."""
app = App(help=__doc__)


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class FlightJob:
    """The command line of a program that flies once and is measured."""

    port: int
    camera: str
    duration: float
    """Seconds from the policy's first action."""
    out: Path
    policy: PolicyConfig = field(default_factory=PolicyConfig)
    rates: Rates = field(default_factory=Rates)


def fly(
    policy: PolicyConfig,
    rates: Rates,
    duration_s: float,
    *,
    module: str = FLIGHT_PROCESS,
    flags: tuple[str, ...] = (),
) -> Flight:
    """Fly once with the program ``module``, which takes the flags of ``FlightJob`` and ``flags``.

    Raises:
        UserError: the program or the vehicle failed; quotes the end of its log.
    """
    label = ", ".join((module, name_of(policy), solves_of(policy), *flags))
    print_status(f"flight of {duration_s:g} s, sticks at {rates.stick_rate:g} Hz: {label}")
    port = free_port()
    camera = f"shm:mavbridge-bench-{port}"
    with TemporaryDirectory(prefix="mavbridge-bench-") as name:
        folder = Path(name)
        report, out = folder / "vehicle.json", folder / "flight.json"
        log, vehicle_log = folder / "flight.log", folder / "vehicle.log"
        job = FlightJob(
            port=port, camera=camera, duration=duration_s, out=out, policy=policy, rates=rates
        )
        vehicle_command = (
            *(sys.executable, "-m", "sitl", "--camera", camera),
            *("--connect", f"udpout:127.0.0.1:{port}", "--report", str(report)),
        )
        with running(*vehicle_command, log=vehicle_log) as vehicle:
            try:
                command = (sys.executable, "-m", module, *to_flags(job), *flags)
                with running(*command, log=log) as process:
                    wait(process, f"python -m {module}", log, duration_s + STARTING_S)
            except UserError:
                if vehicle.poll() is not None:  # then the flight's log is not the reason
                    wait(vehicle, "python -m sitl", vehicle_log, STARTING_S)
                raise
            end(vehicle)
            wait(vehicle, "python -m sitl", vehicle_log, STARTING_S)
        gaps = json.loads(report.read_text())["overrides"]["gap_ms"]
        return replace(from_json(Flight, out.read_text()), vehicle_gap_ms=gaps)


def to_flags(config: FlightJob | PolicyConfig | Rates) -> tuple[str, ...]:
    """The command line that is parsed back into ``config``."""
    flags: list[str] = []
    hints = get_type_hints(type(config), include_extras=True)
    for each in fields(config):
        value = getattr(config, each.name)
        marks = getattr(hints[each.name], "__metadata__", ())
        names = [name for mark in marks if isinstance(mark, Parameter) for name in mark.name or ()]
        name = names[0] if names else f"--{each.name.replace('_', '-')}"
        if isinstance(value, PolicyConfig | Rates):
            flags += to_flags(value)
        elif isinstance(value, bool):
            flags.append(f"{name}={str(value).lower()}")
        elif value is not None:
            flags += [name, str(value)]
    return tuple(flags)


@app.default
def main(job: FlightJob) -> None:
    """Fly once and write the figures."""
    measure_flight(job)


def measure_flight(
    job: FlightJob, alter: Callable[[PolicyRunner], PolicyRunner] = lambda runner: runner
) -> None:
    """Fly the policy, changed by ``alter``, and write the figures."""
    clock = MonotonicClock()
    with load_configured_policy(job.policy, clock) as loaded:
        _measure(job, clock, loaded.runner, alter)


def _measure(
    job: FlightJob,
    clock: Clock,
    runner: PolicyRunner,
    alter: Callable[[PolicyRunner], PolicyRunner],
) -> None:
    loops = job.rates.loops(is_dual=runner.dual_rate, play_s=runner.contract.play_s)
    meter = FlightMeter(
        stick_hz=job.rates.stick_rate, action_hz=loops.action_hz, vision_hz=loops.max_vision_hz
    )
    config = FlyConfig(
        link=LinkConfig(connect=f"udp:127.0.0.1:{job.port}"),
        policy=job.policy,
        # High above the course the simulator's view, which has no noise, hardly changes.
        camera=CameraConfig(camera=(job.camera,), max_frozen_image=0.0),
        rates=job.rates,
        envelope=NO_CEILING,
        mode="ALT_HOLD",
        arm=True,
        duration=job.duration,
    )
    climb = level_climb(alter(runner))
    with ExitStack() as stack:
        guard = start_guard(config, clock, stack)
        probe, console = GuardProbe(guard.process.pid, clock), flight_console()
        watch = ReleaseWatch(lambda reason: guard.process.send(EndRequest(reason=reason)))
        sinks = (meter, probe, watch)
        plan = plan_flight(config, climb.contract, is_dual=climb.dual_rate)
        fly_policy(plan, climb, clock=clock, console=console, sinks=sinks, guard=guard)
        summary = guard.process.summary
    flight = _flight(job.policy, runner.engine, meter, probe)
    if flight.duration_s < LEAST_SHARE * job.duration:
        lasted = f"the flight lasted {flight.duration_s:g} s instead of {job.duration:g} s"
        raise PeerError(f"{lasted}: {watch.reason}")
    lost = summary.dropped_messages if summary else 0
    job.out.write_text(to_json(replace(flight, lost_reports=lost)))


def level_climb(runner: PolicyRunner) -> PolicyRunner:
    """A runner that does the same work and returns other sticks, however late it is."""

    def act(encoded: FloatArray, state: FloatArray, history: FloatArray) -> FloatArray:
        chunk = runner.act(encoded, state, history).copy()
        chunk[...] = (CLIMB_STICK, 0.0, 0.0, 0.0)
        return chunk

    contract = replace(
        runner.contract,
        max_state_age_s=MAX_AGE_S,
        max_velocity_age_s=MAX_AGE_S,
        max_feature_age_s=MAX_AGE_S,
        max_chunk_age_s=MAX_AGE_S,
    )
    return replace(runner, contract=contract, act=act)


class FlightMeter:
    """A ``TickSink`` that measures from the policy's first action on.

    Waiting, handshake and arming are cheap ticks on time: they would flatter a slow engine.
    """

    def __init__(self, *, stick_hz: float, action_hz: float, vision_hz: float) -> None:
        self._timing = FlightTiming(stick_hz=stick_hz, action_hz=action_hz, vision_hz=vision_hz)
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


class ReleaseWatch:
    """A ``TickSink`` that ends the flight once the policy has lost the sticks.

    Nobody is there to engage it again.
    """

    def __init__(self, end: Callable[[Reason], object]) -> None:
        self._end = end
        self._has_flown = False
        self.reason: Reason | None = None
        """Why the policy lost the sticks; None before that."""

    def emit(self, event: Event) -> None:
        """Look at one tick."""
        if not isinstance(event, Tick):
            return
        self._has_flown = self._has_flown or event.trace is not None
        if self._has_flown and self.reason is None and event.release_reason is not None:
            self.reason = event.release_reason
            self._end(self.reason)


def _flight(policy: PolicyConfig, engine: str, meter: FlightMeter, probe: GuardProbe) -> Flight:
    report = meter.report()
    sticks, action, vision = report.sticks, report.action, report.vision
    elapsed_ns = report.duration_s * NS_PER_S
    return Flight(
        runner=OURS,
        policy=name_of(policy),
        solves=solves_of(policy),
        engine=engine,
        asked_stick_hz=sticks.target_hz,
        asked_action_hz=action.target_hz,
        asked_vision_hz=vision.target_hz,
        duration_s=report.duration_s,
        stick_hz=sticks.rate_hz,
        action_hz=action.rate_hz,
        vision_hz=vision.rate_hz,
        missed_slots=sticks.missed_slots,
        lateness_ms=sticks.lateness_ms,
        coasting_sends=sticks.coasting_sends,
        chunks=action.chunks,
        late_chunks=action.late_chunks,
        period_ms=action.period_ms,
        predict_ms=action.predict_ms,
        encode_ms=vision.encode_ms,
        feature_age_ms=report.feature_age_ms,
        state_age_ms=report.state_age_ms,
        state_to_wire_ms=report.state_to_wire_ms,
        cpu_cores=round((meter.cpu_ns + probe.cpu_ns) / elapsed_ns, 3),
        guard_cpu_cores=round(probe.cpu_ns / elapsed_ns, 3),
        stolen_ms=stolen_ms_since(meter.stolen_start_ns),
        missed_by_cause=probe.missed_by_cause,
    )


if __name__ == "__main__":
    app()
