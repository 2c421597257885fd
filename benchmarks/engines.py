"""Timing of one encoded image and one sampled chunk per engine, in one thread, without other
load."""

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from typing import NamedTuple

import torch

from benchmarks.results import EngineTiming, name_of
from mavbridge.commands.output import print_status
from mavbridge.config.policy import Engine, PolicyConfig
from mavbridge.core.clock import NS_PER_S, MonotonicClock
from mavbridge.core.histogram import Histogram
from mavbridge.flight.policies import load_configured_policy
from policy.engines.runner import dummy_sample, encode_all
from policy.errors import PolicyError

EAGER: Engine = "torch"
ENCODE, CHUNK, BOTH = "encode one image", "sample one chunk", "one image to one chunk"


class _Case(NamedTuple):
    policy: str
    work: str
    engine: str
    call: Callable[[], object]
    durations: Histogram


def time_engines(
    policies: Sequence[PolicyConfig], *, rounds: int, block_s: float
) -> tuple[tuple[EngineTiming, ...], tuple[str, ...]]:
    """Time each policy on its engine, or with ``auto`` on all engines of this device.

    Return the timings, and notes on failures. Each round times every case for ``block_s``, so that
    a slow minute of the host affects all engines.

    Raises:
        PolicyError: a policy cannot be loaded on any engine.
    """
    torch.set_num_threads(1)
    clock = MonotonicClock()
    cases: list[_Case] = []
    notes: list[str] = []
    with ExitStack() as lives:
        for policy in policies:
            cases += _cases(policy, lives, notes)
        for number in range(rounds):
            print_status(f"engines, round {number + 1} of {rounds}")
            for case in cases:
                case.call()  # warms the caches that other cases have evicted
                end_ns = clock.now_ns() + round(block_s * NS_PER_S)
                while (start_ns := clock.now_ns()) < end_ns or not case.durations.count:
                    case.call()
                    case.durations.add(clock.now_ns() - start_ns)
    return tuple(map(_timing, cases)), tuple(notes)


def _cases(policy: PolicyConfig, lives: ExitStack, notes: list[str]) -> list[_Case]:
    devices = (policy.device, policy.vision_device or "", policy.action_device or "")
    fast: Engine = "cuda-graph" if any(name.startswith("cuda") for name in devices) else "openvino"
    engines: tuple[Engine, ...] = (EAGER, fast) if policy.engine == "auto" else (policy.engine,)
    cases: list[_Case] = []
    failures = []
    for engine in engines:
        try:
            cases += _cases_on(replace(policy, engine=engine), lives)
        except PolicyError as error:
            failures.append(f"{name_of(policy)} on {engine}: not measured: {error}")
    if not cases:  # numpy policies run on "auto" only and are refused elsewhere
        return _cases_on(policy, lives)
    notes += failures
    return cases


def _cases_on(policy: PolicyConfig, lives: ExitStack) -> list[_Case]:
    loaded = lives.enter_context(load_configured_policy(policy, MonotonicClock()))
    runner = loaded.runner
    if policy.engine != "auto" and not runner.engine.startswith(policy.engine):
        raise PolicyError("; ".join(loaded.notes))  # reason why the engine was not used
    contract = runner.contract
    images, state, history = dummy_sample(contract)
    image = images.reshape(-1, *contract.picture_shape)[0]
    feature = encode_all(runner, images)
    works: dict[str, Callable[[], object]] = {
        ENCODE: lambda: runner.encode(image),
        CHUNK: lambda: runner.act(feature, state, history),
    }
    if not runner.dual_rate:
        works = {BOTH: lambda: runner.act(encode_all(runner, images), state, history)}
    engine = runner.engine if policy.engine == "auto" else policy.engine
    name = name_of(policy)
    return [_Case(name, work, engine, call, Histogram()) for work, call in works.items()]


def _timing(case: _Case) -> EngineTiming:
    percentiles = case.durations.percentiles_ms()
    assert percentiles is not None  # each block times one call at least
    return EngineTiming(
        policy=case.policy,
        work=case.work,
        engine=case.engine,
        p50_ms=percentiles.p50,
        p99_ms=percentiles.p99,
    )
