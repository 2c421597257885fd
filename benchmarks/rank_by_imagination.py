"""Does a policy that flies better in imagination fly better? Checkpoints ranked both ways.

python -m benchmarks.rank_by_imagination HELD_OUT_FLIGHTS
--candidate a.safetensors 1 5.2 --candidate b.safetensors 10 1.3

The numbers beside a checkpoint are its diffusion steps and its real score with them, the gates that
``mavbridge evaluate --dual-rate --num-diffusion-steps N`` counts. The imagined score is the number
of gates that it passes in the world model from moments of demonstrations a little before a gate,
out of those that the expert passed there in the same time. The course is the demonstration's own,
the path is the sum of the imagined velocities, and gates are counted as in a real flight. Two
controls calibrate the figures: the expert's own sticks, and sticks that stay centred.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np
from cyclopts import App
from numpy.typing import NDArray

from mavbridge.commands.bench.tables import make_table
from mavbridge.commands.evaluate_imagination.scores import spearman
from mavbridge.commands.imagine.deciders import Decider, ObservationQueue, PolicyDecider
from mavbridge.commands.imagine.loop import RolloutPlan, rollout
from mavbridge.commands.imagine.run import load_model
from mavbridge.commands.imagine.sampling import Sampler
from mavbridge.commands.imagine.start import RolloutStart, read_start
from mavbridge.commands.output import print_status, table_console
from mavbridge.config.policy import PolicyConfig
from mavbridge.core.clock import NS_PER_S, MonotonicClock
from mavbridge.core.records import FloatArray
from mavbridge.flight.policies import load_configured_policy
from mavbridge.recording.flight_folder import RecordedFlight, open_flight
from policy.contract import ACTION_DIM, VELOCITY, Contract
from policy.data.flight_folders import find_flights, is_exemplary
from sitl.course.layout import Course, make_course
from sitl.course.referee import GateCounter

ITERATIONS, EXE_STEPS = 8, 4
"""3.2 s, with a decision every 0.4 s: at 5 m/s that is two gates."""
BEFORE_GATE_S = 1.2

Points = NDArray[np.float64]
app = App(help=__doc__)


@dataclass(frozen=True, kw_only=True)
class Case:
    """A moment of a demonstration, and the expert's flight from there on."""

    start: RolloutStart
    position_ned_m: Points
    course: Course
    next_gate: int
    expert_gates: int
    """Gates that the expert passed in the time of a rollout."""
    expert_end_ned_m: Points
    expert_sticks: FloatArray
    """[steps, 4], the mean of what was sent in each step."""


@dataclass(kw_only=True)
class Replay:
    """A ``Decider`` for one case that gives recorded sticks [steps, 4], and centred ones after."""

    sticks: FloatArray
    frames: int
    contract: Contract = field(default_factory=Contract)
    images: int = 0
    steps_given: int = 0

    def decide(self, seen: ObservationQueue, seed: int) -> FloatArray:
        """Sticks of the next steps [frames, 4]."""
        chosen = np.zeros((self.frames, ACTION_DIM), np.float32)
        ahead = self.sticks[self.steps_given :][: self.frames]
        chosen[: len(ahead)] = ahead
        self.steps_given += EXE_STEPS
        return chosen


@dataclass(frozen=True, kw_only=True)
class Score:
    """Imagined flights of one candidate."""

    gates: int
    end_error_m: float
    """Mean distance of the ends from where the expert was."""


def cases_of(flight: RecordedFlight, sampler: Sampler) -> list[Case]:
    """A case for each gate with enough flight around it; none if the course is not known."""
    if flight.meta.course_seed is None:
        return []
    rows = flight.frames.to_pylist()
    stamps_ns = np.array([row["captured_ns"] for row in rows])
    course, config = make_course(flight.meta.course_seed), sampler.config
    first_ns = flight.ticks["attitude_ns"].drop_null()[0].as_py()
    first_ns = stamps_ns[stamps_ns >= first_ns][0]
    context_ns = round((config.context_frames - 1) * config.frame_dt_s * NS_PER_S)
    length_ns = round(ITERATIONS * EXE_STEPS * config.frame_dt_s * NS_PER_S)
    cases = []
    for before, after in pairwise(rows):
        if before["next_gate"] is None or before["next_gate"] == after["next_gate"]:
            continue
        now_ns = after["captured_ns"] - round(BEFORE_GATE_S * NS_PER_S)
        if now_ns - context_ns < first_ns or now_ns + length_ns > stamps_ns[-1]:
            continue
        start = read_start(flight, config, (now_ns - context_ns - first_ns) / NS_PER_S)
        now = rows[int(np.searchsorted(stamps_ns, start.newest_ns))]
        end = rows[int(np.searchsorted(stamps_ns, start.newest_ns + length_ns)) - 1]
        if now["next_gate"] != before["next_gate"]:
            continue
        last = len(course.gates) if end["next_gate"] is None else end["next_gate"]
        cases.append(
            Case(
                start=start,
                position_ned_m=np.array(now["position_ned_m"]),
                course=course,
                next_gate=now["next_gate"],
                expert_gates=last - now["next_gate"],
                expert_end_ned_m=np.array(end["position_ned_m"]),
                expert_sticks=sticks_of(flight, start.newest_ns, config.frame_dt_s),
            )
        )
    return cases


