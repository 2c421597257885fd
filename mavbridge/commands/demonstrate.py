"""``mavbridge demonstrate``: flights of simulated gate courses, flown or labelled by an expert."""

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from shutil import rmtree

import numpy as np
from rich.console import Console
from rich.text import Text

import mavbridge
from mavbridge.commands.episode_workers import fly_jobs
from mavbridge.commands.output import progress_bar
from mavbridge.config.episodes import DemonstrateConfig
from mavbridge.config.rates import SIM_CAMERA_PX, Rates
from mavbridge.core.clock import NS_PER_MS, NS_PER_S, MonotonicClock
from mavbridge.core.errors import UserError
from mavbridge.core.provenance import digests
from mavbridge.core.records import Event, Tick
from mavbridge.core.stopping import INTERRUPTED, stop_on_signals
from mavbridge.core.vehicle import Action, BodyRates, Sticks
from mavbridge.flight.policies import load_for_episodes, policy_files
from mavbridge.recording.flight_writer import FlightWriter
from mavbridge.recording.folder import META, prepare_folder
from mavbridge.recording.meta import FlightMeta, read_meta
from mavbridge.recording.rows import FrameTruth
from mavbridge.simulation.delays import Delay, Delays
from mavbridge.simulation.flight import SimulatedFlight, SimulationSettings
from mavbridge.simulation.world import Exposure, make_vehicle
from policy.contract import ACTION_DIM, Contract, FloatArray
from policy.protocol import PolicyRunner
from sitl.course import gate_truth
from sitl.pilot.demonstrator import Expert, RateExpert
from sitl.pilot.disturbance import RATE_STRENGTHS, STICK_STRENGTHS, Disturbance, random_start
from sitl.vehicle.conditions import NOMINAL, Conditions
from sitl.vehicle.looks import training_conditions

SETTLE_NS = 300 * NS_PER_MS
"""Wait after a start in the air, until the last frame and state from the ground are gone."""
STUDENT_TURN_S, EXPERT_TURN_S = (1.5, 6.0), (0.4, 1.6)
"""Range of the length of a turn. If a student flies, the expert takes over now and then: otherwise
a student that crashes at the first gate would learn nothing about later ones (DAgger, Ross et al.
2011, mixes the two at random)."""
NOMINAL_SHARE, AIRBORNE_SHARE, UNDISTURBED_SHARE = 0.25, 0.35, 0.3
"""Shares of flights without varied conditions, as most users fly first; that start in the air and
off the course; and without disturbed actions, as examples of a good flight."""
HOVER_S = (2.0, 9.0)
"""Range of the time that a flight goes on after the last gate: the end is learned, too."""
ENDLESS_LAPS = 1000
RATE_TILT_DEG = 80.0
"""Tilt limit of a policy that learns from a body-rate expert, which leans by up to 62 degrees."""


@dataclass(frozen=True, kw_only=True)
class Variation:
    """Random part of one demonstration, derived from ``seed`` alone."""

    seed: int
    conditions: Conditions
    delays: Delays
    """That of the student's vision is offset by the length of its solves."""
    starts_airborne: bool
    disturbance: float
    hover_s: float
    """Time to fly on after the last gate."""


def draw_variation(seed: int, *, longest_solve_ns: int = 0) -> Variation:
    """Draw the variation of a seed, with a solve of a quarter to all of ``longest_solve_ns``.

    The student's image is as old as a solve of that length would make it. Its state is not: it is
    as measured, as if predicted without error (``state_time = "execution"``).
    """
    random = np.random.Generator(np.random.PCG64((seed, 4)))
    shares = (NOMINAL_SHARE, AIRBORNE_SHARE, UNDISTURBED_SHARE)
    is_nominal, is_airborne, is_undisturbed = random.random(3) < shares
    delays = _random_delays(random)
    disturbance = 0.0 if is_undisturbed else float(random.uniform(0.5, 1.0))
    solve_ns = round(longest_solve_ns * float(random.uniform(0.25, 1.0)))
    return Variation(
        seed=seed,
        conditions=NOMINAL if is_nominal else training_conditions(seed),
        delays=replace(delays, vision=replace(delays.vision, offset_ns=solve_ns)),
        starts_airborne=bool(is_airborne),
        disturbance=disturbance,
        hover_s=float(np.random.Generator(np.random.PCG64((seed, 10))).uniform(*HOVER_S)),
    )


