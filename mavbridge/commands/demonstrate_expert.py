"""The expert and its student, their turns, and the random part of each demonstration."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mavbridge.config.policy import SOLVES_PER_PLAY
from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.vehicle import Action, BodyRates, Sticks
from mavbridge.simulation.delays import Delay, Delays
from mavbridge.simulation.flight import SimulatedFlight
from policy.contract import ACTION_DIM, Contract, FloatArray
from policy.protocol import PolicyRunner
from sitl.pilot.course_guide import CourseGuide
from sitl.pilot.demonstrator import RATE_AGILITY, STICK_AGILITY, expert_rates, expert_sticks
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
    camera_ns, vision_ns, action_ns, link_ns = (
        round(NS_PER_MS * float(np.exp(random.uniform(*np.log(range_ms)))))
        for range_ms in ((2, 12), (6, 35), (0.8, 6), (0.2, 3))
    )
    return Delays(
        camera=Delay(p50_ns=camera_ns),
        vision=Delay(p50_ns=vision_ns, p99_ns=2 * vision_ns),
        action=Delay(p50_ns=action_ns, p99_ns=2 * action_ns),
        uplink=Delay(p50_ns=link_ns),
        downlink=Delay(p50_ns=link_ns),
    )


class ExpertAndStudent:
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
        self._guide: CourseGuide | None = None
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
        agility = RATE_AGILITY if self._by_rates else STICK_AGILITY
        self._guide = CourseGuide(self._flight.course, agility, self._speed_mps, next_gate)

    def _act(self, encoded: FloatArray, state: FloatArray, history: FloatArray) -> FloatArray:
        horizon = self.runner.contract.horizon
        if self._guide is None:  # not engaged yet: the guard has to see chunks first
            self._solves += 1
            return np.zeros((1, horizon, ACTION_DIM), np.float32)
        now_ns, body = self._flight.clock.now_ns(), self._flight.vehicle.ap.truth
        now_s, solve_ns = now_ns / NS_PER_S, self._variation.delays.vision.offset_ns
        label: Action
        disturbed: Sequence[float]
        if self._by_rates:
            command = expert_rates(self._guide, body, now_s)
            label, disturbed = BodyRates(*command), self._disturbance.flown(command, now_s)
        else:
            sticks = expert_sticks(self._guide, body, now_s)
            label, disturbed = Sticks(*sticks), self._disturbance.flown(sticks, now_s)
        chunk = np.tile(np.array(disturbed, np.float32), (1, horizon, 1))
        if self._student is not None:
            # Also in the expert's turns: the student can have internal state.
            played_ns = self._student.contract.play_s / SOLVES_PER_PLAY * NS_PER_S
            if self._planned is None or now_ns - self._planned[0] >= max(solve_ns, played_ns):
                self._planned = now_ns, self._student.act(encoded, state, history).copy()
            planned_ns, plan = self._planned
            passed = (now_ns - planned_ns) / NS_PER_S / self._student.contract.chunk_dt_s
            chunk = from_now(plan, passed) if self._turns.is_students(now_s) else chunk
        self._solves += 1  # a chunk that the student refuses gets no serial
        self.expert_actions[self._solves] = label
        return chunk


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
