"""Timing of one encoded image and one sampled chunk per engine, in one thread, without other
load."""

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace

import torch

from benchmarks.results import EngineTiming, name_of
from mavbridge.commands.output import print_status
from mavbridge.config.policy import Engine, PolicyConfig
from mavbridge.core.clock import NS_PER_S, MonotonicClock
from mavbridge.core.histogram import Histogram
from mavbridge.flight.policies import load_configured_policy
from policy.engines.runner import dummy_sample, encode_all
from policy.errors import PolicyError
from policy.protocol import PolicyRunner

EAGER: Engine = "torch"
ENCODE, CHUNK, BOTH = "encode one image", "sample one chunk", "one image to one chunk"


@dataclass(frozen=True, kw_only=True)
class _Case:
    policy: str
    work: str
    engine: str
    call: Callable[[], object]
    durations: Histogram = field(default_factory=Histogram)


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
    cases, notes = [], []
    with ExitStack() as lives:
        for policy in policies:
            found, remarks = _cases(policy, lives)
            cases += found
            notes += remarks
        for number in range(rounds):
            print_status(f"engines, round {number + 1} of {rounds}")
            for case in cases:
                _time(case, block_s)
    return tuple(map(_timing, cases)), tuple(notes)


def _cases(policy: PolicyConfig, lives: ExitStack) -> tuple[list[_Case], list[str]]:
    devices = (policy.device, policy.vision_device or "", policy.action_device or "")
    fast: Engine = "cuda-graph" if any(name.startswith("cuda") for name in devices) else "openvino"
    engines: tuple[Engine, ...] = (EAGER, fast) if policy.engine == "auto" else (policy.engine,)
    cases: list[_Case] = []
    notes = []
    for engine in engines:
        try:
            cases += _cases_on(replace(policy, engine=engine), lives)
        except PolicyError as error:
            notes.append(f"{name_of(policy)} on {engine}: not measured: {error}")
    if cases:
        return cases, notes
    return _cases_on(
        policy, lives
    ), []  # numpy policies run on "auto" only and are refused elsewhere


def _cases_on(policy: PolicyConfig, lives: ExitStack) -> list[_Case]:
    runner = _load(policy, lives)
    contract = runner.contract
    images, state, history = dummy_sample(contract)
    image = images.reshape(-1, *contract.picture_shape)[0]
    feature = encode_all(runner, images)
    engine = runner.engine if policy.engine == "auto" else policy.engine

    def case(work: str, call: Callable[[], object]) -> _Case:
        return _Case(policy=name_of(policy), work=work, engine=engine, call=call)

    if not runner.dual_rate:
        return [case(BOTH, lambda: runner.act(encode_all(runner, images), state, history))]
    return [
        case(ENCODE, lambda: runner.encode(image)),
        case(CHUNK, lambda: runner.act(feature, state, history)),
    ]


def _load(policy: PolicyConfig, lives: ExitStack) -> PolicyRunner:
    loaded = lives.enter_context(load_configured_policy(policy, MonotonicClock()))
    if policy.engine != "auto" and not loaded.runner.engine.startswith(policy.engine):
        raise PolicyError("; ".join(loaded.notes))  # reason why the engine was not used
    return loaded.runner


def _time(case: _Case, block_s: float) -> None:
    clock = MonotonicClock()
    case.call()  # warms the caches that other cases have evicted
    end_ns = clock.now_ns() + round(block_s * NS_PER_S)
    while True:
        start_ns = clock.now_ns()
        case.call()
        case.durations.add(clock.now_ns() - start_ns)
        if clock.now_ns() >= end_ns:
            return


def _timing(case: _Case) -> EngineTiming:
    percentiles = case.durations.percentiles_ms()
    if percentiles is None:
        raise ValueError(f"{case.work} was never timed")
    return EngineTiming(
        policy=case.policy,
        work=case.work,
        engine=case.engine,
        p50_ms=percentiles.p50,
        p99_ms=percentiles.p99,
    )
