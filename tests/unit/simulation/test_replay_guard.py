from mavbridge.core.clock import NS_PER_MS
from mavbridge.simulation.clock import SteppedClock
from mavbridge.simulation.replay.guard import _keep_link, _RecordedTransport
from mavbridge.simulation.replay.recording import RecordedPacket

MS = NS_PER_MS


class AskingLink:
    """Notes when it receives and when it asks."""

    def __init__(self, clock: SteppedClock) -> None:
        self._clock = clock
        self._begin_ns = clock.now_ns()
        self.transport: _RecordedTransport | None = None
        self.calls: list[tuple[str, float]] = []

    def note(self, name: str) -> None:
        self.calls.append((name, (self._clock.now_ns() - self._begin_ns) / MS))

    def receive(self) -> None:
        assert self.transport is not None
        received = len(list(self.transport.drain()))
        self.note(f"receive {received}" if received else "receive")

    def service(self) -> None:
        self.note("service")


def test_the_link_has_asked_before_what_may_be_the_answer_arrives() -> None:
    """A vehicle that is chosen after its answers came would be one that never sent them."""
    clock = SteppedClock()
    begin_ns = clock.now_ns()
    packet = RecordedPacket(data=b"", arrived_ns=begin_ns + 7 * MS, happened_ns=begin_ns + 7 * MS)
    link, transport = AskingLink(clock), _RecordedTransport(clock, [packet])
    link.transport = transport
    _keep_link(link, clock, transport, begin_ns + 12 * MS)  # type: ignore[arg-type]
    names = [name for name, _ in link.calls]
    assert names[: names.index("receive 1") + 1] == ["service", "receive 1"]
    assert link.calls[0][1] < 7
    assert clock.now_ns() == begin_ns + 12 * MS