def _random_delays(random: np.random.Generator) -> Delays:
    """Draw delays between those of a fast computer and of a busy one, with log-uniform medians."""

    def median_ns(low_ms: float, high_ms: float) -> int:
        return round(NS_PER_MS * float(np.exp(random.uniform(np.log(low_ms), np.log(high_ms)))))

    camera_ns, vision_ns = median_ns(2, 12), median_ns(6, 35)
    action_ns, link_ns = median_ns(0.8, 6), median_ns(0.2, 3)
    return Delays(
        camera=Delay(p50_ns=camera_ns),
        vision=Delay(p50_ns=vision_ns, p99_ns=2 * vision_ns),
        action=Delay(p50_ns=action_ns, p99_ns=2 * action_ns),
        uplink=Delay(p50_ns=link_ns),
        downlink=Delay(p50_ns=link_ns),
    )


class Pilot:
    """Computes the expert's action at every solve; its runner flies."""

    def __init__(
        self,
        flight: SimulatedFlight,
        variation: Variation,
        *,
        speed_mps: float,
        contract: Contract,
        student: PolicyRunner | None,
    ) -> None:
        self._flight = flight
        self._variation = variation
        self._speed_mps = speed_mps
        self._student = student
        self._by_rates = contract.action == "rates"
        self._disturbance = Disturbance(
            variation.seed,
            strength=variation.disturbance,
            from_ground=not variation.starts_airborne,
            strengths=RATE_STRENGTHS if self._by_rates else STICK_STRENGTHS,
        )
        self._turns = TurnSchedule(variation.seed)
        self._expert: Expert | RateExpert | None = None
        self._solves = 0
        self._planned: tuple[int, FloatArray] | None = None
        """Time and values of the student's chunk that flies."""
        self.expert_actions: dict[int, Action] = {}
        """Expert actions by the serial of the chunk that was computed at their states."""
        self.begin_ns: int | None = None
        """Start of the demonstration; None before the policy has the sticks."""
        expert = PolicyRunner(
            contract=contract,
            name=f"expert at {speed_mps:g} m/s",
            engine="numpy",
            dual_rate=True,
            encode=lambda _rgb, _camera=0: np.zeros((1, 1), np.float32),
            act=self._act,
        )
        self.runner = replace(student or expert, act=self._act, reset=self._start)

    def _start(self) -> None:
        """Begin, now that the policy has the sticks: a vehicle placed in the air is controlled.

        The expert does not know the vehicle's parameters, because no learner could see them. It
        finishes as many courses without them (37 of 40) as with them (37 of 40).
        """
        if self._student is not None:
            self._student.reset()
        self.begin_ns, next_gate = self._flight.clock.now_ns(), 0
        if self._variation.starts_airborne:
            seed = self._variation.seed
            start = random_start(self._flight.course, seed, speed_mps=self._speed_mps)
            self._flight.vehicle.launch(start)
            self.begin_ns, next_gate = self.begin_ns + SETTLE_NS, start.next_gate
        make = RateExpert if self._by_rates else Expert
        self._expert = make(self._flight.course, self._speed_mps, next_gate=next_gate)

    def _act(self, encoded: FloatArray, state: FloatArray, history: FloatArray) -> FloatArray:
        self._solves += 1
        horizon = self.runner.contract.horizon
        if self._expert is None:  # not engaged yet: the guard has to see chunks first
            return np.zeros((1, horizon, ACTION_DIM), np.float32)
        now_s, body = self._flight.clock.now_ns() / NS_PER_S, self._flight.vehicle.ap.truth
        disturbed: Sequence[float]
        if isinstance(self._expert, RateExpert):
            command = self._expert.command(body, now_s)
            self.expert_actions[self._solves] = BodyRates(*command)
            disturbed = self._disturbance.flown(command, now_s)
        else:
            sticks = self._expert.sticks(body, now_s)
            self.expert_actions[self._solves] = Sticks(*sticks)
            disturbed = self._disturbance.flown(sticks, now_s)
        chunk = np.tile(np.array(disturbed, np.float32), (1, horizon, 1))
        if self._student is None:
            return chunk
        # Also in the expert's turns: the student can have internal state.
        now_ns, solve_ns = self._flight.clock.now_ns(), self._variation.delays.vision.offset_ns
        if self._planned is None or now_ns - self._planned[0] >= solve_ns:
            self._planned = now_ns, self._student.act(encoded, state, history).copy()
        planned_ns, plan = self._planned
        passed = (now_ns - planned_ns) / NS_PER_S / self._student.contract.chunk_dt_s
        return from_now(plan, passed) if self._turns.is_students(now_s) else chunk


