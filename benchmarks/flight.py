"""Measured flight of both loops against the simulated vehicle, in separate processes.

``fly`` starts the vehicle and ``python -m benchmarks.flight JOB``, which is composed and sends like
``mavbridge fly``. An untrained policy would fly the vehicle into the ground, and a crashed vehicle
takes no sticks. Therefore each chunk is computed in full, and then its values are replaced by a
slow level climb. For simulated vehicles only. A load keeps the flight process busy:

    none   no load
    slow   every tenth solve takes 30 ms longer
    busy   one thread runs eager torch, and another one never leaves the interpreter
"""

import os
import pickle
import sys
import threading
import time
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal, NamedTuple, TypeAlias

import torch

from benchmarks.results import OURS, Flight, name_of, solves_of
from mavbridge.commands.output import print_status
from mavbridge.config.flight import CameraConfig, EnvelopeConfig, FlyConfig, LinkConfig
from mavbridge.config.policy import PolicyConfig
from mavbridge.config.rates import Rates
from mavbridge.core.clock import NS_PER_MS, NS_PER_S, Clock, MonotonicClock
from mavbridge.core.errors import PeerError, UserError
from mavbridge.core.processes import end, free_port, running, wait
from mavbridge.core.reasons import Kind, Reason
from mavbridge.core.records import Event, Tick
from mavbridge.core.workers import Worker
from mavbridge.flight.app import fly_policy
from mavbridge.flight.guard_process import start_guard
from mavbridge.flight.plan import plan_flight
from mavbridge.flight.policies import load_configured_policy
from mavbridge.observe.output import flight_console
from mavbridge.observe.timing import FlightTiming, ObserverDrops, TimingReport
from policy.contract import FloatArray
from policy.protocol import PolicyRunner

FLIGHT_PROCESS = "benchmarks.flight"
Load: TypeAlias = Literal["none", "slow", "busy"]
SLOW_EVERY = 10
SLOW_NS = 30 * NS_PER_MS
TORCH_CHANNELS, TORCH_SIDE = 32, 48
"""Small convolution of some 1 ms: many calls per second, each of which takes the interpreter."""
JOIN_S = 5.0
PROC = Path("/proc")
STEAL_FIELD = 8
"""Index of "steal" in the line "cpu": cpu user nice system idle iowait irq softirq steal."""
STARTING_S = 300.0
"""Time limit of a process apart from its flight: imports, compiling an engine, arming. A network of
263 M parameters compiles for one or two minutes."""
CLIMB_STICK = 0.3
"""Stick for 0.3 m/s up in ALT_HOLD: beyond the dead zone, some 20 m per minute."""
NO_CEILING = EnvelopeConfig(max_height=0.0)
"""Ten minutes of that climb exceed the usual 120 m."""
LEAST_SHARE = 0.95
"""Minimum share of the requested duration; a flight that ended earlier is no measurement."""
MAX_AGE_S = 5.0
"""Age limit far above any engine's need, so that a slow engine is measured, not released."""


@dataclass(frozen=True, kw_only=True)
class FlightJob:
    """Job of a program that flies once and is measured."""

    port: int
    camera: str
    duration_s: float
    """Duration from the policy's first action."""
    out: Path
    policy: PolicyConfig
    rates: Rates
    load: Load


def fly(
    policy: PolicyConfig,
    rates: Rates,
    duration_s: float,
    *,
    module: str = FLIGHT_PROCESS,
    load: Load = "none",
) -> Flight:
    """Fly once with the program ``module``, which takes the file of a ``FlightJob``.

    Raises:
        UserError: the program or the vehicle failed; quotes the end of its log.
    """
    label = ", ".join((module, name_of(policy), solves_of(policy), f"load {load}"))
    print_status(f"flight of {duration_s:g} s, sticks at {rates.stick_rate:g} Hz: {label}")
    port = free_port()
    camera = f"shm:mavbridge-bench-{port}"
    with TemporaryDirectory(prefix="mavbridge-bench-") as name:
        folder = Path(name)
        out, path = folder / "flight", folder / "job"
        log, vehicle_log = folder / "flight.log", folder / "vehicle.log"
        job = FlightJob(
            port=port,
            camera=camera,
            duration_s=duration_s,
            out=out,
            policy=policy,
            rates=rates,
            load=load,
        )
        path.write_bytes(pickle.dumps(job))
        vehicle_command = (
            *(sys.executable, "-m", "sitl", "--camera", camera),
            *("--connect", f"udpout:127.0.0.1:{port}"),
        )
        with running(*vehicle_command, log=vehicle_log) as vehicle:
            try:
                with running(sys.executable, "-m", module, str(path), log=log) as process:
                    wait(process, f"python -m {module}", log, duration_s + STARTING_S)
            except UserError:
                if vehicle.poll() is not None:  # it ended early: its log has the reason
                    wait(vehicle, "python -m sitl", vehicle_log, STARTING_S)
                raise
            end(vehicle)
            wait(vehicle, "python -m sitl", vehicle_log, STARTING_S)
        flight: Flight = pickle.loads(out.read_bytes())  # noqa: S301 - our child's
        return flight


