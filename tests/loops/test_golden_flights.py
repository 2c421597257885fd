"""Golden flights: recorded once, reproduced by every later version of the code.

If one of these tests fails, the flight or the guard now does something else with the same bytes,
features and moments. Where that is meant, record the flight anew (tests/data/flights/README.md).
"""

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from helpers.golden_flights import FLIGHTS, NAMES, golden, through_gate
from mavbridge.commands.config import ReplayConfig
from mavbridge.commands.replay import CLOCK_TOLERANCE, ENGINE_TOLERANCE, replay
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.errors import ExitCode
from mavbridge.core.reasons import Code, because
from mavbridge.core.records import Solve
from mavbridge.flight.history import ActionFrame
from mavbridge.flight.policies import load_configured_policy
from mavbridge.flight.policy_loop import chunk_of
from mavbridge.simulation.clock import SteppedClock
from mavbridge.simulation.replay.compare import (
    PolicyComparison,
    compare_guard,
    compare_policy,
    stick_traces,
)
from mavbridge.simulation.replay.guard import (
    recorded_plan,
    replay_guard,
    replay_other,
)
from mavbridge.simulation.replay.policy import replay_policy
from mavbridge.simulation.replay.recording import ReplaySource
from policy.protocol import PolicyRunner

NUMPY = f"{FLIGHTS / 'numpy_policy.py'}:NumpyPolicy"


def stepped_clock(source: ReplaySource) -> SteppedClock:
    return SteppedClock(source.solves[0].started_ns - NS_PER_S)


def test_a_recording_names_no_path_of_the_machine_that_made_it() -> None:
    for path in FLIGHTS.rglob("*.json"):
        assert '"/' not in path.read_text(), f"record {path.parent} in the clone"


@pytest.fixture
def numpy_runner() -> Iterator[PolicyRunner]:
    """The policy as a flight loads it."""
    source = golden("numpy_px4")
    wanted = replace(source.config.policy, policy=NUMPY)
    with load_configured_policy(wanted, stepped_clock(source)) as loaded:
        yield loaded.runner


@pytest.mark.parametrize(
    ("name", "phase", "is_flown"),
    [
        ("numpy_px4", "flying", True),
        ("numpy_px4", "leaving", False),
        ("scripted_velocity_ardupilot", "leaving", False),
    ],
)
def test_an_action_that_was_refused_in_flight_is_refused_in_the_replay(
    name: str, phase: str, *, is_flown: bool
) -> None:
    source = golden(name)
    at = [k for k, tick in enumerate(source.ticks) if tick.phase == phase and tick.sent][2]
    refused = replace(source.ticks[at], sent=None)
    ticks = (*source.ticks[:at], refused, *source.ticks[at + 1 :])
    replayed = replay_guard(replace(source, ticks=ticks))[at].replayed
    assert replayed is not None
    assert (replayed.trace is not None, replayed.sent) == (is_flown, None)


def repeated(source: ReplaySource, runner: PolicyRunner) -> PolicyComparison:
    clock = stepped_clock(source)
    return compare_policy(replay_policy(source, runner, clock, source.features))


@pytest.mark.parametrize(
    ("name", "config"),
    [
        ("numpy_px4", ReplayConfig(policy=NUMPY, source="features", tolerance=0.0)),
        # Bits of its chunks depend on the processor.
        ("toge_ardupilot", ReplayConfig(tolerance=ENGINE_TOLERANCE)),
        # It looks at the clock, which differs by some 0.1 ms.
        ("scripted_velocity_ardupilot", ReplayConfig(tolerance=CLOCK_TOLERANCE)),
    ],
)
def test_guard_and_policy_do_again_what_they_did(
    name: str, config: ReplayConfig, tmp_path: Path
) -> None:
    written = tmp_path / "replay.json"
    assert replay(FLIGHTS / name, replace(config, json=written)) == ExitCode.DONE
    told = json.loads(written.read_text())
    assert (told["gaps"], told["guard"]["differ"]) == ([], {})
    assert told["guard"]["flown"] > 100
    assert told["policy"]["solves"] > 100
    assert (told["policy"]["missing"], told["policy"]["inputs_differ"]) == ({}, {})


@pytest.mark.parametrize("name", NAMES)
def test_other_chunks_go_the_same_way_as_the_recorded_ones(name: str) -> None:
    source, steps = golden(name), through_gate(name)
    frame = ActionFrame(source.contract)
    chunks = {solve.serial: chunk_of(solve, frame) for solve in source.solves}

    traces = stick_traces(steps, replay_other(steps, recorded_plan(source).guard, chunks))

    assert traces.deviation.most == 0


def with_solve(source: ReplaySource, change: Callable[[Solve], Solve]) -> ReplaySource:
    middle = len(source.solves) // 2
    solves = list(source.solves)
    solves[middle] = change(solves[middle])
    return replace(source, solves=tuple(solves))


@pytest.mark.parametrize("name", NAMES)
def test_the_first_chunk_that_flies_was_still_on_its_way_at_the_tick_before(name: str) -> None:
    """The end of its solve is recorded, not its arrival at the guard."""
    source = golden(name)
    first = next(k for k, tick in enumerate(source.ticks) if tick.chunk_serial is not None)
    before, serial = source.ticks[first - 1], source.ticks[first].chunk_serial
    solves = [
        replace(each, computed_ns=before.woke_ns - 50_000) if each.serial == serial else each
        for each in source.solves
    ]
    compared = compare_guard(replay_guard(replace(source, solves=tuple(solves))))
    assert compared.first is None


def test_keys_of_a_flight_with_arm_are_told_by_its_phases() -> None:
    source, phases = golden("toge_ardupilot"), ("flying", "released", "flying")
    waits = {"phase": "waiting", "release_reason": because(Code.NOT_ENGAGED)}
    middle = len(source.ticks) // 2
    ticks = [replace(tick, **waits) for tick in source.ticks[:2]]  # type: ignore[arg-type]
    pairs = zip(source.ticks[middle:], phases, strict=False)
    ticks += [replace(tick, phase=phase) for tick, phase in pairs]
    config = replace(source.config, arm=True)
    steps = replay_guard(replace(source, config=config, ticks=tuple(ticks)))
    acts = [next((given.act for _, given in step.given if given.act), None) for step in steps]
    assert acts == [None, "release", "engage", None, "engage"]


def test_one_bit_of_one_history_is_noticed(
    numpy_runner: PolicyRunner,
) -> None:
    def change(solve: Solve) -> Solve:
        history = solve.history.copy()
        history[0, -1, 0] = np.nextafter(history[0, -1, 0], np.float32(1))
        return replace(solve, history=history)

    compared = repeated(with_solve(golden("numpy_px4"), change), numpy_runner)

    assert compared.inputs_differ == {"history": 1}
    assert compared.equal_chunks == compared.solves


def test_a_feature_that_was_lost_is_told_and_the_rest_repeated(
    numpy_runner: PolicyRunner,
) -> None:
    source = golden("numpy_px4")
    (features,) = source.features
    lost = features[len(features) // 2]
    without = tuple(each for each in features if each is not lost)

    compared = repeated(replace(source, features=(without,)), numpy_runner)

    reason = because(Code.NOT_RECORDED, what="its image, or the feature of it")
    assert compared.missing[str(reason)] > 0
    assert compared.solves - sum(compared.missing.values()) > 100
