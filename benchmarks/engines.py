"""Timing of one encoded image and one sampled chunk per engine, in one thread, without other
load."""

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass

import torch
from rich.table import Table

from mavbridge.commands.output import make_table, print_status
from mavbridge.config.policy import Engine, PolicyConfig
from mavbridge.core.clock import NS_PER_S, MonotonicClock
from mavbridge.core.histogram import Histogram
from mavbridge.flight.policies import load_configured_policy
from policy.engines.runner import dummy_sample, encode_all
from policy.errors import PolicyError

EAGER: Engine = "torch"
FAST: Engine = "openvino"
ENCODE, CHUNK = "encode one image", "sample one chunk"


@dataclass(frozen=True, kw_only=True)
class EngineTiming:
    """Time of one piece of inference on one engine and one thread."""

    policy: str
    work: str
    engine: str
    p50_ms: float
    p99_ms: float


def time_engines(
    policies: Sequence[PolicyConfig], *, rounds: int, block_s: float
) -> tuple[EngineTiming, ...]:
    """Time each two-rate policy on its engine.

    Each round times every case for ``block_s``, so that a slow minute of the host affects all.

    Raises:
        PolicyError: a policy cannot be loaded on its engine.
    """
    torch.set_num_threads(1)
    clock = MonotonicClock()
    took: defaultdict[tuple[str, str, str], Histogram] = defaultdict(Histogram)
    with ExitStack() as lives:
        cases = [
            (took[policy.policy, work, policy.engine], call)
            for policy in policies
            for work, call in _works(policy, lives)
        ]
        for number in range(rounds):
            print_status(f"engines, round {number + 1} of {rounds}")
            for durations, call in cases:
                call()  # warms the caches that other cases have evicted
                end_ns = clock.now_ns() + round(block_s * NS_PER_S)
                while (start_ns := clock.now_ns()) < end_ns or not durations.count:
                    call()
                    durations.add(clock.now_ns() - start_ns)
    return tuple(_timing(*case, durations) for case, durations in took.items())


def _works(policy: PolicyConfig, lives: ExitStack) -> Iterator[tuple[str, Callable[[], object]]]:
    loaded = lives.enter_context(load_configured_policy(policy, MonotonicClock()))
    runner = loaded.runner
    if not runner.engine.startswith(policy.engine):
        raise PolicyError("; ".join(loaded.notes))  # reason why the engine was not used
    images, state, history = dummy_sample(runner.contract)
    image = images.reshape(-1, *runner.contract.picture_shape)[0]
    feature = encode_all(runner, images)
    yield ENCODE, lambda: runner.encode(image)
    yield CHUNK, lambda: runner.act(feature, state, history)


def _timing(policy: str, work: str, engine: str, durations: Histogram) -> EngineTiming:
    took = durations.percentiles_ms()
    assert took is not None  # each block times one call at least
    return EngineTiming(policy=policy, work=work, engine=engine, p50_ms=took.p50, p99_ms=took.p99)


def engine_table(timings: Iterable[EngineTiming]) -> Table:
    """Return a table with a row for each piece of work on each engine."""
    rows = [
        (one.policy, one.work, one.engine, f"{one.p50_ms:.2f} / {one.p99_ms:.2f}")
        for one in timings
    ]
    title = "Inference on one thread, ms (p50 / p99)"
    return make_table(title, ("policy", "work", "engine", "time"), rows, left_columns=3)
