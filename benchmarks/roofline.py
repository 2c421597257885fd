"""Lower bound of inference time on one thread, from arithmetic, weights and this machine.

S. Williams, A. Waterman, D. Patterson, "Roofline", CACM 52(4), 2009: attainable time is the larger
of work over peak arithmetic and traffic over bandwidth. Both peaks are measured in the same run as
the figures compared with them.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.baseline import eager_toge
from benchmarks.engines import CHUNK, ENCODE
from benchmarks.results import EngineTiming
from mavbridge.config.policy import PolicyConfig
from mavbridge.core.clock import NS_PER_MS, NS_PER_S, MonotonicClock
from policy.engines.openvino_compile import precisions

DTYPES = {"f32": torch.float32, "bf16": torch.bfloat16}
MATRIX_SIDE = 1024
"""Side large enough that a product is bound by arithmetic: 2 GFLOP over 12 MB."""
LEAST_BUFFER_BYTES = 1 << 20
TRIALS, TRIAL_NS = 5, 20 * NS_PER_MS
"""Trials and their minimum length. The best counts: a peak excludes other load."""


@dataclass(frozen=True, kw_only=True)
class Work:
    """Arithmetic and reads of one call, on any engine."""

    flop: int
    weight_uses: int
    """Number of weights read, counted once per use; not bytes."""
    distinct_weights: int


def time_rooflines(policies: Sequence[PolicyConfig]) -> tuple[EngineTiming, ...]:
    """Return the bound of every TOGE's work, in each precision of this processor."""
    torch.set_num_threads(1)
    usable = {precision for pair in precisions() for precision in pair}
    return tuple(
        EngineTiming(
            policy=policy.policy,
            work=name,
            engine=f"roofline {precision}",
            p50_ms=(floor := round(floor_ms(work, DTYPES[precision]), 3)),
            p99_ms=floor,
        )
        for policy in policies
        for name, work in works_of(policy)
        for precision in DTYPES
        if precision in usable
    )


def works_of(policy: PolicyConfig) -> Iterator[tuple[str, Work]]:
    """Return the work of encoding an image, and of a full solve: one condition, the U-Net per
    step."""
    net, steps = eager_toge(policy), policy.steps
    contract = net.contract
    image = torch.zeros(1, 3, contract.image_height, contract.image_width)
    yield (
        ENCODE,
        count_work(lambda: net.encode_visual(image), {net.backbone: 1, net.visual_projection: 1}),
    )
    feature = torch.zeros(1, contract.feature_dim)
    state = torch.zeros(1, contract.state_dim)
    history = torch.zeros(1, *contract.history_shape)
    uses = {net.state_encoder: 1, net.history_encoder: 1, net.fusion: 1, net.head: steps}
    yield CHUNK, count_work(lambda: net.predict_fast(feature, state, history, steps), uses)


def count_work(call: Callable[[], object], uses: dict[nn.Module, int]) -> Work:
    """Count one eager call; ``uses`` is the number of runs of each of its networks."""
    with FlopCounterMode(display=False) as counter, torch.no_grad():
        call()
    weights = {module: sum(p.numel() for p in module.parameters()) for module in uses}
    return Work(
        flop=counter.get_total_flops(),
        weight_uses=sum(weights[module] * count for module, count in uses.items()),
        distinct_weights=sum(weights.values()),
    )


def floor_ms(work: Work, dtype: torch.dtype) -> float:
    """Return the roofline of ``work``, by peaks measured now."""
    a, b = (torch.ones(MATRIX_SIDE, MATRIX_SIDE, dtype=dtype) for _ in range(2))
    product = torch.empty_like(a)
    flop_per_s = 2 * MATRIX_SIDE**3 / best_s(lambda: torch.mm(a, b, out=product))
    # One buffer, read again and again: data that fits a cache is read at that cache's speed.
    num_bytes = max(work.distinct_weights * dtype.itemsize, LEAST_BUFFER_BYTES)
    buffer = torch.zeros(num_bytes // 4, dtype=torch.float32)
    bytes_per_s = buffer.nbytes / best_s(lambda: torch.sum(buffer))
    return 1000 * max(work.flop / flop_per_s, work.weight_uses * dtype.itemsize / bytes_per_s)


def best_s(call: Callable[[], object]) -> float:
    """Return the shortest mean time of a call over a few trials of at least ``TRIAL_NS`` each."""
    clock, best_s = MonotonicClock(), float("inf")
    call()
    for _ in range(TRIALS):
        calls, start_ns = 0, clock.now_ns()
        while (elapsed_ns := clock.now_ns() - start_ns) < TRIAL_NS or calls == 0:
            call()
            calls += 1
        best_s = min(best_s, elapsed_ns / calls / NS_PER_S)
    return best_s
