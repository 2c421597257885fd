"""Rows about this computer: cores, rights, the files of the flight, and a soak.

A soak flies the policy at the bundled vehicle for a while. One that crashes its vehicle could not
be measured for long. Therefore each chunk is computed in full, and then its values are replaced by
the sticks of a slow level climb.
"""

import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import TimeoutError as PoolTimeoutError
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory

from mavbridge.camera.open import NO_CAMERA
from mavbridge.commands.check.policy import HELD
from mavbridge.commands.check.rows import CheckRow
from mavbridge.commands.output import print_status
from mavbridge.config.flight import CameraConfig, EnvelopeConfig, FlyConfig, LinkConfig
from mavbridge.core.clock import NS_PER_S, Clock
from mavbridge.core.errors import MavbridgeError, PeerError, UserError
from mavbridge.core.files import empty_folders_removed
from mavbridge.core.processes import free_port, log_tail, running
from mavbridge.core.realtime import settle_guard, usable_cores
from mavbridge.core.reasons import Kind
from mavbridge.core.records import Event, Tick
from mavbridge.flight.app import fly_policy
from mavbridge.flight.checks import file_checks, output_folders
from mavbridge.flight.guard_process import start_guard
from mavbridge.flight.plan import plan_flight
from mavbridge.flight.policies import load_configured_policy
from mavbridge.observe.output import patient_console
from mavbridge.observe.terminal import number
from mavbridge.observe.timing import FlightTiming, TimingReport
from policy.contract import Contract, FloatArray
from policy.protocol import PolicyRunner

_CORES = 2
"""One core for the guard and one for the policy, so that neither delays the other."""
_TRIAL_S = 20
"""Time in which a new process must have tried the rights of the guard."""
PROC, SYS = Path("/proc"), Path("/sys")
CLIMB_STICK = 0.3
"""Stick for 0.3 m/s up in ALT_HOLD: beyond the dead zone, some 20 m per minute."""
NO_CEILING = EnvelopeConfig(max_height=0.0)
"""Ten minutes of that climb exceed the usual 120 m."""
MAX_AGE_S = 5.0
"""Age limit far above any engine's need, so that a slow engine is measured, not released."""
LEAST_SHARE = 0.95
"""Minimum share of the requested duration; a flight that ended earlier is no measurement."""
USAGE_NS = NS_PER_S // 4
"""Time between two readings of processor times and temperature."""
_row = partial(CheckRow, "computer")


def computer_rows(config: FlyConfig) -> Iterator[CheckRow]:
    """Yield rows about cores, real-time scheduling, locked memory, and the files of the flight."""
    cores = usable_cores()
    shared = "guard and policy share one core: a slow policy delays the sticks"
    yield _row("cores", str(cores), f"{_CORES} or more", "" if cores >= _CORES else shared)
    try:  # in a process of its own, so that this one is not affected
        with get_context("spawn").Pool(1) as pool:
            trial = pool.apply_async(settle_guard, kwds={"realtime": config.rates.realtime})
            refused = trial.get(_TRIAL_S) or ""
    except PoolTimeoutError:
        refused = f"the rights of the guard could not be tried: no answer in {_TRIAL_S} s"
    except OSError as error:
        refused = f"the rights of the guard could not be tried: {error}"
    yield _row(
        "rights of the guard",
        "refused in part" if refused else "granted",
        "SCHED_FIFO and locked memory" if config.rates.realtime else "locked memory",
        refused,
    )


def file_rows(config: FlyConfig) -> Iterator[CheckRow]:
    """Yield a row on each file that the flight uses, and on its viewer."""
    with empty_folders_removed(*output_folders(config)):
        for name, value, check_file in file_checks(config):
            try:
                check_file()
                yield _row(name, str(value))
            except MavbridgeError as error:
                yield _row(name, str(value), no_go=str(error))


def _hottest_c() -> float | None:
    """Return the highest temperature that the kernel tells [degrees Celsius]; None: it tells
    none."""
    texts = (_text(zone) for zone in SYS.glob("class/thermal/thermal_zone*/temp"))
    return max((int(text) / 1000 for text in texts if text.lstrip("-").isdigit()), default=None)


