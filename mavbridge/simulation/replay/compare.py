"""Comparison of a replay with the recording, bit for bit."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mavbridge.core.reasons import Code, because
from mavbridge.core.records import Solve
from mavbridge.core.ticks import GuardTick
from mavbridge.core.vehicle import ActionTrace
from mavbridge.recording.rows import attributes
from mavbridge.simulation.replay.guard import GuardStep
from mavbridge.simulation.replay.policy import SolvePair
from policy.data.tables import STATE_STAMPS

Array: TypeAlias = NDArray[np.float64]
PAST_INPUTS = ("states", "history", "moments")
"""Inputs that a policy with the recorded contract gets from the recording. Rebuilt ones may differ
if the recording lacks a solve without a chunk, or a tick in transit."""


@dataclass(frozen=True, kw_only=True)
class Deviation:
    """Largest and RMS difference of each of an action's four numbers."""

    largest: tuple[float, ...]
    rms: tuple[float, ...]

    @property
    def most(self) -> float:
        """Largest of all four."""
        return max(self.largest)


@dataclass(frozen=True, kw_only=True)
class PolicyComparison:
    """Comparison of all solves with their repetition."""

    solves: int
    missing: Mapping[str, int]
    """Number of solves not repeated, or refused in the replay, by reason."""
    inputs_differ: Mapping[str, int]
    """Number of solves with a different input, by input; equal inputs left out."""
    equal_chunks: int
    """Solves with a bit-identical chunk."""
    deviation: Deviation
    """Deviation of all actions of all chunks."""


@dataclass(frozen=True, kw_only=True)
class GuardComparison:
    """Comparison of all passes of the guard with their repetition on the recorded chunks."""

    steps: int
    flown: int
    """Passes in which the policy moved the sticks."""
    differ: Mapping[str, int]
    """Number of passes with a difference, by phase, chunk, stage of the trace, and sent sticks."""
    first: str | None
    """Description of the first difference."""
    deviation: Deviation
    """Deviation of the smoothed sticks."""


@dataclass(frozen=True, kw_only=True)
class StickTraces:
    """Smoothed sticks, recorded and replayed, [N, 4]; NaN while the policy did not fly."""

    times_s: Array
    """Time since the first tick."""
    recorded: Array
    replayed: Array

    @property
    def deviation(self) -> Deviation:
        """Deviation while both flew."""
        difference = np.abs(self.replayed - self.recorded)
        return deviation_of(difference[~np.isnan(difference).any(axis=1)])

    @property
    def flown_by_one(self) -> int:
        """Number of ticks that only one of the two flew."""
        return int((np.isnan(self.recorded) != np.isnan(self.replayed)).any(axis=1).sum())


def deviation_of(difference: Array) -> Deviation:
    """Return largest and root mean square of absolute differences [N, 4]."""
    if not len(difference):
        return Deviation(largest=(0.0,) * 4, rms=(0.0,) * 4)
    return Deviation(
        largest=tuple(difference.max(axis=0).tolist()),
        rms=tuple(np.sqrt((difference**2).mean(axis=0)).tolist()),
    )


def compare_policy(pairs: Iterable[SolvePair]) -> PolicyComparison:
    """Compare inputs and results of all solves."""
    missing: Counter[str] = Counter()
    inputs: Counter[str] = Counter()
    sentences: dict[object, str] = {}
    """First sentence of each reason; later ones differ only by their figures."""
    differences: list[Array] = []
    solves = equal = 0
    for pair in pairs:
        solves += 1
        if pair.replayed is None:
            reason = pair.refusal or because(Code.NO_CHUNK)
            missing[sentences.setdefault(reason.key, str(reason))] += 1
            continue
        inputs.update(_differing(_inputs(pair.recorded), _inputs(pair.replayed)))
        one, other = pair.recorded.actions, pair.replayed.actions
        if one.shape != other.shape:
            missing[f"its chunk has {other.shape[1]} actions instead of {one.shape[1]}"] += 1
            continue
        equal += one.tobytes() == other.tobytes()
        differences.append(np.abs(one[0].astype(np.float64) - other[0]))
    return PolicyComparison(
        solves=solves,
        missing=dict(missing),
        inputs_differ=dict(inputs),
        equal_chunks=equal,
        deviation=deviation_of(np.concatenate([np.zeros((0, 4)), *differences])),
    )