def main(path: Path) -> None:
    """Fly the job in a file once, and write its figures."""
    job = read_job(path)
    clock = MonotonicClock()
    busy = (Worker("load-torch", run_torch), Worker("load-interpreter", hog_interpreter))
    with ExitStack() as stack:
        for worker in busy if job.load == "busy" else ():
            worker.start()
            stack.callback(worker.join, JOIN_S)
        runner = stack.enter_context(load_configured_policy(job.policy, clock)).runner
        measure(job, clock, with_slow_solves(runner) if job.load == "slow" else runner)


def read_job(path: Path) -> FlightJob:
    """Return the job that ``fly`` has written."""
    job: FlightJob = pickle.loads(path.read_bytes())  # noqa: S301 - our parent's
    return job


@torch.no_grad()
def run_torch(stop: threading.Event) -> None:
    """Run eager convolutions, one after the other."""
    torch.set_num_threads(1)
    layer = torch.nn.Conv2d(TORCH_CHANNELS, TORCH_CHANNELS, 3)
    values = torch.zeros(1, TORCH_CHANNELS, TORCH_SIDE, TORCH_SIDE)
    while not stop.is_set():
        layer(values).relu()


def hog_interpreter(stop: threading.Event) -> None:
    """Run only bytecode: others run only when the interpreter takes its lock away."""
    while not stop.is_set():
        pass


def with_slow_solves(runner: PolicyRunner) -> PolicyRunner:
    """Return a runner whose every tenth solve computes for 30 ms more."""
    clock, solves = MonotonicClock(), 0

    def act(encoded: FloatArray, state: FloatArray, history: FloatArray) -> FloatArray:
        nonlocal solves
        solves += 1
        end_ns = clock.now_ns() + (0 if solves % SLOW_EVERY else SLOW_NS)
        while clock.now_ns() < end_ns:
            pass
        return runner.act(encoded, state, history)

    return replace(runner, act=act)


def measure(job: FlightJob, clock: Clock, runner: PolicyRunner) -> None:
    """Fly the runner's work, and write the figures."""
    loops = job.rates.loops(is_dual=runner.dual_rate, play_s=runner.contract.play_s)
    config = FlyConfig(
        link=LinkConfig(connect=f"udp:127.0.0.1:{job.port}"),
        policy=job.policy,
        # High above the course, the simulator's noiseless view hardly changes.
        camera=CameraConfig(camera=(job.camera,), max_frozen_image=0.0),
        rates=job.rates,
        envelope=NO_CEILING,
        mode="ALT_HOLD",
        arm=True,
        duration=job.duration_s,
    )
    climb = level_climb(runner)
    with ExitStack() as stack:
        guard = start_guard(config, clock, stack)
        meter = FlightMeter(
            guard.process.pid,
            stick_hz=job.rates.stick_rate,
            action_hz=loops.action_hz,
            vision_hz=loops.max_vision_hz,
        )
        plan = plan_flight(config, climb.contract, is_dual=climb.dual_rate)
        fly_policy(plan, climb, clock=clock, console=flight_console(), sinks=(meter,), guard=guard)
    flight = _flight(job, runner.engine, meter)
    if meter.release_reason is not None:
        raise PeerError(f"the policy lost the sticks: {meter.release_reason}")
    if flight.duration_s < LEAST_SHARE * job.duration_s:
        lasted = f"the flight lasted {flight.duration_s:g} s instead of {job.duration_s:g} s"
        raise PeerError(lasted)
    job.out.write_bytes(pickle.dumps(flight))


def level_climb(runner: PolicyRunner) -> PolicyRunner:
    """Return a runner that does the same work and returns climb sticks, however late it is."""

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


