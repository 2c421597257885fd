"""Does a policy that flies better in imagination fly better? Checkpoints ranked both ways.

    python -m benchmarks.rank_by_imagination HELD_OUT_FLIGHTS \\
        --candidate a.safetensors 1 5.2 --candidate b.safetensors 10 1.3

The numbers beside a checkpoint are its diffusion steps and its real score with them, the gates that
``mavbridge evaluate --dual-rate --num-diffusion-steps N`` counts. The imagined one is the share of
gates that it passes in the world model, from moments of demonstrations a little before a gate, of
those that the expert passed there in the same time. The course is the demonstration's own, the path
is the sum of the imagined velocities, and gates are counted as in a real flight. Two rows say what
the figures are worth: the expert's own sticks, and sticks that stay centred.
"""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from mavbridge.commands.evaluate_imagination.scores import spearman
from mavbridge.commands.imagine.deciders import Decider, ObservationQueue, PolicyDecider
from mavbridge.commands.imagine.loop import RolloutPlan, rollout
from mavbridge.commands.imagine.run import load_model
from mavbridge.commands.imagine.sampling import Sampler
from mavbridge.commands.imagine.start import RolloutStart, read_start
from mavbridge.config.policy import PolicyConfig
from mavbridge.core.clock import NS_PER_S, MonotonicClock
from mavbridge.core.records import FloatArray
from mavbridge.flight.assembly import load_configured_policy
from mavbridge.recording.flight_folder import RecordedFlight, open_flight
from policy.contract import ACTION_DIM, VELOCITY, Contract
from policy.data.flight_folders import find_flights, is_exemplary
from sitl.course.course import Course, GateCounter, make_course

ITERATIONS, EXE_STEPS = 8, 4
"""3.2 s, with a decision every 0.4 s: at 5 m/s that is two gates."""
BEFORE_GATE_S = 1.2

Points = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Case:
    """A moment of a demonstration, and what lay ahead."""

    start: RolloutStart
    position_ned_m: Points
    course: Course
    next_gate: int
    expert_gates: int
    """That the expert passed in the time of a rollout."""
    expert_end_ned_m: Points
    expert_sticks: FloatArray
    """[steps, 4] that the expert's flight was sent, the mean of each step."""


@dataclass(kw_only=True)
class Replay:
    """Gives sticks [steps, 4] that are known beforehand; a ``Decider`` for one case."""

    sticks: FloatArray
    frames: int
    contract: Contract = field(default_factory=Contract)
    images: int = 0
    steps_given: int = 0

    def decide(self, seen: ObservationQueue, seed: int) -> FloatArray:
        """Those of the next steps [frames, 4]; centred after the last."""
        chosen = np.zeros((self.frames, ACTION_DIM), np.float32)
        ahead = self.sticks[self.steps_given :][: self.frames]
        chosen[: len(ahead)] = ahead
        self.steps_given += EXE_STEPS
        return chosen


@dataclass(frozen=True, kw_only=True)
class Score:
    """Of one candidate."""

    passed: int
    end_error_m: float
    """From where the expert was at the end, mean."""


def cases_of(flight: RecordedFlight, sampler: Sampler) -> list[Case]:
    """One a gate, where the flight goes on for long enough; none if its course is not known."""
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
    """What was sent [steps, 4] in each step of a rollout from a moment on."""
    known = [row.tick for row in flight.tick_rows() if row.tick.sent is not None]
    step = np.array([(tick.sent_ns - from_ns) / (dt_s * NS_PER_S) for tick in known])
    sent = np.array([tick.sent for tick in known], np.float32)
    means = [sent[(step >= k) & (step < k + 1)].mean(axis=0) for k in range(ITERATIONS * EXE_STEPS)]
    return np.stack(means)


