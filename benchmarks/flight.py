"""Measured flight of both loops against the simulated vehicle, in separate processes.

``fly`` starts the vehicle and ``python -m benchmarks.flight JOB``, which flies the level climb of
``mavbridge check --soak``. A load keeps the flight process busy:

    none   no load
    slow   every tenth solve takes 30 ms longer
    busy   one thread runs eager torch, and another one never leaves the interpreter
"""

import pickle
import sys
import threading
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal, TypeAlias

import torch

from benchmarks.results import OURS, Flight, name_of, solves_of
from mavbridge.commands.check.soak import Soak, climb_config, fly_and_measure, level_climb
from mavbridge.commands.output import print_status
from mavbridge.config.flight import FlyConfig
from mavbridge.config.policy import PolicyConfig
from mavbridge.config.rates import Rates
from mavbridge.core.clock import NS_PER_MS, Clock, MonotonicClock
from mavbridge.core.errors import UserError
from mavbridge.core.processes import end, free_port, running, wait
from mavbridge.core.workers import Worker
from mavbridge.flight.policies import load_configured_policy
from policy.contract import FloatArray
from policy.protocol import PolicyRunner

FLIGHT_PROCESS = "benchmarks.flight"
Load: TypeAlias = Literal["none", "slow", "busy"]
SLOW_EVERY = 10
SLOW_NS = 30 * NS_PER_MS
TORCH_CHANNELS, TORCH_SIDE = 32, 48
"""Small convolution of some 1 ms: many calls per second, each of which takes the interpreter."""
JOIN_S = 5.0
STARTING_S = 300.0
"""Time limit of a process apart from its flight: imports, compiling an engine, arming. A network of
263 M parameters compiles for one or two minutes."""


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
    climb = level_climb(runner)
    config = FlyConfig(policy=job.policy, rates=job.rates, duration=job.duration_s)
    config = climb_config(config, climb.contract, port=job.port, source=job.camera)
    meter = fly_and_measure(config, climb, clock)
    job.out.write_bytes(pickle.dumps(_flight(job, meter.figures())))


def _flight(job: FlightJob, figures: Soak) -> Flight:
    report, cores = figures.timing, figures.cpu_cores
    sticks, action, vision = report.sticks, report.action, report.vision
    return Flight(
        runner=OURS,
        policy=name_of(job.policy),
        solves=solves_of(job.policy),
        engine=report.engine,
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
        cpu_cores=round(cores["flight"] + cores["guard"], 3),
        guard_cpu_cores=cores["guard"],
        guard_waited_ms=figures.guard_waited_ms,
        host_took_ms=figures.host_took_ms,
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