def from_now(plan: FloatArray, passed: float) -> FloatArray:
    """Return a chunk [1, L, 4] of which ``passed`` steps are over, its last action repeated."""
    steps = np.arange(plan.shape[1])
    actions = [np.interp(steps + passed, steps, column) for column in plan[0].T]
    return np.stack(actions, axis=-1)[None].astype(np.float32)


class TurnSchedule:
    """Turns of student and expert, of random length, derived from ``seed``."""

    def __init__(self, seed: int) -> None:
        self._random = np.random.Generator(np.random.PCG64((seed, 5)))
        self._is_students = bool(self._random.random() < 0.5)
        self._end_s: float | None = None

    def is_students(self, t_s: float) -> bool:
        """True if the student flies at ``t_s``. Call in order of time."""
        if self._end_s is None:
            self._end_s = t_s + self._length_s()
        while t_s >= self._end_s:
            self._is_students = not self._is_students
            self._end_s += self._length_s()
        return self._is_students

    def _length_s(self) -> float:
        turn_s = STUDENT_TURN_S if self._is_students else EXPERT_TURN_S
        return float(self._random.uniform(*turn_s))


@dataclass(frozen=True, kw_only=True)
class DemonstrationSpec:
    """A demonstration to fly."""

    folder: Path
    """Its contents are replaced."""
    seed: int
    config: DemonstrateConfig
    weights: dict[str, str] = field(default_factory=dict)
    """SHA-256 of the student's files, by absolute path."""

    def __str__(self) -> str:
        return f"demonstration {self.seed}"


def fly_demonstration(spec: DemonstrationSpec, should_stop: Callable[[], bool]) -> bool:
    """Fly and record one course; return True if it was finished.

    Raises:
        EpisodeInterruptedError: ``should_stop`` ended it; the folder holds an unfinished flight.
        MavbridgeError: it cannot be flown or recorded.
    """
    rmtree(spec.folder, ignore_errors=True)
    prepare_folder(spec.folder, "--out")
    with ExitStack() as stack:
        return _fly(spec, should_stop, stack)


