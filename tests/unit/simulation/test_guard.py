"""Guard and policy loop as events of simulated time."""

from itertools import repeat
from typing import Any

from helpers.fakes import START_NS
from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.reasons import Code, because
from mavbridge.guard.wire import GuardMessage, NoChunk, decode_to_guard, encode_from_guard
from mavbridge.simulation.clock import AheadClock, SteppedClock
from mavbridge.simulation.guard import GuardStepper, MemoryPort, PolicyStepper, sender
from mavbridge.simulation.network import DelayedChannel

MS = NS_PER_MS


class FakeGuard:
    """A guard loop on a grid of 10 ms that notes when it is stepped."""

    def __init__(self, world: SteppedClock) -> None:
        self._world = world
        self.is_done = False
        self.stepped_ms: list[float] = []

    def step(self) -> int:
        now_ns = self._world.now_ns() - START_NS
        self.stepped_ms.append(now_ns / MS)
        return START_NS + (now_ns // (10 * MS) + 1) * 10 * MS


def test_the_guard_is_stepped_at_its_grid_and_whenever_something_arrives() -> None:
    world = SteppedClock(START_NS)
    guard = FakeGuard(world)
    stepper = GuardStepper(world, guard)  # type: ignore[arg-type]
    for at_ms in (13, 14, 20):
        world.schedule(START_NS + at_ms * MS, stepper.step)
    world.sleep_until_ns(START_NS + 35 * MS)
    assert sorted(set(guard.stepped_ms)) == [0, 10, 13, 14, 20, 30]
    assert guard.stepped_ms.count(10) == 1
    guard.is_done = True
    stepper.step()
    world.sleep_until_ns(START_NS + 60 * MS)
    assert max(guard.stepped_ms) == 30


class FakePolicy:
    """Takes 12 ms; wants every attitude."""

    def __init__(self, world: SteppedClock, clock: AheadClock) -> None:
        self._world, self._clock = world, clock
        self.news = 0
        self.received: list[Any] = []
        self.solved_ms: list[float] = []

    @property
    def has_news(self) -> bool:
        return self.news > 0

    def step(self) -> None:
        self.news = 0
        self.solved_ms.append((self._world.now_ns() - START_NS) / MS)
        self._clock.ahead_ns += 12 * MS

    def receive(self, message: Any) -> None:
        self.received.append(message)
        self.news += 1


def test_the_policy_solves_on_news_and_one_at_a_time() -> None:
    world = SteppedClock(START_NS)
    clock = AheadClock(world)
    to_flight, to_guard = (DelayedChannel(world, repeat(MS)) for _ in range(2))
    port = MemoryPort(outgoing=to_guard, incoming=to_flight)
    policy = FakePolicy(world, clock)
    stepper = PolicyStepper(world, clock, port, policy, policy)  # type: ignore[arg-type]
    to_flight.on_arrival = stepper.receive
    data = encode_from_guard(GuardMessage("attitude"))
    for at_ms in (0, 5, 9, 40):
        world.schedule(START_NS + at_ms * MS, lambda: to_flight.send(data))
    world.sleep_until_ns(START_NS + 100 * MS)
    assert policy.received == [GuardMessage("attitude")] * 4
    assert policy.solved_ms == [1, 13, 41]  # those of 6 and 10 ms are one piece of news at 13
    assert clock.ahead_ns == 0


def test_a_message_leaves_when_its_maker_is_done_and_arrives_a_hop_later() -> None:
    world = SteppedClock(START_NS)
    clock = AheadClock(world)
    to_guard = DelayedChannel(world, repeat(MS // 10))
    port = MemoryPort(outgoing=to_guard, incoming=DelayedChannel(world, repeat(0)))
    guard = MemoryPort(outgoing=DelayedChannel(world, repeat(0)), incoming=to_guard)
    clock.ahead_ns = 3 * MS
    sender(world, clock, port)(NoChunk(because(Code.NO_IMAGE)))
    clock.ahead_ns = 0
    world.sleep_until_ns(START_NS + 3 * MS + MS // 10 - 1)
    assert guard.receive() == []
    world.sleep_until_ns(START_NS + 3 * MS + MS // 10)
    assert [decode_to_guard(one) for one in guard.receive()] == [NoChunk(because(Code.NO_IMAGE))]
