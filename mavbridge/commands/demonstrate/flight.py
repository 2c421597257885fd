"""One demonstration: an episode in lockstep, labelled and recorded as a flight is."""

from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

import numpy as np

import mavbridge
from mavbridge.config.flight import Limits
from mavbridge.config.rates import Rates
from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.records import Event, Sticks, Tick
from mavbridge.recording.flight_writer import FlightWriter
from mavbridge.recording.meta import FlightMeta
from mavbridge.recording.rows import FrameTruth, TickLabels
from mavbridge.simulation.delays import Delays, Fixed, LogNormal
from mavbridge.simulation.episode import Episode, Setup
from mavbridge.simulation.world import Exposure, varied_scene
from policy.contract import Contract, Executable, FloatArray
from sitl.course.truth import gate_truth
from sitl.expert.demonstrator import Expert
from sitl.expert.disturbance import StickDisturbance, random_start
from sitl.expert.stick_response import StickPositions
from sitl.vehicle.conditions import NOMINAL, Conditions, random_conditions

NOMINAL_SHARE = 0.25
"""Flights without randomised conditions: what most people will fly first."""
AIRBORNE_SHARE = 0.35
"""Flights that start in the air and off the course."""
QUIET_SHARE = 0.3
"""Flights without disturbed sticks: what a good flight looks like."""
SETTLE_NS = 300 * NS_PER_MS
"""After a start in the air: until the last frame and state from the ground are gone."""
KEPT_TRUTHS = 64
"""Exposures that may wait for their frame to be seen."""
STUDENT_TURN_S, EXPERT_TURN_S = (1.5, 6.0), (0.4, 1.6)
"""Where a student flies, the expert takes over now and then: a student that crashes at the first
gate would otherwise be taught nothing of the others (Ross et al. 2011 mix the two by chance)."""


@dataclass(frozen=True, kw_only=True)
class Draw:
    """What is random about one demonstration; everything follows from ``seed``."""

    seed: int
    conditions: Conditions
    delays: Delays
    starts_airborne: bool
    disturbance: float


def draw(seed: int) -> Draw:
    """Conditions, delays, start and disturbance of a seed."""
    random = np.random.Generator(np.random.PCG64((seed, 4)))
    is_nominal, is_airborne, is_quiet = random.random(3) < (
        NOMINAL_SHARE,
        AIRBORNE_SHARE,
        QUIET_SHARE,
    )
    return Draw(
        seed=seed,
        conditions=NOMINAL if is_nominal else random_conditions(seed),
        delays=_random_delays(random),
        starts_airborne=bool(is_airborne),
        disturbance=0.0 if is_quiet else float(random.uniform(0.5, 1.0)),
    )


def _random_delays(random: np.random.Generator) -> Delays:
    """From a fast computer to a busy one, a log-uniform median for each part."""

    def median_ns(low_ms: float, high_ms: float) -> int:
        return round(NS_PER_MS * float(np.exp(random.uniform(np.log(low_ms), np.log(high_ms)))))

    camera_ns, vision_ns = median_ns(2, 12), median_ns(6, 35)
    action_ns, link_ns = median_ns(0.8, 6), median_ns(0.2, 3)
    return Delays(
        camera=Fixed(camera_ns),
        vision=LogNormal(p50_ns=vision_ns, p99_ns=2 * vision_ns),
        action=LogNormal(p50_ns=action_ns, p99_ns=2 * action_ns),
        uplink=Fixed(link_ns),
        downlink=Fixed(link_ns),
    )


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """How a demonstration went."""

    success: bool
    gates_passed: int
    ticks: int


