"""The least time that inference can take on one thread: its arithmetic, its weights, this machine.

S. Williams, A. Waterman, D. Patterson, "Roofline", CACM 52(4), 2009: attainable time is the larger
of work over peak arithmetic and traffic over bandwidth. Both peaks are measured here, in the same
run as what is compared with them.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from mavbridge.commands.bench.results import Roofline
from mavbridge.core.clock import NS_PER_MS, NS_PER_S, Clock

PRECISIONS = {"f32": torch.float32, "bf16": torch.bfloat16}
MATRIX_SIDE = 1024
"""Large enough that a product is bound by arithmetic: 2 GFLOP over 12 MB."""
LEAST_BUFFER_BYTES = 1 << 20
TRIALS = 5
"""The best counts: a peak is what the machine can do, not what it did beside others."""


@dataclass(frozen=True, kw_only=True)
class Work:
    """What one call computes and reads, whatever the engine."""

    name: str
    flop: int
    weight_uses: int
    """Weights read, each as often as it is used; as numbers, not bytes."""
    distinct_weights: int


def floor_ms(*, flop: float, num_bytes: float, flop_per_s: float, bytes_per_s: float) -> float:
    """The roofline: whichever of arithmetic and traffic takes longer."""
    return 1000 * max(flop / flop_per_s, num_bytes / bytes_per_s)


def count_work(name: str, call: Callable[[], object], modules: dict[nn.Module, int]) -> Work:
    """Count one eager call.

    Args:
        name: of the work, for people.
        call: runs it once.
        modules: the networks that it runs, and how often each.
    """
    with FlopCounterMode(display=False) as counter, torch.no_grad():
        call()
    weights = {module: sum(p.numel() for p in module.parameters()) for module in modules}
    return Work(
        name=name,
        flop=counter.get_total_flops(),
        weight_uses=sum(weights[module] * uses for module, uses in modules.items()),
        distinct_weights=sum(weights.values()),
    )


def roofline(work: Work, precision: str, clock: Clock) -> Roofline:
    """The bound of ``work`` in one precision, by peaks that are measured now."""
    dtype = PRECISIONS[precision]
    flop_per_s = _matmul_flop_per_s(dtype, clock)
    bytes_per_s = _read_bytes_per_s(work.distinct_weights * dtype.itemsize, clock)
    num_bytes = work.weight_uses * dtype.itemsize
    floor = floor_ms(
        flop=work.flop, num_bytes=num_bytes, flop_per_s=flop_per_s, bytes_per_s=bytes_per_s
    )
    return Roofline(
        work=work.name,
        precision=precision,
        gflop=round(work.flop / 1e9, 4),
        weights_mb=round(num_bytes / 1e6, 2),
        gflop_per_s=round(flop_per_s / 1e9, 1),
        gb_per_s=round(bytes_per_s / 1e9, 1),
        floor_ms=round(floor, 3),
    )


def _matmul_flop_per_s(dtype: torch.dtype, clock: Clock) -> float:
    a, b = (torch.ones(MATRIX_SIDE, MATRIX_SIDE, dtype=dtype) for _ in range(2))
    product = torch.empty_like(a)
    flop = 2 * MATRIX_SIDE**3
    return flop / _best_s(lambda: torch.mm(a, b, out=product), clock)


def _read_bytes_per_s(num_bytes: int, clock: Clock) -> float:
    """Reading one buffer over and over: what fits a cache is read as fast as that cache allows."""
    buffer = torch.zeros(max(num_bytes, LEAST_BUFFER_BYTES) // 4, dtype=torch.float32)
    return buffer.nbytes / _best_s(lambda: torch.sum(buffer), clock)


def _best_s(call: Callable[[], object], clock: Clock, *, least_ns: int = 20 * NS_PER_MS) -> float:
    """Shortest mean time of a call over a few trials, each at least ``least_ns`` long."""
    best_s = float("inf")
    for _ in range(TRIALS + 1):  # the first warms up; it is never the best for having done so
        calls, start_ns = 0, clock.now_ns()
        while (elapsed_ns := clock.now_ns() - start_ns) < least_ns or calls == 0:
            call()
            calls += 1
        best_s = min(best_s, elapsed_ns / calls / NS_PER_S)
    return best_s
