from itertools import cycle

from hypothesis import given
from hypothesis import strategies as st

from mavbridge.simulation.clock import SteppedClock
from mavbridge.simulation.network import DelayedChannel


@given(st.lists(st.integers(0, 50), min_size=1, max_size=20))
def test_no_datagram_overtakes_another(delays_ns: list[int]) -> None:
    clock = SteppedClock(0)
    up = DelayedChannel(clock, cycle(delays_ns))
    for number in range(len(delays_ns)):
        up.send(bytes([number]))
        clock.sleep_until_ns(clock.now_ns() + 1)
    clock.sleep_until_ns(10_000)
    arrived = list(up.receive())
    assert [data[0] for _, data in arrived] == list(range(len(delays_ns)))
    assert [stamp for stamp, _ in arrived] == sorted(stamp for stamp, _ in arrived)
    assert all(
        stamp >= sent_ns + delay_ns
        for sent_ns, (delay_ns, (stamp, _)) in enumerate(zip(delays_ns, arrived, strict=True))
    )