def _fly(spec: DemonstrationSpec, should_stop: Callable[[], bool], stack: ExitStack) -> bool:
    """Fly and record one course; ``stack`` closes the student."""
    longest_solve_ns = round(spec.config.solve_time * NS_PER_MS)
    variation = draw_variation(spec.seed, longest_solve_ns=longest_solve_ns)
    wanted = spec.config.policy
    student: PolicyRunner | None = None
    size_px = wanted.image_size or SIM_CAMERA_PX
    contract = Contract(
        feature_dim=1,
        arrays="numpy",
        image_height=size_px,
        image_width=size_px,
        action=spec.config.action,
        max_tilt_deg=RATE_TILT_DEG if spec.config.action == "rates" else None,
        stops_at_end=True,
    )
    if wanted.checkpoint is not None:
        loaded = load_for_episodes(replace(wanted, dual_rate=True), MonotonicClock())
        student = stack.enter_context(loaded).runner
        max_age_s = student.contract.max_feature_age_s + longest_solve_ns / NS_PER_S
        contract = replace(student.contract, max_feature_age_s=max_age_s, stops_at_end=True)
        student = replace(student, contract=contract)
        if contract.action != spec.config.action:
            raise UserError(
                f"{wanted.checkpoint} flies by {contract.action}: use --action {contract.action}"
            )
    flight = SimulatedFlight(
        course_seed=spec.seed,
        seed=spec.seed,
        laps=ENDLESS_LAPS if spec.config.courses == "loop" else 1,
        # The expert uses no image: frames are drawn in the size of the recording.
        settings=SimulationSettings(
            delays=variation.delays, least_camera_px=SIM_CAMERA_PX if student else 1
        ),
        vehicle=make_vehicle(autopilot=spec.config.autopilot, conditions=variation.conditions),
    )
    pilot = Pilot(
        flight, variation, speed_mps=spec.config.speed, contract=contract, student=student
    )
    meta = _meta(spec, variation, pilot.runner)
    writer = FlightWriter(spec.folder, meta, pressure="offline", with_labels=True)
    recorder = _LabelledRecorder(flight, pilot, writer)
    try:
        result = flight.fly(
            pilot.runner,
            max_time_s=spec.config.max_time,
            run_out_s=variation.hover_s,
            ends_by_stop=False,
            sinks=(recorder,),
            should_stop=should_stop,
        )
    except BaseException:
        writer.close()
        raise
    log = flight.vehicle.log
    success = not log.crashed and (log.next_gate is None or flight.course.is_loop)
    writer.finish(replace(writer.meta, success=success, gates_passed=result.gates_passed))
    return success


def _meta(spec: DemonstrationSpec, variation: Variation, runner: PolicyRunner) -> FlightMeta:
    return FlightMeta(
        started_at=datetime.now(UTC).isoformat(),
        start_ns=0,
        mavbridge_version=mavbridge.__version__,
        source="dagger" if spec.config.policy.checkpoint else "demonstration",
        policy=runner.name,
        engine=runner.engine,
        mode="dual",
        autopilot=spec.config.autopilot,
        action_hz=Rates().loops(is_dual=True).action_hz,
        visual_hz=Rates().visual_rate,
        contract=runner.contract,
        course_seed=spec.seed,
        seed=spec.seed,
        conditions=variation.conditions.numbers(),
        policy_files=spec.weights,
        plan={"speed_mps": spec.config.speed, "solve_time_ms": spec.config.solve_time},
    )