def path_of(sampler: Sampler, decider: Decider, case: Case, seed: int) -> Points:
    """The imagined way [steps + 1, 3], m in NED, from where the vehicle really was."""
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
    """From gate ``first`` on, along straight steps between points [steps + 1, 3]."""
    counter = GateCounter(course, first=first)
    for step, (north_m, east_m, down_m) in enumerate(path_m.tolist()):
        counter.update((north_m, east_m, down_m), float(step))
    return len(counter.passed)


def policy_decider(sampler: Sampler, checkpoint: Path, steps: int) -> PolicyDecider:
    """A candidate."""
    wanted = PolicyConfig(checkpoint=checkpoint, dual_rate=True, num_diffusion_steps=steps)
    return PolicyDecider(load_configured_policy(wanted, MonotonicClock()).executable, sampler)


def always(decider: Decider) -> Callable[[Case], Decider]:
    """The same for every case."""
    return lambda _: decider


def score(sampler: Sampler, decider_for: Callable[[Case], Decider], cases: Sequence[Case]) -> Score:
    """Fly every case in imagination."""
    passed, errors_m = 0, []
    for seed, case in enumerate(cases):
        path_m = path_of(sampler, decider_for(case), case, seed)
        passed += min(gates_passed(path_m, case.course, case.next_gate), case.expert_gates)
        errors_m.append(float(np.linalg.norm(path_m[-1] - case.expert_end_ned_m)))
    return Score(passed=passed, end_error_m=float(np.mean(errors_m)))


def main() -> None:
    """Score all candidates, print them and how the two rankings hang together."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("flights", type=Path, nargs="+", help="demonstrations, held out")
    names = ("CHECKPOINT", "STEPS", "REAL")
    parser.add_argument("--candidate", nargs=3, action="append", default=[], metavar=names)
    parser.add_argument("--world-model", type=Path)
    parser.add_argument("--starts", type=int, default=24)
    args = parser.parse_args()
    model = load_model(args.world_model, ddim_steps=4, device="cpu")
    sampler = Sampler(model, ddim_steps=4, decode_all=False, clock=MonotonicClock())
    folders = [folder for folder in find_flights(args.flights) if is_exemplary(folder)]
    every = [case for folder in folders for case in cases_of(open_flight(folder), sampler)]
    chosen = np.linspace(0, len(every) - 1, min(args.starts, len(every))).astype(int)
    cases = [every[row] for row in chosen]
    total = sum(case.expert_gates for case in cases)
    frames = sampler.config.frames
    controls: dict[str, Callable[[Case], Decider]] = {
        "the expert's sticks": lambda case: Replay(sticks=case.expert_sticks, frames=frames),
        "centred sticks": lambda case: Replay(sticks=0 * case.expert_sticks, frames=frames),
    }
    table = Table(
        "checkpoint", "steps", "real score", f"gates imagined, of {total}", "off the expert, m"
    )
    for name, control in controls.items():
        one = score(sampler, control, cases)
        table.add_row(name, "-", "-", str(one.passed), f"{one.end_error_m:.1f}")
    scores, real = [], [float(given) for _, _, given in args.candidate]
    for name, steps, given in args.candidate:
        decider = policy_decider(sampler, Path(name), int(steps))
        scores.append(one := score(sampler, always(decider), cases))
        table.add_row(Path(name).stem, steps, given, str(one.passed), f"{one.end_error_m:.1f}")
    console = Console(highlight=False)
    console.print(table)
    by_gates = spearman(np.array(real), np.array([float(one.passed) for one in scores]))
    by_error = spearman(np.array(real), np.array([-one.end_error_m for one in scores]))
    told = [f"{value:+.2f}" if value is not None else "none" for value in (by_gates, by_error)]
    console.print(
        f"{len(scores)} candidates, {len(cases)} starts in {len(folders)} flights; Spearman with "
        f"gates imagined {told[0]}, with nearness to the expert {told[1]}",
        soft_wrap=True,
    )


if __name__ == "__main__":
    main()
