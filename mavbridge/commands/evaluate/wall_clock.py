"""An episode in real time: vehicle and bridge are processes of their own, connected over UDP."""

import json
import multiprocessing
import sys
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from subprocess import Popen
from tempfile import TemporaryDirectory
from typing import NamedTuple

from rich.console import Console

from mavbridge.commands.bench.processes import END_TIMEOUT_S, end, free_udp_port, running, wait
from mavbridge.commands.episode_workers import end_process
from mavbridge.commands.evaluate.episodes import EpisodeSpec, FlownEpisode
from mavbridge.config.flight import CameraConfig, FlyConfig, LinkConfig
from mavbridge.config.rates import SIM_CAMERA_PX
from mavbridge.core.clock import NS_PER_S, MonotonicClock
from mavbridge.core.errors import MavbridgeError, PeerError
from mavbridge.flight.app import fly_executable
from mavbridge.flight.assembly import load_configured_policy
from mavbridge.simulation.flight import MODE
from mavbridge.simulation.referee import EpisodeInterruptedError
from mavbridge.simulation.result import EpisodeResult, Outcome, StickMeter

STARTUP_S = 90.0
"""Limit on a flight's time beyond its own: imports, compiling an engine, arming."""
_POLL_S = 0.1


class _BridgeReport(NamedTuple):
    engine: str
    meter: StickMeter


def fly_on_wall_clock(spec: EpisodeSpec, should_stop: Callable[[], bool]) -> FlownEpisode:
    """Fly one episode in real time.

    Raises:
        EpisodeInterruptedError: ``should_stop`` ended it.
        MavbridgeError: the vehicle or the bridge failed.
    """
    port = free_udp_port()
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
                bridge = _run_bridge(spec, port, camera, vehicle, should_stop)
            except MavbridgeError:
                if vehicle.poll():  # then the vehicle's failure is the reason
                    wait(vehicle, "python -m sitl", log, END_TIMEOUT_S)
                raise
            end(vehicle)
            wait(vehicle, "python -m sitl", log, END_TIMEOUT_S)
        return FlownEpisode(engine=bridge.engine, result=_read_result(spec, bridge.meter, report))


def _run_bridge(
    spec: EpisodeSpec,
    port: int,
    camera: str,
    vehicle: "Popen[bytes]",
    should_stop: Callable[[], bool],
) -> _BridgeReport:
    """Run the bridge until it or the vehicle has ended."""
    spawn = multiprocessing.get_context("spawn")
    receiver, sender = spawn.Pipe(duplex=False)
    process = spawn.Process(
        target=_bridge_main, args=(spec, port, camera, sender), name="mavbridge-evaluate-bridge"
    )
    clock = MonotonicClock()
    deadline_ns = clock.now_ns() + round((spec.config.max_time + STARTUP_S) * NS_PER_S)
    process.start()
    sender.close()
    try:
        while process.is_alive() and vehicle.poll() is None and not should_stop():
            process.join(_POLL_S)
            if clock.now_ns() > deadline_ns:
                raise PeerError(f"{spec}: the bridge has not ended in time")
    finally:
        end_process(process)  # gives the sticks back
    if should_stop():
        raise EpisodeInterruptedError(f"{spec}: interrupted")
    with receiver:
        try:
            outcome: _BridgeReport | MavbridgeError = receiver.recv()
        except EOFError as error:
            raise PeerError(f"{spec}: the bridge ended with status {process.exitcode}") from error
    if isinstance(outcome, MavbridgeError):
        raise outcome
    return outcome


def _bridge_main(spec: EpisodeSpec, port: int, camera: str, sender: Connection) -> None:
    """Main function of the bridge's process: one flight as of ``mavbridge fly``."""
    config = FlyConfig(
        link=LinkConfig(connect=f"udp:127.0.0.1:{port}"),
        policy=spec.config.policy,
        camera=CameraConfig(camera=camera),
        rates=spec.config.rates,
        limits=spec.config.limits,
        mode=MODE,
        arm=True,
        duration=spec.config.max_time,
    )
    clock, meter = MonotonicClock(), StickMeter()
    with Path("/dev/null").open("w") as nowhere:
        console = Console(file=nowhere)
        try:
            executable = load_configured_policy(config.policy, clock).executable
            fly_executable(config, executable, clock=clock, console=console, sinks=(meter,))
        except KeyboardInterrupt:
            return  # before the flight; the parent was interrupted as well
        except MavbridgeError as error:
            sender.send(error)
            return
    sender.send(_BridgeReport(executable.engine, meter))


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