def _ran_ns(pid: int) -> int:
    """Return the time for which a process ran (sched-stats.rst); 0: not told."""
    return int((_text(PROC / str(pid) / "schedstat").split() or ["0"])[0])


def _text(path: Path) -> str:
    """Return the text of a small system file; empty if there is none."""
    try:
        return path.read_text().strip()
    except OSError:
        return ""


class UsageMeter:
    """``TickSink`` that reads processor times and temperature while the policy flies."""

    def __init__(self, clock: Clock, guard_pid: int) -> None:
        self._clock = clock
        self._guard_pid = guard_pid
        self._first: tuple[int, int, int] | None = None
        """Time of the first reading, then the processor times of this process and the guard."""
        self._last = (0, 0, 0)
        self.hottest_c: float | None = None

    def emit(self, event: Event) -> None:
        """Read the counters if the policy flies and the last reading is old enough."""
        if not isinstance(event, Tick) or event.trace is None:
            return
        now_ns = self._clock.now_ns()
        if self._first is not None and now_ns - self._last[0] < USAGE_NS:
            return
        self._last = now_ns, time.process_time_ns(), _ran_ns(self._guard_pid)
        self._first = self._first or self._last
        heats_c = [heat_c for heat_c in (self.hottest_c, _hottest_c()) if heat_c is not None]
        self.hottest_c = max(heats_c, default=None)

    @property
    def cores(self) -> dict[str, float]:
        """Processor time over elapsed time of the processes "flight" (this one) and "guard"."""
        pairs = zip(self._first or self._last, self._last, strict=True)
        elapsed_ns, flight_ns, guard_ns = (after - before for before, after in pairs)
        used_ns = {"flight": flight_ns, "guard": guard_ns}
        return {name: round(each_ns / max(elapsed_ns, 1), 3) for name, each_ns in used_ns.items()}


@dataclass(frozen=True, kw_only=True)
class Soak:
    """Result of a soak."""

    timing: TimingReport
    """As in a flight's report."""
    cpu_cores: dict[str, float]
    """See ``UsageMeter.cores``."""
    hottest_c: float | None
    """Highest temperature [degrees Celsius]; None: this system tells none."""

    def row(self) -> CheckRow:
        """Return the row of the check: a warning if a slot was missed or a rate was not held."""
        sticks, action, vision = self.timing.sticks, self.timing.action, self.timing.vision
        slow = [
            name
            for name, part in (("chunks", action), ("images", vision))
            if part.rate_hz is not None and part.rate_hz < HELD * part.target_hz
        ]
        warnings = [f"this computer does not hold the rate of {' and '.join(slow)}"] if slow else []
        if sticks.missed_slots:
            warnings.append("the guard was late: see missed slots in docs/timing.md")
        heat = "" if self.hottest_c is None else f", {self.hottest_c:.0f} degrees"
        cores = self.cpu_cores["flight"] + self.cpu_cores["guard"]
        return _row(
            "soak",
            f"{sticks.flying_s:.0f} s, {sticks.missed_slots} of {sticks.slots} slots missed; "
            f"chunks {number(action.rate_hz, 1)} Hz, images {number(vision.rate_hz, 1)} Hz, "
            f"{cores:.2f} of {usable_cores()} cores{heat}",
            f"no slot missed, {action.target_hz:g} and {vision.target_hz:g} Hz",
            warn="; ".join(warnings),
        )


def check_soak(
    config: FlyConfig, clock: Clock, *, duration_s: float
) -> tuple[CheckRow, Soak | None]:
    """Soak the policy for ``duration_s``; a failure becomes a row."""
    print_status(f"flying the bundled vehicle for {duration_s:g} s")
    try:
        soaked = soak(config, clock, duration_s=duration_s)
    except MavbridgeError as error:
        return _row("soak", "not flown", no_go=str(error)), None
    return soaked.row(), soaked


