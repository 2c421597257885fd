from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavbridge.core.clock import NS_PER_MS
from mavbridge.observe.attribution import CAUSES, Cause, Counters, Lateness, attribute

ZERO = Counters(stolen_ns=0, runnable_ns=0, gc_ns=0)
UNKNOWN = Counters(stolen_ns=None, runnable_ns=None, gc_ns=0)


def after(**grown_ms: int) -> Counters:
    return Counters(
        **{"stolen_ns": 0, "runnable_ns": 0, "gc_ns": 0}
        | {f"{name}_ns": value * NS_PER_MS for name, value in grown_ms.items()}
    )


def blame(
    counters: Counters = ZERO, *, work_ms: int = 2, predict_ms: int = 1, before: Counters = ZERO
) -> Cause:
    return attribute(
        Lateness(
            overrun_ns=40 * NS_PER_MS,
            work_ns=work_ms * NS_PER_MS,
            predict_ns=predict_ms * NS_PER_MS,
            period_ns=10 * NS_PER_MS,
            before=before,
            after=counters,
        )
    )


@pytest.mark.parametrize(
    ("counters", "ticks", "cause"),
    [
        (after(stolen=20), {}, "host"),
        (after(stolen=30, runnable=40), {"work_ms": 50, "predict_ms": 48}, "host"),
        (after(stolen=10, runnable=25), {}, "kernel"),
        (after(runnable=10, gc=35), {}, "gc"),
        (after(gc=19), {}, "lock"),
        (ZERO, {"work_ms": 50, "predict_ms": 48}, "inference"),
        (after(stolen=10), {"work_ms": 50, "predict_ms": 48}, "inference"),
        (ZERO, {"work_ms": 50, "predict_ms": 2}, "loop"),
        (ZERO, {"work_ms": 9}, "lock"),
    ],
)
def test_blames_the_outermost_that_explains_half(
    counters: Counters, ticks: dict[str, Any], cause: Cause
) -> None:
    assert blame(counters, **ticks) == cause


def test_what_is_not_counted_here_takes_no_blame() -> None:
    assert blame(UNKNOWN, before=UNKNOWN, work_ms=50, predict_ms=48) == "inference"


counters = st.builds(
    Counters,
    stolen_ns=st.none() | st.integers(0, 10**9),
    runnable_ns=st.none() | st.integers(0, 10**9),
    gc_ns=st.integers(0, 10**9),
)


@given(
    st.builds(
        Lateness,
        overrun_ns=st.integers(1, 10**9),
        work_ns=st.integers(0, 10**9),
        predict_ns=st.integers(0, 10**9),
        period_ns=st.integers(1, 10**8),
        before=counters,
        after=counters,
    )
)
def test_every_missed_slot_has_a_cause(lateness: Lateness) -> None:
    assert attribute(lateness) in CAUSES