def demonstrate_once(
    folder: Path,
    seed: int,
    *,
    speed_mps: float,
    max_time_s: float,
    contract: Contract,
    student: Executable | None = None,
) -> Outcome:
    """Fly and record one course.

    Args:
        folder: from ``prepare_folder``.
        seed: of the course and of everything random.
        speed_mps: of the expert.
        max_time_s: after which the flight ends wherever it is.
        contract: of the policy that will learn from this: image size, horizon.
        student: flies most of the time; the expert labels all of it, and takes over now and then so
            that the flight goes on (DAgger).

    Raises:
        MavbridgeError, PolicyError: it cannot be flown, or not recorded.
    """
    drawn = draw(seed)
    episode = Episode(
        course_seed=seed,
        seed=seed,
        setup=_setup(drawn.delays, is_seen=student is not None),
        build_scene=varied_scene(drawn.conditions),
    )
    pilot = _Pilot(episode, drawn, speed_mps=speed_mps, contract=contract, student=student)
    writer = FlightWriter(
        folder,
        _meta(drawn, pilot.executable, "demonstration" if student is None else "dagger"),
        pressure="offline",
        with_labels=True,
    )
    notes = _Notes(episode, pilot, writer)
    try:
        result = episode.fly(pilot.executable, max_time_s=max_time_s, sinks=(notes,))
    except BaseException:
        writer.close()
        raise
    log = episode.vehicle.log
    success = log.next_gate is None and not log.crashed
    writer.finish(
        replace(writer.meta, autopilot="sitl", success=success, gates_passed=result.gates_passed)
    )
    return Outcome(success=success, gates_passed=result.gates_passed, ticks=writer.ticks)


def _setup(delays: Delays, *, is_seen: bool) -> Setup:
    """The expert looks at no image: they are recorded in the size that was asked for."""
    setup = Setup(rates=Rates(), limits=Limits(), delays=delays)
    return setup if is_seen else replace(setup, least_camera_px=1)


def _meta(
    drawn: Draw, executable: Executable, source: Literal["demonstration", "dagger"]
) -> FlightMeta:
    return FlightMeta(
        started_at=datetime.now(UTC).isoformat(),
        start_ns=0,
        mavbridge_version=mavbridge.__version__,
        source=source,
        policy=executable.name,
        engine=executable.engine,
        mode="dual",
        action_hz=Rates().action_rate,
        visual_hz=Rates().visual_limits_hz[1],
        contract=executable.contract,
        course_seed=drawn.seed,
        seed=drawn.seed,
        conditions=drawn.conditions.numbers(),
    )


class _Pilot:
    """The expert's opinion at every action, and who really flies."""

    def __init__(
        self,
        episode: Episode,
        drawn: Draw,
        *,
        speed_mps: float,
        contract: Contract,
        student: Executable | None,
    ) -> None:
        self._episode = episode
        self._drawn = drawn
        self._speed_mps = speed_mps
        self._student = student
        self._noise = StickDisturbance(
            drawn.seed, strength=drawn.disturbance, from_ground=not drawn.starts_airborne
        )
        self._turns = _Turns(drawn.seed)
        self._expert: Expert | None = None
        self.opinion: Sticks | None = None
        """What the expert would hold; None before the first action."""
        self.records_from_ns: int | None = None
        """Since when the flight is what the recording is about."""
        self._contract = contract
        flies = student or Executable(
            contract=contract,
            name=f"expert at {speed_mps:g} m/s",
            engine="numpy",
            dual_rate=True,
            encode=lambda _: np.zeros((1, 1), np.float32),
            act=self._act,
        )
        self.executable = replace(flies, act=self._act)

    def _act(
        self, encoded: FloatArray, state: FloatArray, history: FloatArray, elapsed_s: float | None
    ) -> FloatArray:
        now_ns = self._episode.clock.now_ns()
        if self._expert is None:
            self._expert = self._begin(now_ns)
        body = self._episode.vehicle.ap.truth
        self.opinion = Sticks(*self._expert.sticks(body, now_ns / NS_PER_S))
        demonstrated = self._expert_chunk()
        if self._student is None:
            return demonstrated
        # Asked at every tick, also where it is not its turn: it may hold state of its own.
        chunk = self._student.act(encoded, state, history, elapsed_s)
        return chunk if self._turns.is_students(now_ns / NS_PER_S) else demonstrated

    def _begin(self, now_ns: int) -> Expert:
        """At the first action, so that the sticks are ours when the vehicle is in the air.

        The expert is not told the vehicle's settings: what its sticks owe to them, no learner could
        see. It flies as many courses without (37 of 40, and 37 of 40 with).
        """
        if not self._drawn.starts_airborne:
            self.records_from_ns = now_ns
            return Expert(self._episode.course, self._speed_mps)
        start = random_start(self._episode.course, self._drawn.seed, speed_mps=self._speed_mps)
        self._episode.vehicle.launch(start)
        self.records_from_ns = now_ns + SETTLE_NS
        return Expert(self._episode.course, self._speed_mps, next_gate=start.next_gate)

    def _expert_chunk(self) -> FloatArray:
        if self.opinion is None:
            raise RuntimeError("the expert flies what it was asked for")
        now_s = self._episode.clock.now_ns() / NS_PER_S
        flown = self._noise.flown(StickPositions(*self.opinion), now_s)
        return np.tile(np.array(flown, np.float32), (1, self._contract.horizon, 1))