def sticks_of(flight: RecordedFlight, from_ns: int, dt_s: float) -> FloatArray:
    """Mean sticks [steps, 4] that were sent in each step of a rollout that starts at a moment."""
    known = [row.tick for row in flight.tick_rows() if row.tick.sent is not None]
    step = np.array([(tick.sent_ns - from_ns) / (dt_s * NS_PER_S) for tick in known])
    sent = np.array([tick.sent for tick in known], np.float32)
    means = [sent[(step >= k) & (step < k + 1)].mean(axis=0) for k in range(ITERATIONS * EXE_STEPS)]
    return np.stack(means)


def path_of(sampler: Sampler, decider: Decider, case: Case, seed: int) -> Points:
    """The imagined path [steps + 1, 3], m in NED, from where the vehicle really was."""
    plan = RolloutPlan(
        iterations=ITERATIONS, frames=EXE_STEPS, exe_steps=EXE_STEPS, ddim_steps=4, seed=seed
    )
    states = [case.start.states[-1:]]
    states += [segment.states for segment in rollout(sampler, decider, case.start, plan)]
    velocity = np.concatenate(states)[:, VELOCITY].astype(np.float64)
    steps_m = (velocity[1:] + velocity[:-1]) / 2 * sampler.config.frame_dt_s
    path_m: Points = np.concatenate([np.zeros((1, 3)), steps_m.cumsum(axis=0)])
    return path_m + case.position_ned_m


def gates_passed(path_m: Points, course: Course, first: int) -> int:
    """Count gates from ``first`` on, along straight lines between points [steps + 1, 3], NED."""
    counter = GateCounter(course, first=first)
    for step, (north_m, east_m, down_m) in enumerate(path_m.tolist()):
        counter.update((north_m, east_m, down_m), float(step))
    return len(counter.passed)


def score(sampler: Sampler, decider_for: Callable[[Case], Decider], cases: Sequence[Case]) -> Score:
    """Fly every case in imagination."""
    gates, errors_m = 0, []
    for seed, case in enumerate(cases):
        path_m = path_of(sampler, decider_for(case), case, seed)
        gates += min(gates_passed(path_m, case.course, case.next_gate), case.expert_gates)
        errors_m.append(float(np.linalg.norm(path_m[-1] - case.expert_end_ned_m)))
    return Score(gates=gates, end_error_m=float(np.mean(errors_m)))


def always(decider: Decider) -> Callable[[Case], Decider]:
    """The same decider for every case."""
    return lambda _: decider


@app.default
def main(
    *flights: Path,
    candidate: list[tuple[Path, int, float]],
    world_model: Path | None = None,
    starts: int = 24,
) -> None:
    """Score all candidates, print them and how their two rankings correlate.

    Args:
        flights: held-out demonstrations.
        candidate: checkpoint, diffusion steps and real score; may be repeated.
        world_model: weights; by default those that come with mavbridge.
        starts: cases, spread over all flights.
    """
    model = load_model(world_model, ddim_steps=4, device="cpu")
    sampler = Sampler(model, ddim_steps=4, decode_all=False, clock=MonotonicClock())
    folders = [folder for folder in find_flights(flights) if is_exemplary(folder)]
    every = [case for folder in folders for case in cases_of(open_flight(folder), sampler)]
    chosen = np.linspace(0, len(every) - 1, min(starts, len(every))).astype(int)
    cases = [every[row] for row in chosen]
    frames = sampler.config.frames
    controls: dict[str, Callable[[Case], Decider]] = {
        "the expert's sticks": lambda case: Replay(sticks=case.expert_sticks, frames=frames),
        "centred sticks": lambda case: Replay(sticks=0 * case.expert_sticks, frames=frames),
    }
    rows = []
    for name, control in controls.items():
        one = score(sampler, control, cases)
        rows.append((name, "-", "-", str(one.gates), f"{one.end_error_m:.1f}"))
    scores = []
    for path, steps, real in candidate:
        wanted = PolicyConfig(checkpoint=path, dual_rate=True, num_diffusion_steps=steps)
        loaded = load_configured_policy(wanted, MonotonicClock())
        decider = PolicyDecider(loaded.executable, sampler)
        scores.append(one := score(sampler, always(decider), cases))
        rows.append((path.stem, str(steps), f"{real:g}", str(one.gates), f"{one.end_error_m:.1f}"))
    total = sum(case.expert_gates for case in cases)
    header = ("flown by", "steps", "real score", f"gates imagined, of {total}", "off the expert, m")
    table_console().print(make_table(f"{len(cases)} starts, {len(folders)} flights", header, rows))
    real_scores = [real for _, _, real in candidate]
    for name, figures in (
        ("gates imagined", [float(one.gates) for one in scores]),
        ("small distance from the expert", [-one.end_error_m for one in scores]),
    ):
        correlation = spearman(np.array(real_scores), np.array(figures))
        print_status(f"Spearman of real score and {name}: {correlation}")


if __name__ == "__main__":
    app()
