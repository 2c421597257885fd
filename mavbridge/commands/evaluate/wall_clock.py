"""An episode in real time: vehicle and bridge are processes of their own, connected over UDP."""

import json
import multiprocessing
import sys
from collections.abc import Callable
from pathlib import Path
from subprocess import Popen
from tempfile import TemporaryDirectory
from typing import NamedTuple

from rich.console import Console

from mavbridge.commands.episode_workers import WorkerProcess, raise_failure
from mavbridge.commands.evaluate.episodes import EpisodeSpec, FlownEpisode
from mavbridge.config.flight import CameraConfig, FlyConfig, LinkConfig
from mavbridge.config.rates import SIM_CAMERA_PX
from mavbridge.core.clock import NS_PER_S, MonotonicClock
from mavbridge.core.errors import MavbridgeError, PeerError
from mavbridge.core.processes import END_TIMEOUT_S, end, free_port, running, wait
from mavbridge.flight.app import fly_executable
from mavbridge.flight.policies import load_configured_policy
from mavbridge.simulation.flight import MODE
from mavbridge.simulation.referee import EpisodeInterruptedError, EpisodeResult, Outcome, StickMeter

STARTUP_S = 90.0
"""Limit on a flight's time beyond its own: imports, compiling an engine, arming."""
_POLL_S = 0.1


class _BridgeJob(NamedTuple):
    spec: EpisodeSpec
    port: int
    camera: str


def fly_on_wall_clock(spec: EpisodeSpec, should_stop: Callable[[], bool]) -> FlownEpisode:
    """Fly one episode in real time.

    Raises:
        EpisodeInterruptedError: ``should_stop`` ended it.
        MavbridgeError: the vehicle or the bridge failed.
    """
    port = free_port()
    camera = f"shm:mavbridge-evaluate-{port}"
    conditions_seed, image_size = spec.conditions_seed, spec.config.policy.image_size
    with TemporaryDirectory(prefix="mavbridge-evaluate-") as folder:
        report, log = Path(folder, "vehicle.json"), Path(folder, "vehicle.log")
        command = (
            *(sys.executable, "-m", "sitl", "--camera", camera, "--end-with-course"),
            *("--connect", f"udpout:127.0.0.1:{port}", "--report", str(report)),
            *("--course", str(spec.course_seed)),
            *("--image-size", str(max(SIM_CAMERA_PX, image_size or 0))),
            *(() if conditions_seed is None else ("--conditions", str(conditions_seed))),
        )
        with running(*command, log=log) as vehicle:
            try:
                engine, meter = _run_bridge(_BridgeJob(spec, port, camera), vehicle, should_stop)
            except MavbridgeError:
                if vehicle.poll():  # then the vehicle's failure is the reason
                    wait(vehicle, "python -m sitl", log, END_TIMEOUT_S)
                raise
            end(vehicle)
            wait(vehicle, "python -m sitl", log, END_TIMEOUT_S)
        return FlownEpisode(engine=engine, result=_read_result(spec, meter, report))


def _run_bridge(
    job: _BridgeJob, vehicle: "Popen[bytes]", should_stop: Callable[[], bool]
) -> tuple[str, StickMeter]:
    """Run the bridge in a process of its own until it or the vehicle has ended."""
    clock, spec = MonotonicClock(), job.spec
    deadline_ns = clock.now_ns() + round((spec.config.max_time + STARTUP_S) * NS_PER_S)
    never = multiprocessing.get_context("spawn").Event()
    worker = WorkerProcess("mavbridge-evaluate-bridge", _fly_bridge, never)
    worker.send(job)
    try:
        while not worker.connection.poll(_POLL_S) and vehicle.poll() is None:
            if should_stop():
                raise EpisodeInterruptedError(f"{spec}: interrupted")
            if clock.now_ns() > deadline_ns:
                raise PeerError(f"{spec}: the bridge has not ended in time")
    finally:
        worker.terminate()  # gives the sticks back
        outcome = worker.receive()
        worker.end()
    if outcome is None:
        raise PeerError(f"{spec}: the bridge's process has died, or hung at its end")
    return raise_failure(outcome)


def _fly_bridge(job: _BridgeJob, _: Callable[[], bool]) -> tuple[str, StickMeter]:
    """Fly once, as ``mavbridge fly`` does; ended by signals, like that."""
    settings, clock, meter = job.spec.config, MonotonicClock(), StickMeter()
    config = FlyConfig(
        link=LinkConfig(connect=f"udp:127.0.0.1:{job.port}"),
        policy=settings.policy,
        camera=CameraConfig(camera=job.camera),
        rates=settings.rates,
        limits=settings.limits,
        mode=MODE,
        arm=True,
        duration=settings.max_time,
    )
    executable = load_configured_policy(config.policy, clock).executable
    with Path("/dev/null").open("w") as nowhere:
        console = Console(file=nowhere)
        fly_executable(config, executable, clock=clock, console=console, sinks=(meter,))
    return executable.engine, meter


def _read_result(spec: EpisodeSpec, meter: StickMeter, path: Path) -> EpisodeResult:
    """Result from the vehicle's report, whose format ``sitl.report`` defines."""
    if meter.engaged_ns is None:
        raise PeerError(f"{spec}: the policy did not get the sticks")
    report = json.loads(path.read_text())
    gates_total, passed = report["gates"]["total"], report["gates"]["passed"]
    offset_s = (meter.engaged_ns - report["start_ns"]) / NS_PER_S
    outcome: Outcome = "timed out" if report["final"]["armed"] else "disarmed"
    if report["crashed"]:
        outcome = "crashed"
    elif len(passed) == gates_total:
        outcome = "finished"
    return EpisodeResult(
        course_seed=spec.course_seed,
        seed=spec.seed,
        outcome=outcome,
        gates_total=gates_total,
        gate_times_s=tuple(gate["t_s"] - offset_s for gate in passed),
        flown_s=report["duration_s"] - offset_s,
        distance_m=report["distance_m"],
        stick_rate_per_s=meter.rate_per_s,
    )