def losses(compared: PolicyComparison | None, sticks: StickTraces) -> Iterator[str]:
    """Yield what was flown without a counterpart, in words."""
    for name, count in compared.missing.items() if compared else ():
        yield f"{count} solves were not repeated: {name}"
    if count := sticks.flown_by_one:
        yield f"{count} ticks were flown by one of the two alone, and are not compared"


def forgotten(compared: PolicyComparison, *, has_reset: bool) -> Iterator[str]:
    """Yield why the flown policy may have decided differently in its repetition."""
    if compared.equal_chunks == compared.solves:
        return
    if not has_reset:
        yield "the policy has no reset, so what it kept from earlier calls is not repeated"
    if compared.missing:
        yield "a solve without a chunk is not recorded, nor what a policy kept from it"


def _inputs(solve: Solve) -> dict[str, object]:
    """Return the inputs of a solve by name, arrays as bytes."""
    state = solve.state
    return {
        "state": (state.values.tobytes(), state.extras),
        "stamps": (attributes(state, STATE_STAMPS), solve.image_ns),
        "moments": solve.first_ns,
        "states": solve.states.tobytes(),
        "history": solve.history.tobytes(),
        "images": solve.frame_ids,
    }


def _differing(one: Mapping[str, object], other: Mapping[str, object]) -> list[str]:
    return [name for name in one if one[name] != other[name]]


def compare_guard(steps: Sequence[GuardStep]) -> GuardComparison:
    """Compare phases, chunks, the whole trace and the sent sticks of all passes.

    The first pass only reads the settings, and decides nothing.
    """
    differ: Counter[str] = Counter()
    first: str | None = None
    for number, step in enumerate(steps):
        for name in _other_results(step):
            differ[name] += 1
            first = first or f"{name} of tick {number} ({step.recorded.phase})"
    return GuardComparison(
        steps=len(steps),
        flown=sum(step.recorded.trace is not None for step in steps),
        differ=dict(differ),
        first=first,
        deviation=stick_traces(steps, (step.replayed for step in steps)).deviation,
    )


def _other_results(step: GuardStep) -> list[str]:
    one, other = step.recorded, step.replayed
    if other is None:
        is_told = one.trace is not None or one.sent is not None or one.is_slot
        return ["ticks"] if is_told else []
    return _differing(_results(one), _results(other))


def _results(tick: GuardTick) -> dict[str, object]:
    """Return the results of a pass by name, in single precision, that of a recording."""
    stages = {stage: getattr(tick.trace, stage, None) for stage in ActionTrace._fields}
    actions = {
        name: action and np.array(action, np.float32).tolist()
        for name, action in (stages | {"sent": tick.sent}).items()
    }
    return {"phase": tick.phase, "chunk": tick.chunk_serial, **actions}


def stick_traces(steps: Sequence[GuardStep], replayed: Iterable[GuardTick | None]) -> StickTraces:
    """Return the sticks of these ticks, which may be of other chunks or other settings."""
    begin_ns = steps[0].recorded.sent_ns
    return StickTraces(
        times_s=np.array([(step.recorded.sent_ns - begin_ns) / 1e9 for step in steps]),
        recorded=np.array([_smoothed(step.recorded.trace) for step in steps], np.float64),
        replayed=np.array(
            [_smoothed(None if tick is None else tick.trace) for tick in replayed], np.float32
        ).astype(np.float64),
    )


def _smoothed(trace: ActionTrace | None) -> tuple[float, ...]:
    return (np.nan,) * 4 if trace is None else tuple(trace.smoothed)