class _Turns:
    """Whose sticks are flown, student's or expert's, in turns of random length."""

    def __init__(self, seed: int) -> None:
        self._random = np.random.Generator(np.random.PCG64((seed, 5)))
        self._is_students = bool(self._random.random() < 0.5)
        self._end_s: float | None = None

    def is_students(self, t_s: float) -> bool:
        """At ``t_s``; ask in order of time."""
        if self._end_s is None:
            self._end_s = t_s + self._length_s()
        while t_s >= self._end_s:
            self._is_students = not self._is_students
            self._end_s += self._length_s()
        return self._is_students

    def _length_s(self) -> float:
        turn_s = STUDENT_TURN_S if self._is_students else EXPERT_TURN_S
        return float(self._random.uniform(*turn_s))


class _Notes:
    """A ``TickSink``: records what happens once the flight has begun, with the labels."""

    def __init__(self, episode: Episode, pilot: _Pilot, writer: FlightWriter) -> None:
        self._episode = episode
        self._pilot = pilot
        self._writer = writer
        self._truths: dict[int, FrameTruth] = {}
        self._ticks = self._frames = 0
        episode.watch_exposures(self._note_truth)

    def _note_truth(self, exposure: Exposure) -> None:
        body = exposure.body
        seen = gate_truth(
            self._episode.course,
            self._episode.vehicle.log.next_gate,
            body.position_ned_m,
            body.ned_from_body_wxyz,
        )
        self._truths[exposure.frame_id] = FrameTruth(
            position_ned_m=body.position_ned_m,
            ned_from_body_wxyz=body.ned_from_body_wxyz,
            velocity_ned_mps=body.velocity_ned_mps,
            next_gate=seen.next_gate,
            gate_body_m=seen.gate_body_m,
            gate_yaw_rad=seen.gate_yaw_rad,
            gate_after_body_m=seen.gate_after_body_m,
        )
        if len(self._truths) > KEPT_TRUTHS:
            self._truths.pop(next(iter(self._truths)))

    def emit(self, event: Event) -> None:
        """Record the event, numbered from the first that is recorded."""
        from_ns = self._pilot.records_from_ns
        if from_ns is None:
            return
        if isinstance(event, Tick):
            if event.woke_ns >= from_ns and event.trace is not None:
                labels = TickLabels(expert=self._pilot.opinion)
                self._writer.tick(replace(event, serial=self._ticks), labels)
                self._ticks += 1
        elif event.captured_ns >= from_ns:
            truth = self._truths.get(event.frame_id)
            self._writer.frame(replace(event, serial=self._frames), truth)
            self._frames += 1
