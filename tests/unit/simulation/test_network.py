from collections.abc import Iterator

from hypothesis import given
from hypothesis import strategies as st

from mavbridge.simulation.clock import SteppedClock
from mavbridge.simulation.network import DelayedChannel, MemoryTransport


def network(
    clock: SteppedClock, *delays_ns: int
) -> tuple[MemoryTransport, DelayedChannel, DelayedChannel]:
    def draws() -> Iterator[int]:
        while True:
            yield from delays_ns

    up, down = DelayedChannel(clock, draws()), DelayedChannel(clock, draws())
    return MemoryTransport(clock, to_vehicle=up, from_vehicle=down), up, down


@given(st.lists(st.integers(0, 50), min_size=1, max_size=20))
def test_no_datagram_overtakes_another(delays_ns: list[int]) -> None:
    clock = SteppedClock(0)
    _, up, _ = network(clock, *delays_ns)
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


def test_waiting_ends_with_the_arrival_of_what_is_sent_meanwhile() -> None:
    clock = SteppedClock(0)
    transport, _, down = network(clock, 30)
    clock.schedule(100, lambda: down.send(b"attitude"))
    transport.wait(500)
    assert clock.now_ns() == 130
    assert [chunk.arrived_ns for chunk in transport.drain()] == [130]
    transport.wait(500)
    assert clock.now_ns() == 500
