"""Listens to a vehicle through the link of a flight, in this process and for a bounded time."""

from collections.abc import Callable
from typing import Literal, TypeAlias

from mavbridge.core.clock import NS_PER_MS, NS_PER_S, Clock
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.vehicle import NEUTRAL, Command, LinkSnapshot, LinkStats, Release
from mavbridge.mavlink.link import MavlinkLink
from mavbridge.mavlink.session.vehicle import VehicleSession

SET_UP_S = 15.0
"""Longest wait for version, parameters, streams and the receiver: on a link that loses nothing it
takes one to three seconds."""
SETTLE_S = 1.0
"""From the grant of the streams until their rates are counted."""
MEASURE_S = 3.0
ECHO_S = 3.0
RELEASE_S = 4.0
"""The releases of an override are spread over so much time at most."""
_POLL_NS = NS_PER_MS
"""Between two looks at the link; the kernel stamps what arrives meanwhile."""
_STICK_NS = 20 * NS_PER_MS

EchoResult: TypeAlias = Literal["taken", "not taken", "armed"]
"""``armed``: the vehicle is, or was, armed, so nothing was sent, or no more."""


class VehicleProbe:
    """Runs a ``MavlinkLink`` that has no gate; its methods are called in their order."""

    def __init__(self, link: MavlinkLink, clock: Clock) -> None:
        self._link = link
        self._clock = clock
        self._snapshot: LinkSnapshot | None = None
        self.texts: list[str] = []
        """What the vehicle and the link have said."""
        self.echo_problem: Reason | None = None
        """Why the sticks of the echo test were not taken, as the link says it."""

    def find(self) -> VehicleSession:
        """Wait for the vehicle; raises PeerError as the link does if there is none in time."""
        while (vehicle := self._link.vehicle) is None:
            self._pass()
        return vehicle

    def set_up(self) -> Reason | None:
        """Read parameters and request streams; returns the step that was not finished in time."""
        self._until(SET_UP_S, lambda: self._unfinished is None)
        return self._unfinished

    @property
    def _unfinished(self) -> Reason | None:
        return self.find().unfinished(self._clock.now_ns())

    def measure(self) -> LinkStats:
        """Count messages, losses and round trips."""
        self._until(SETTLE_S)
        self._link.restart_counters()
        self._until(MEASURE_S)
        return self._link.stats()

    def snapshot(self) -> LinkSnapshot:
        """Everything that the link knows now."""
        return self._snapshot or self._pass()

    def echo(self) -> EchoResult:
        """Send neutral sticks while the vehicle is disarmed, look for them, and release them."""
        result: EchoResult = "not taken"
        due_ns = 0

        def is_over() -> bool:
            nonlocal result, due_ns
            snapshot = self.snapshot()
            if snapshot.status is None or snapshot.status.armed:
                result = "armed"
            elif snapshot.echo_confirmed:
                result = "taken"
            elif (now_ns := self._clock.now_ns()) >= due_ns:
                due_ns = now_ns + _STICK_NS
                self.echo_problem = snapshot.problem or self.echo_problem
                self._link.send(Command(action=NEUTRAL))
            return result != "not taken"

        self._link.is_engaged = True
        try:
            self._until(ECHO_S, is_over)
        finally:
            if result != "armed" or due_ns:
                self._until(RELEASE_S, self._release)
            self._link.is_engaged = False
        return result

    def _release(self) -> bool:
        """Give the sticks back; True once the vehicle shows that it has them."""
        self._link.send(Release(because(Code.FINISHED, what="echo test")))
        return self.snapshot().is_released and not self._link.is_release_owed

    def _until(self, limit_s: float, is_over: Callable[[], bool] = lambda: False) -> None:
        deadline_ns = self._clock.now_ns() + round(limit_s * NS_PER_S)
        while self._clock.now_ns() < deadline_ns and not is_over():
            self._pass()

    def _pass(self) -> LinkSnapshot:
        self._snapshot = self._link.poll()
        self.texts += [text for text in self._snapshot.texts if text not in self.texts]
        self._link.service()
        self._clock.sleep_until_ns(self._clock.now_ns() + _POLL_NS)
        return self._snapshot
