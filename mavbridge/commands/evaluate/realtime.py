"""Episodes against the wall clock: vehicle and bridge as processes of their own, over UDP."""

import json
import multiprocessing
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from subprocess import Popen
from tempfile import TemporaryDirectory

from rich.console import Console

from mavbridge.commands.evaluate.jobs import Flown, Job
from mavbridge.config.flight import CameraConfig, FlyConfig, LinkConfig
from mavbridge.config.rates import SIM_CAMERA_PX
from mavbridge.core.clock import NS_PER_S, MonotonicClock
from mavbridge.core.errors import MavbridgeError, PeerError, UserError
from mavbridge.core.processes import END_TIMEOUT_S, end, free_port, running, wait
from mavbridge.flight.app import fly_executable
from mavbridge.flight.policies import load_configured_policy
from mavbridge.simulation.episode import MODE
from mavbridge.simulation.result import EpisodeResult, Outcome, StickMeter
from policy.errors import PolicyError

STARTING_S = 90.0
"""Most that a flight may take beside its time: imports, compiling an engine, arming."""
_POLL_S = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class _BridgeReport:
    """What the bridge's process tells."""

    engine: str
    engaged_ns: int | None
    stick_rate_per_s: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class _VehicleReport:
    """What the vehicle's process tells; the parts of its JSON that count here."""

    start_ns: int
    duration_s: float
    distance_m: float
    gates_total: int
    gate_times_s: tuple[float, ...]
    crashed: bool
    armed: bool


def fly_realtime(jobs: Sequence[Job], *, should_stop: Callable[[], bool]) -> Iterator[Flown]:
    """One flight after the other; one that is stopped has no result.

    Raises:
        MavbridgeError: the vehicle or the bridge failed; with its words.
    """
    for job in jobs:
        if should_stop():
            return
        with TemporaryDirectory(prefix="mavbridge-evaluate-") as name:
            flown = _fly(job, Path(name), should_stop)
        if flown is None:
            return
        yield flown


def _fly(job: Job, folder: Path, should_stop: Callable[[], bool]) -> Flown | None:
    port = free_port()
    camera = f"shm:mavbridge-evaluate-{port}"
    report, log = folder / "vehicle.json", folder / "vehicle.log"
    command = (
        *(sys.executable, "-m", "sitl", "--camera", camera, "--end-with-course"),
        *("--connect", f"udpout:127.0.0.1:{port}", "--report", str(report)),
        *("--course", str(job.course_seed)),
        *("--image-size", str(max(SIM_CAMERA_PX, job.policy.image_size or 0))),
        *(() if job.conditions_seed is None else ("--conditions", str(job.conditions_seed))),
    )
    with running(*command, log=log) as vehicle:
        try:
            bridge = _fly_bridge(job, port, camera, vehicle, should_stop)
        except MavbridgeError:
            if vehicle.poll():  # then the bridge's words are not the reason
                wait(vehicle, "python -m sitl", log, END_TIMEOUT_S)
            raise
        end(vehicle)
        wait(vehicle, "python -m sitl", log, END_TIMEOUT_S)
    if bridge is None:
        return None
    return Flown(
        index=job.index, engine=bridge.engine, result=_result(job, bridge, _read_report(report))
    )


def _fly_bridge(
    job: Job, port: int, camera: str, vehicle: "Popen[bytes]", should_stop: Callable[[], bool]
) -> _BridgeReport | None:
    """Run the bridge until it ends, or the vehicle has; None: it was stopped."""
    spawn = multiprocessing.get_context("spawn")
    receiver, sender = spawn.Pipe(duplex=False)
    process = spawn.Process(
        target=_bridge_main, args=(job, port, camera, sender), name="mavbridge-evaluate-bridge"
    )
    clock = MonotonicClock()
    deadline_ns = clock.now_ns() + round((job.max_time_s + STARTING_S) * NS_PER_S)
    process.start()
    sender.close()
    try:
        while process.is_alive() and vehicle.poll() is None and not should_stop():
            process.join(_POLL_S)
            if clock.now_ns() > deadline_ns:
                raise PeerError(f"course {job.course_seed}: the bridge has not ended in time")
        if process.is_alive():
            process.terminate()  # which gives the sticks back
        process.join(END_TIMEOUT_S)
    finally:
        if process.is_alive():
            process.kill()
            process.join()
    if should_stop():
        return None
    try:
        told: _BridgeReport | str = receiver.recv()
    except EOFError as error:
        raise PeerError(
            f"course {job.course_seed}: the bridge ended with status {process.exitcode}"
        ) from error
    finally:
        receiver.close()
    if isinstance(told, str):
        raise UserError(told)
    return told


def _bridge_main(job: Job, port: int, camera: str, sender: "Connection") -> None:
    """A process of its own: one flight, as ``mavbridge fly`` does it."""
    clock, meter = MonotonicClock(), StickMeter()
    with Path("/dev/null").open("w") as nowhere:
        try:
            executable = load_configured_policy(job.policy, clock).executable
            fly_executable(
                _config(job, port, camera),
                executable,
                clock=clock,
                console=Console(file=nowhere),
                sinks=(meter,),
            )
        except KeyboardInterrupt:
            return  # before the flight; the parent was told, too
        except (MavbridgeError, PolicyError) as error:
            sender.send(str(error))
            return
    sender.send(
        _BridgeReport(
            engine=executable.engine,
            engaged_ns=meter.engaged_ns,
            stick_rate_per_s=meter.rate_per_s,
        )
    )


def _config(job: Job, port: int, camera: str) -> FlyConfig:
    return FlyConfig(
        link=LinkConfig(connect=f"udp:127.0.0.1:{port}"),
        policy=job.policy,
        camera=CameraConfig(camera=camera),
        rates=job.rates,
        limits=job.limits,
        mode=MODE,
        arm=True,
        duration=job.max_time_s,
    )


def _read_report(path: Path) -> _VehicleReport:
    report = json.loads(path.read_text())
    return _VehicleReport(
        start_ns=report["start_ns"],
        duration_s=report["duration_s"],
        distance_m=report["distance_m"],
        gates_total=report["gates"]["total"],
        gate_times_s=tuple(gate["t_s"] for gate in report["gates"]["passed"]),
        crashed=report["crashed"],
        armed=report["final"]["armed"],
    )


def _result(job: Job, bridge: _BridgeReport, vehicle: _VehicleReport) -> EpisodeResult:
    if bridge.engaged_ns is None:
        raise PeerError(f"course {job.course_seed}: the policy did not get the sticks")
    offset_s = (bridge.engaged_ns - vehicle.start_ns) / NS_PER_S
    return EpisodeResult(
        course_seed=job.course_seed,
        seed=job.seed,
        outcome=_outcome(vehicle),
        gates_total=vehicle.gates_total,
        gate_times_s=tuple(t_s - offset_s for t_s in vehicle.gate_times_s),
        flown_s=vehicle.duration_s - offset_s,
        distance_m=vehicle.distance_m,
        stick_rate_per_s=bridge.stick_rate_per_s,
    )


def _outcome(vehicle: _VehicleReport) -> Outcome:
    if vehicle.crashed:
        return "crashed"
    if len(vehicle.gate_times_s) == vehicle.gates_total:
        return "finished"
    return "timed out" if vehicle.armed else "disarmed"