class Counters(NamedTuple):
    """Processor times since an arbitrary start [ns]; they never decrease."""

    ours: int
    """Time in which this process ran."""
    guard: int
    """Time in which the guard ran."""
    waited: int
    """Time in which the guard was runnable but not on a processor."""
    host: int
    """Time in which the hypervisor gave this machine's processors to others."""


def read_counters(guard_pid: int) -> Counters:
    """Read the system's counters (proc_stat(5), sched-stats.rst); 0 if unavailable."""
    try:
        schedstat = (PROC / str(guard_pid) / "schedstat").read_text().split()
        stolen = int((PROC / "stat").read_text().split("\n", 1)[0].split()[STEAL_FIELD])
    except (OSError, ValueError, IndexError):
        return Counters(time.process_time_ns(), 0, 0, 0)
    host_ns = stolen * NS_PER_S // os.sysconf("SC_CLK_TCK")
    return Counters(time.process_time_ns(), int(schedstat[0]), int(schedstat[1]), host_ns)


class FlightMeter:
    """``TickSink`` that measures from the policy's first action on.

    Waiting, handshake and arming consist of cheap, punctual ticks that would flatter a slow engine.
    """

    def __init__(
        self, guard_pid: int, *, stick_hz: float, action_hz: float, vision_hz: float
    ) -> None:
        self._guard_pid = guard_pid
        self._timing = FlightTiming(stick_hz=stick_hz, action_hz=action_hz, vision_hz=vision_hz)
        self._first: Counters | None = None
        self.spent = Counters(0, 0, 0, 0)
        """Counters from the first action to the last."""
        self.release_reason: Reason | None = None
        """Reason why the policy lost the sticks early; None if it kept them."""

    def emit(self, event: Event) -> None:
        """Count the event."""
        if isinstance(event, Tick) and event.trace is not None:
            now = read_counters(self._guard_pid)
            self._first = self._first or now
            self.spent = Counters(*(b - a for a, b in zip(self._first, now, strict=True)))
        if self._first is not None:
            self._timing.emit(event)
            reason = event.release_reason if isinstance(event, Tick) else None
            if reason is not None and reason.kind is not Kind.END:
                self.release_reason = self.release_reason or reason

    def report(self) -> TimingReport:
        """Return the figures of the flight so far; names and link are left empty."""
        drops = ObserverDrops(rerun=None, recorder=None)
        return self._timing.report(
            mode="dual", engine="", policy="", autopilot=None, link=None, observer_drops=drops
        )


def _flight(job: FlightJob, engine: str, meter: FlightMeter) -> Flight:
    report, spent = meter.report(), meter.spent
    sticks, action, vision = report.sticks, report.action, report.vision
    elapsed_ns = report.duration_s * NS_PER_S
    return Flight(
        runner=OURS,
        policy=name_of(job.policy),
        solves=solves_of(job.policy),
        engine=engine,
        conditions=conditions_of(job),
        asked_stick_hz=sticks.target_hz,
        asked_action_hz=action.target_hz,
        asked_vision_hz=vision.target_hz,
        duration_s=report.duration_s,
        stick_hz=sticks.rate_hz,
        action_hz=action.rate_hz,
        vision_hz=vision.rate_hz,
        missed_slots=sticks.missed_slots,
        lateness_ms=sticks.lateness_ms,
        chunks=action.chunks,
        late_chunks=action.late_chunks,
        period_ms=action.period_ms,
        predict_ms=action.predict_ms,
        encode_ms=vision.encode_ms,
        feature_age_ms=report.feature_age_ms,
        state_to_wire_ms=report.state_to_wire_ms,
        cpu_cores=round((spent.ours + spent.guard) / elapsed_ns, 3),
        guard_cpu_cores=round(spent.guard / elapsed_ns, 3),
        guard_waited_ms=round(spent.waited / NS_PER_MS, 1),
        host_took_ms=round(spent.host / NS_PER_MS, 1),
    )


def conditions_of(job: FlightJob) -> str:
    """Return the unusual rate, load and scheduling of a job."""
    usual = Rates()
    parts = []
    if job.rates.stick_rate != usual.stick_rate:
        parts.append(f"{job.rates.stick_rate:g} sticks/s")
    if job.load != "none":
        parts.append(f"load {job.load}")
    if job.rates.realtime != usual.realtime:
        parts.append("no SCHED_FIFO")
    return ", ".join(parts)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