class _LabelledRecorder:
    """``TickSink`` that records the flight with labels, from the start of the demonstration."""

    def __init__(self, flight: SimulatedFlight, pilot: Pilot, writer: FlightWriter) -> None:
        self._flight = flight
        self._pilot = pilot
        self._writer = writer
        self._truths: dict[int, FrameTruth] = {}
        self._ticks = self._frames = 0
        self._chunk_serial = 0
        flight.watch_exposures(self._keep_truth)

    def _keep_truth(self, exposure: Exposure) -> None:
        body = exposure.body
        position_ned_m, ned_from_body_wxyz = body.position_ned_m, body.ned_from_body_wxyz
        next_gate = self._flight.vehicle.log.next_gate
        gates = gate_truth(self._flight.course, next_gate, position_ned_m, ned_from_body_wxyz)
        self._truths[exposure.frame_id] = FrameTruth(
            position_ned_m=position_ned_m,
            ned_from_body_wxyz=ned_from_body_wxyz,
            velocity_ned_mps=body.velocity_ned_mps,
            **asdict(gates),
        )

    def emit(self, event: Event) -> None:
        """Record the event. Numbers count from the first recorded one."""
        from_ns = self._pilot.begin_ns
        if from_ns is None:
            return
        if isinstance(event, Tick):
            self._record(event, from_ns)
        elif event.captured_ns >= from_ns:
            truth = self._truths.pop(event.frame_id, None)
            self._writer.frame(replace(event, serial=self._frames), truth)
            self._frames += 1

    def _record(self, tick: Tick, from_ns: int) -> None:
        """Record the first send of each chunk: one row per decision of the policy."""
        serial = tick.chunk_serial
        if tick.woke_ns < from_ns or serial is None or serial == self._chunk_serial:
            return
        self._chunk_serial = serial
        label = self._pilot.expert_actions.pop(serial, None)
        self._writer.tick(replace(tick, serial=self._ticks), label)
        self._ticks += 1


def demonstrate(config: DemonstrateConfig) -> int:
    """Fly every episode that is not recorded yet; return 130 if interrupted, to be resumed."""
    console = Console(stderr=True, emoji=False)
    specs = _missing(config)
    done = config.episodes - len(specs)
    if done:
        console.print(Text(f"{done} of {config.episodes} are there already", style="dim"))
    successes = 0
    with stop_on_signals() as stop, progress_bar(console) as progress:
        bar = progress.add_task("demonstrating", total=config.episodes, completed=done, status="")
        flown = fly_jobs(fly_demonstration, specs, config.workers, stop.is_set)
        for count, (_, success) in enumerate(flown, start=1):
            successes += success
            progress.update(bar, advance=1, status=f"{successes} of {count} finished the course")
        was_stopped = stop.is_set()
    if was_stopped:
        console.print(Text("interrupted: run the same command to resume", style="yellow"))
        return INTERRUPTED
    return 0


def _missing(config: DemonstrateConfig) -> list[DemonstrationSpec]:
    """Return the episodes without a finished recording.

    Raises:
        UserError: the folder of an episode holds another flight, or something else.
        FlightError: the folder of an episode holds a meta.json that is damaged or not ours.
    """
    weights = digests(policy_files(config.policy)) if config.policy.checkpoint else {}
    specs = []
    for index in range(config.episodes):
        folder, seed = config.out / f"{index:06d}", config.first_course_seed + index
        spec = DemonstrationSpec(folder=folder, seed=seed, config=config, weights=weights)
        if folder.is_dir() and any(folder.iterdir()):
            if not (folder / META).is_file():
                raise UserError(f"{folder} is no recorded flight: name another --out")
            meta = read_meta(folder)
            if differences := _differences(meta, spec):
                raise UserError(
                    f"{folder} holds another flight ({differences}): name another --out"
                )
            if meta.finished:
                continue
        specs.append(spec)
    return specs


def _differences(meta: FlightMeta, spec: DemonstrationSpec) -> str:
    """Return how a recorded flight differs from the one to fly, in words; empty if it does not."""
    config = spec.config
    pairs = {
        "source": (meta.source, "dagger" if config.policy.checkpoint else "demonstration"),
        "course seed": (meta.course_seed, spec.seed),
        "--autopilot": (meta.autopilot, config.autopilot),
        "--action": (meta.contract and meta.contract.action, config.action),
        "--speed": (meta.plan.get("speed_mps"), config.speed),
        "--solve-time": (meta.plan.get("solve_time_ms"), config.solve_time),
        "--checkpoint": tuple(
            " ".join(sorted(digest[:8] for digest in files.values())) or "none"
            for files in (meta.policy_files, spec.weights)
        ),
    }
    return "; ".join(f"{name} {was}, not {now}" for name, (was, now) in pairs.items() if was != now)
