from benchmarks.flight import SLOW_EVERY, SLOW_NS, with_slow_solves
from mavbridge.core.clock import MonotonicClock
from policy.contract import Contract
from policy.protocol import PolicyRunner


def test_every_tenth_solve_is_slow_and_all_are_the_policys() -> None:
    runner = PolicyRunner(
        contract=Contract(),
        name="a",
        engine="b",
        dual_rate=True,
        encode=lambda rgb: rgb,
        act=lambda *arguments: arguments[0],
    )
    slow, clock, durations_ns = with_slow_solves(runner), MonotonicClock(), []
    for number in range(2 * SLOW_EVERY):
        start_ns = clock.now_ns()
        assert slow.act(number, None, None) == number
        durations_ns.append(clock.now_ns() - start_ns)
    assert min(durations_ns[SLOW_EVERY - 1 :: SLOW_EVERY]) >= SLOW_NS