def soak(config: FlyConfig, clock: Clock, *, duration_s: float) -> Soak:
    """Load the policy, and fly the bundled vehicle for ``duration_s``; raise MavbridgeError."""
    port = free_port()
    with ExitStack() as stack:
        loaded = stack.enter_context(load_configured_policy(config.policy, clock))
        runner = level_climb(loaded.runner)
        if runner.contract.is_depth:
            raise UserError("--soak: the bundled vehicle has no depth camera; leave it out")
        folder = Path(stack.enter_context(TemporaryDirectory(prefix="mavbridge-soak-")))
        shared = f"shm:mavbridge-soak-{port}"
        command = ("-m", "sitl", "--connect", f"udpout:127.0.0.1:{port}", "--camera", shared)
        log = folder / "vehicle.log"
        vehicle = stack.enter_context(running(sys.executable, *command, log=log))
        source = NO_CAMERA if set(config.camera.sources) == {NO_CAMERA} else shared
        flight = climb_config(config, runner.contract, port=port, source=source)
        try:
            return fly_and_measure(replace(flight, duration=duration_s), runner, clock)
        except MavbridgeError as error:
            if vehicle.poll() is None:
                raise
            raise UserError(f"python -m sitl failed: {log_tail(log)}") from error


def climb_config(config: FlyConfig, contract: Contract, *, port: int, source: str) -> FlyConfig:
    """Return the flight of a ``level_climb`` at a bundled vehicle, by the policy of ``config``; all
    its cameras see the same ``source``."""
    names = contract.cameras
    sources = (source,) if len(names) == 1 else tuple(f"{name}={source}" for name in names)
    return FlyConfig(
        policy=config.policy,
        rates=config.rates,
        goal=config.goal,
        link=LinkConfig(connect=f"udp:127.0.0.1:{port}"),
        # High above the course, the simulator's noiseless view hardly changes.
        camera=CameraConfig(camera=sources, max_frozen_image=0.0),
        envelope=NO_CEILING,
        mode="ALT_HOLD",
        arm=True,
    )


def fly_and_measure(config: FlyConfig, runner: PolicyRunner, clock: Clock) -> Soak:
    """Fly a loaded policy, and measure it; raise PeerError if the flight ended early."""
    plan = plan_flight(config, runner.contract, is_dual=runner.dual_rate)
    timing = FlightTiming(
        stick_hz=config.rates.stick_rate,
        action_hz=plan.loops.action_hz,
        vision_hz=plan.image_rates_hz[0],
    )
    with ExitStack() as stack:
        guard = start_guard(config, clock, stack)
        usage, console = UsageMeter(clock, guard.pid), patient_console()
        fly_policy(plan, runner, clock=clock, console=console, sinks=(timing, usage), guard=guard)
    report = timing.report(
        mode="dual" if runner.dual_rate else "single",
        engine=runner.engine,
        policy=runner.name,
    )
    require_whole(report, config.duration or 0.0)
    return Soak(
        timing=report,
        cpu_cores=usage.cores,
        hottest_c=usage.hottest_c,
    )


def require_whole(report: TimingReport, wanted_s: float) -> None:
    """Raise PeerError unless the policy flew for about as long as it was to."""
    if not report.sticks.sends:
        raise PeerError("the policy never had the sticks of the bundled vehicle")
    for release in report.releases:
        if release.reason.kind is not Kind.END:
            raise PeerError(f"the policy lost the sticks: {release.reason}")
    if report.sticks.flying_s < LEAST_SHARE * wanted_s:
        flown_s = report.sticks.flying_s
        raise PeerError(f"the flight lasted {flown_s:g} s instead of {wanted_s:g} s")


def level_climb(runner: PolicyRunner) -> PolicyRunner:
    """Return a runner that does the same work and returns climb sticks, however late it is."""

    def act(encoded: FloatArray, state: FloatArray, history: FloatArray) -> FloatArray:
        chunk = runner.act(encoded, state, history).copy()
        chunk[...] = (CLIMB_STICK, 0.0, 0.0, 0.0)
        return chunk

    contract = replace(
        runner.contract,
        action="sticks",
        modes=("ALT_HOLD",),
        max_state_age_s=MAX_AGE_S,
        max_velocity_age_s=MAX_AGE_S,
        max_feature_age_s=MAX_AGE_S,
        max_chunk_age_s=MAX_AGE_S,
    )
    return replace(runner, contract=contract, act=act)
