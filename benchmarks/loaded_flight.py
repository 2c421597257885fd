"""One measured flight whose process is kept busy: ``python -m benchmarks.loaded_flight``.

It takes the flags of ``benchmarks.flight`` and ``--load``:

    none   nothing beside the flight
    slow   every tenth solve takes 30 ms longer
    busy   beside the flight a thread runs eager torch, and another one never leaves the interpreter
"""

import threading
from contextlib import ExitStack
from dataclasses import replace
from typing import Literal, TypeAlias

import torch
from cyclopts import App

from benchmarks.flight import FlightJob, measure_flight
from mavbridge.core.clock import NS_PER_MS, MonotonicClock
from mavbridge.core.workers import Worker
from policy.contract import FloatArray
from policy.protocol import PolicyRunner

Load: TypeAlias = Literal["none", "slow", "busy"]
SLOW_EVERY = 10
SLOW_NS = 30 * NS_PER_MS
TORCH_BATCH, TORCH_CHANNELS, TORCH_SIDE = 1, 32, 48
"""A small convolution of some 1 ms: many calls a second, each of which takes the interpreter."""
JOIN_S = 5.0
app = App(help=__doc__)


@app.default
def main(job: FlightJob, *, load: Load = "none") -> None:
    """Fly once and write the figures."""
    busy = (Worker("load-torch", run_torch), Worker("load-interpreter", hog_interpreter))
    with ExitStack() as stack:
        for worker in busy if load == "busy" else ():
            worker.start()
            stack.callback(worker.join, JOIN_S)
        measure_flight(job, with_slow_solves if load == "slow" else lambda runner: runner)


@torch.no_grad()
def run_torch(stop: threading.Event) -> None:
    """Eager convolutions, one after the other."""
    torch.set_num_threads(1)
    layer = torch.nn.Conv2d(TORCH_CHANNELS, TORCH_CHANNELS, 3)
    values = torch.zeros(TORCH_BATCH, TORCH_CHANNELS, TORCH_SIDE, TORCH_SIDE)
    while not stop.is_set():
        layer(values).relu()


def hog_interpreter(stop: threading.Event) -> None:
    """Bytecode alone: others run when the interpreter takes its lock away."""
    while not stop.is_set():
        pass


def with_slow_solves(runner: PolicyRunner) -> PolicyRunner:
    """A runner whose every tenth solve computes for 30 ms more."""
    clock, solves = MonotonicClock(), 0

    def act(encoded: FloatArray, state: FloatArray, history: FloatArray) -> FloatArray:
        nonlocal solves
        solves += 1
        end_ns = clock.now_ns() + (0 if solves % SLOW_EVERY else SLOW_NS)
        while clock.now_ns() < end_ns:
            pass
        return runner.act(encoded, state, history)

    return replace(runner, act=act)


if __name__ == "__main__":
    app()
