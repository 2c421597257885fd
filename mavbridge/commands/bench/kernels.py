"""One encode and one chunk on every engine, one thread, nothing beside them; and their rooflines.

Repeats go round all engines in turn, so that a slow minute of the host is everybody's.
"""

from collections.abc import Callable
from dataclasses import dataclass
from statistics import median

import numpy as np
import torch
from torch import nn

from mavbridge.commands.bench import engines
from mavbridge.commands.bench.results import Kernel, Roofline
from mavbridge.commands.bench.roofline import PRECISIONS, Work, count_work, roofline
from mavbridge.core.clock import NS_PER_S, Clock
from mavbridge.core.histogram import Histogram
from mavbridge.core.records import Percentiles
from policy.contract import ACTION_DIM, Executable
from policy.engines.executable import EngineName
from policy.engines.openvino_cpu import precisions
from policy.nets.toge import Toge, TogeConfig

ENCODE = "encode one image (EfficientNet-B3)"
ENCODE_SHIPPED = "encode one image (ResNet-8)"
WARM_ELAPSED_S = 0.01
"""Between two chunks at 100 Hz."""
SAMPLE = {
    "toge:small": "sample one chunk (TOGE small)",
    "toge:medium": "sample one chunk (TOGE medium)",
}


@dataclass(frozen=True, kw_only=True)
class Effort:
    """How long to measure."""

    repeats: int
    block_s: float
    """Of each piece of work on each engine, in each repeat."""


@dataclass(frozen=True, kw_only=True)
class _Case:
    work: str
    engine: EngineName
    call: Callable[[], object]


def measure(effort: Effort, clock: Clock, say: Callable[[str], None]) -> tuple[Kernel, ...]:
    """Every piece of work on every engine."""
    torch.set_num_threads(1)
    cases = [case for engine in engines.ENGINES for case in _cases(engine)]
    blocks: list[list[Percentiles]] = [[] for _ in cases]
    for repeat in range(effort.repeats):
        say(f"kernels, repeat {repeat + 1} of {effort.repeats}")
        for case, found in zip(cases, blocks, strict=True):
            found.append(_block(case.call, effort.block_s, clock))
    return tuple(
        Kernel(
            work=case.work,
            engine=case.engine,
            p50_ms=round(median(block.p50 for block in found), 3),
            p99_ms=round(median(block.p99 for block in found), 3),
        )
        for case, found in zip(cases, blocks, strict=True)
    )


def rooflines(clock: Clock) -> tuple[Roofline, ...]:
    """The bound of every piece of work in every precision that this processor computes in."""
    torch.set_num_threads(1)
    usable = {precision for pair in precisions() for precision in pair}
    return tuple(
        roofline(work, precision, clock)
        for work in _all_work()
        for precision in PRECISIONS
        if precision in usable
    )


def _cases(engine: EngineName) -> list[_Case]:
    cases: list[_Case] = []
    for policy, work in SAMPLE.items():
        executable = engines.load(policy, engine)
        if not cases:  # the image path is the same network for every size of the action path
            cases.append(_Case(work=ENCODE, engine=engine, call=_encode_call(executable)))
        cases.append(_Case(work=work, engine=engine, call=_act_call(executable, None)))
        warm = engines.load(policy, engine, head_steps=engines.WARM_STEPS)
        name = f"{work}, warm start of {engines.WARM_STEPS} steps"
        cases.append(_Case(work=name, engine=engine, call=_act_call(warm, WARM_ELAPSED_S)))
    encode = _encode_call(engines.load(engines.SHIPPED_POLICY, engine))
    cases.append(_Case(work=ENCODE_SHIPPED, engine=engine, call=encode))
    return cases


def _encode_call(executable: Executable) -> Callable[[], object]:
    height, width = executable.contract.image_height, executable.contract.image_width
    rgb = np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)
    return lambda: executable.encode(rgb)


def _act_call(executable: Executable, elapsed_s: float | None) -> Callable[[], object]:
    contract = executable.contract
    feature = executable.encode(np.zeros((64, 64, 3), np.uint8))
    state = np.zeros((1, contract.state_dim), np.float32)
    state[0, 3] = 1.0  # level
    history = np.zeros((1, contract.history_len, ACTION_DIM), np.float32)
    executable.act(feature, state, history, None)  # a warm start needs a chunk to start from
    return lambda: executable.act(feature, state, history, elapsed_s)


def _block(call: Callable[[], object], block_s: float, clock: Clock) -> Percentiles:
    durations = Histogram()
    call()
    end_ns = clock.now_ns() + round(block_s * NS_PER_S)
    while durations.count == 0 or clock.now_ns() < end_ns:
        start_ns = clock.now_ns()
        call()
        durations.add(clock.now_ns() - start_ns)
    percentiles = durations.percentiles_ms()
    if percentiles is None:
        raise RuntimeError("a block of calls holds at least one")
    return percentiles


def _all_work() -> list[Work]:
    nets = {
        policy: engines.eager_toge(TogeConfig(size="small" if policy == "toge:small" else "medium"))
        for policy in SAMPLE
    }
    return [
        _encode_work(ENCODE, nets["toge:small"]),
        *[_sample_work(name, nets[policy]) for policy, name in SAMPLE.items()],
        _encode_work(ENCODE_SHIPPED, engines.shipped_toge()),
    ]


def _encode_work(name: str, net: Toge) -> Work:
    image = torch.zeros(1, 3, net.contract.image_height, net.contract.image_width)
    modules: dict[nn.Module, int] = {net.backbone: 1, net.visual_projection: 1}
    return count_work(name, lambda: net.encode_visual(image), modules)


def _sample_work(name: str, net: Toge) -> Work:
    """The condition once, the U-Net once a step; a full solve, which warm starts may undercut."""
    contract = net.contract
    feature = torch.zeros(1, contract.feature_dim)
    state = torch.zeros(1, contract.state_dim)
    history = torch.zeros(1, contract.history_len, ACTION_DIM)
    once: dict[nn.Module, int] = {net.state_encoder: 1, net.history_encoder: 1, net.fusion: 1}
    return count_work(
        name,
        lambda: net.predict_fast(feature, state, history, engines.STEPS),
        once | {net.head: engines.STEPS},
    )
