"""The pilot of a demonstration, and what is random about it.

An expert flies, or a student whose every action the expert labels.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.vehicle import Action, BodyRates, Sticks
from mavbridge.simulation.delays import Delay, Delays
from mavbridge.simulation.flight import SimulatedFlight
from policy.contract import ACTION_DIM, Contract, FloatArray
from policy.protocol import Executable
from sitl.expert.demonstrator import Expert, RateExpert
from sitl.expert.disturbance import RATE_STRENGTHS, STICK_STRENGTHS, Disturbance, random_start
from sitl.vehicle.conditions import NOMINAL, Conditions, random_conditions
from sitl.vehicle.dynamics import BodyState

SETTLE_NS = 300 * NS_PER_MS
"""After a start in the air: until the last frame and state from the ground are gone."""
STUDENT_TURN_S, EXPERT_TURN_S = (1.5, 6.0), (0.4, 1.6)
"""Least and most length of a turn. Where a student flies, the expert takes over now and then: a
student that crashes at the first gate would otherwise learn nothing about the later ones (DAgger,
Ross et al. 2011, mixes the two at random)."""
SOLVES_KEPT = 64
"""Solves whose expert actions are kept until their ticks are recorded."""
NOMINAL_SHARE = 0.25
"""Flights without random conditions: what most users fly first."""
AIRBORNE_SHARE = 0.35
"""Flights that start in the air and off the course."""
UNDISTURBED_SHARE = 0.3
"""Flights without disturbed actions: examples of a good flight."""


@dataclass(frozen=True, kw_only=True)
class Variation:
    """The random part of one demonstration; everything follows from ``seed``."""

    seed: int
    conditions: Conditions
    delays: Delays
    starts_airborne: bool
    disturbance: float


def draw_variation(seed: int) -> Variation:
    """The variation of a seed."""
    random = np.random.Generator(np.random.PCG64((seed, 4)))
    shares = (NOMINAL_SHARE, AIRBORNE_SHARE, UNDISTURBED_SHARE)
    is_nominal, is_airborne, is_undisturbed = random.random(3) < shares
    return Variation(
        seed=seed,
        conditions=NOMINAL if is_nominal else random_conditions(seed),
        delays=_random_delays(random),
        starts_airborne=bool(is_airborne),
        disturbance=0.0 if is_undisturbed else float(random.uniform(0.5, 1.0)),
    )


def _random_delays(random: np.random.Generator) -> Delays:
    """Delays between those of a fast computer and a busy one, with log-uniform medians."""

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
    """The expert's action at every solve, and an executable that flies."""

    def __init__(
        self,
        flight: SimulatedFlight,
        variation: Variation,
        *,
        speed_mps: float,
        contract: Contract,
        student: Executable | None,
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
        self._expert_actions: dict[int, Action] = {}
        """By the serial of the chunk that was computed with them."""
        self.begin_ns: int | None = None
        """When the demonstration begins; None before the policy has the vehicle's sticks."""
        expert = Executable(
            contract=contract,
            name=f"expert at {speed_mps:g} m/s",
            engine="numpy",
            dual_rate=True,
            encode=lambda _rgb, _camera=0: np.zeros((1, 1), np.float32),
            act=self._act,
        )
        self.executable = replace(student or expert, act=self._act, reset=self._start)

    def expert_action(self, chunk_serial: int) -> Action | None:
        """The expert's action at the state of a recent chunk; None before its demonstration."""
        return self._expert_actions.get(chunk_serial)

    def _start(self) -> None:
        """The policy has the sticks now: a vehicle that is put in the air is under control."""
        if self._student is not None:
            self._student.reset()
        self._expert = self._begin(self._flight.clock.now_ns())

    def _act(self, encoded: FloatArray, state: FloatArray, history: FloatArray) -> FloatArray:
        self._solves += 1
        horizon = self.executable.contract.horizon
        if self._expert is None:  # not engaged yet: the gate wants to see chunks first
            return np.zeros((1, horizon, ACTION_DIM), np.float32)
        now_s, body = self._flight.clock.now_ns() / NS_PER_S, self._flight.vehicle.ap.truth
        self._expert_actions[self._solves], disturbed = self._demonstrate(self._expert, body, now_s)
        self._expert_actions.pop(self._solves - SOLVES_KEPT, None)
        chunk = np.tile(np.array(disturbed, np.float32), (1, horizon, 1))
        if self._student is None:
            return chunk
        # Called at every tick, also in the expert's turns: the student may hold state of its own.
        students = self._student.act(encoded, state, history)
        return students if self._turns.is_students(now_s) else chunk

    def _demonstrate(
        self, expert: Expert | RateExpert, body: BodyState, now_s: float
    ) -> tuple[Action, Sequence[float]]:
        """The expert's action, and what is flown of it."""
        if isinstance(expert, RateExpert):
            command = expert.command(body, now_s)
            return BodyRates(*command), self._disturbance.flown(command, now_s)
        sticks = expert.sticks(body, now_s)
        return Sticks(*sticks), self._disturbance.flown(sticks, now_s)

    def _begin(self, now_ns: int) -> Expert | RateExpert:
        """Put the vehicle where the demonstration starts, and make the expert that flies it.

        The expert does not know the vehicle's parameters, which no learner could see: it flies as
        many courses without them (37 of 40, and 37 of 40 with).
        """
        if not self._variation.starts_airborne:
            self.begin_ns = now_ns
            return self._make_expert(0)
        seed = self._variation.seed
        start = random_start(self._flight.course, seed, speed_mps=self._speed_mps)
        self._flight.vehicle.launch(start)
        self.begin_ns = now_ns + SETTLE_NS
        return self._make_expert(start.next_gate)

    def _make_expert(self, next_gate: int) -> Expert | RateExpert:
        make = RateExpert if self._by_rates else Expert
        return make(self._flight.course, self._speed_mps, next_gate=next_gate)


class TurnSchedule:
    """Student and expert fly in turns of random length, which follow from ``seed``."""

    def __init__(self, seed: int) -> None:
        self._random = np.random.Generator(np.random.PCG64((seed, 5)))
        self._is_students = bool(self._random.random() < 0.5)
        self._end_s: float | None = None

    def is_students(self, t_s: float) -> bool:
        """The student flies at ``t_s``; call in order of time."""
        if self._end_s is None:
            self._end_s = t_s + self._length_s()
        while t_s >= self._end_s:
            self._is_students = not self._is_students
            self._end_s += self._length_s()
        return self._is_students

    def _length_s(self) -> float:
        turn_s = STUDENT_TURN_S if self._is_students else EXPERT_TURN_S
        return float(self._random.uniform(*turn_s))
