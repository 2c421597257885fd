"""The guard between a vehicle and a flight process of fakes."""

import os
import termios
from pathlib import Path
from typing import Any

import pytest

from helpers.fakes import START_NS, FakeClock, FakeLink
from helpers.guard_facts import engagement_settings, flight_settings, make_chunk
from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.errors import UserError
from mavbridge.core.reasons import Code, because
from mavbridge.core.ticks import GuardTick
from mavbridge.core.vehicle import IDLE, NEUTRAL, ForwardedPacket, LinkArrivals, Sticks
from mavbridge.guard.__main__ import say_on
from mavbridge.guard.chunks import Chunk
from mavbridge.guard.guard import Guard
from mavbridge.guard.loop import FINISH_NS, IDLE_PERIOD_NS, GuardLoop
from mavbridge.guard.values import EndRequest, FlightSettings, Phase
from mavbridge.guard.wire import (
    FromGuard,
    GuardStatus,
    LastWords,
    Samples,
    ToGuard,
    decode_from_guard,
    encode,
)

MS = NS_PER_MS
WANTED = Sticks(0.4, 0.1, -0.2, 0.3)
FLIGHT = flight_settings()


class FakePort:
    """The flight process: its messages wait in ``inbox``, those of the guard are kept decoded."""

    def __init__(self) -> None:
        self.inbox: list[bytes] = []
        self.received: list[FromGuard] = []
        self.files: list[int] = []
        """Open files that came with messages."""
        self.is_closed = False
        self.takes = True

    def send(self, message: bytes, fd: int | None = None) -> bool:
        if not self.takes:
            return False
        self.received.append(decode_from_guard(message))
        self.files += [] if fd is None else [fd]
        return not self.is_closed

    def receive(self) -> list[bytes]:
        messages, self.inbox = self.inbox, []
        return messages


class Rig:
    """Steps whenever the loop asks for it; a chunk comes 5 ms after each slot while ``solves``."""

    def __init__(
        self,
        *,
        oversleep_ns: int = 0,
        lead_ns: int = 0,
        **status: Any,
    ) -> None:
        self.clock = FakeClock(oversleep_ns=oversleep_ns)
        self.link = FakeLink(self.clock, **status)
        self.port = FakePort()
        self.said: list[str] = []
        self.loop = GuardLoop(self.clock, self.link, self.port, lead_ns=lead_ns)
        self.loop.say = self.said.append
        self.solves = True
        self.serial = 0

    def tell(self, *messages: ToGuard) -> None:
        self.port.inbox += [encode(message) for message in messages]

    def chunk(self) -> Chunk:
        self.serial += 1
        now_ns, actions = self.clock.now_ns(), (WANTED,) * 4
        return make_chunk(self.serial, now_ns, step_ns=50 * MS, actions=actions)

    def run(self, seconds: float) -> "Rig":
        until_ns = self.clock.now_ns() + round(seconds * NS_PER_S)
        while self.clock.now_ns() < until_ns and not self.loop.is_done:
            due_ns = self.loop.step()
            if self.solves and due_ns - self.clock.now_ns() > 5 * MS:
                self.clock.sleep_until_ns(due_ns - 5 * MS)
                self.tell(self.chunk())
            else:
                self.clock.sleep_until_ns(due_ns)
        return self

    def flying(self, flight: FlightSettings = FLIGHT) -> "Rig":
        self.tell(flight)
        self.run(0.1)
        self.tell("engage")
        self.run(0.1)
        assert self.ticks[-1].phase is Phase.FLYING, self.texts
        return self

    def got(self, kind: Any) -> list[Any]:
        return [message for message in self.port.received if isinstance(message, kind)]

    @property
    def ticks(self) -> list[GuardTick]:
        return self.got(GuardTick)

    @property
    def texts(self) -> list[str]:
        return self.got(str)


# --- what the flight process hears


def test_samples_are_passed_on_before_anything_else_with_their_stamps() -> None:
    rig = Rig().flying()
    rig.port.received.clear()
    rig.link.change(mode="LOITER")
    rig.link.texts.append("Mode LOITER")
    rig.link.measure(age_ns=3 * MS)
    arrived_ns = rig.clock.now_ns()
    rig.loop.step()
    passed, *rest = rig.port.received
    assert isinstance(passed, Samples)
    readings = [sample.reading for sample in passed.samples]
    assert len(readings) == 4
    assert {(r.arrived_ns, r.happened_ns) for r in readings} == {(arrived_ns, arrived_ns - 3 * MS)}
    assert [type(message) for message in rest] == [*(GuardStatus, str, GuardTick, LastWords)]


def test_the_vehicles_status_is_told_when_it_changes() -> None:
    rig = Rig().run(0.1)
    assert rig.got(GuardStatus) == [GuardStatus("fake 1.0", "ALT_HOLD", True, False, (), None)]
    rig.link.change(armed=False)
    rig.run(0.1)
    rig.link.status = None
    rig.run(0.1)
    assert [(s.mode, s.armed) for s in rig.got(GuardStatus)[1:]] == [
        ("ALT_HOLD", False),
        (None, False),
    ]


def test_a_status_that_was_not_taken_is_told_again_and_lost_ticks_leave_a_gap() -> None:
    rig = Rig().flying()
    rig.port.takes = False
    rig.link.change(mode="LOITER", armed=False)
    rig.run(0.1)
    rig.port.takes = True
    last = rig.ticks[-1].serial
    rig.run(0.05)
    assert [(s.mode, s.armed) for s in rig.got(GuardStatus)[-1:]] == [("LOITER", False)]
    later = [tick.serial for tick in rig.ticks if tick.serial > last]
    assert later == list(range(later[0], later[0] + len(later)))
    assert later[0] > last + 5


def test_the_receivers_channels_are_not_told_before_somebody_reads() -> None:
    rig = Rig(rc_sticks=NEUTRAL).run(0.1)
    for us in range(1000, 1100):
        rig.link.change(rc_channels_us=(us,) * 8)
        rig.run(0.01)
    assert [(s.rc_channels_us, s.rc_sticks) for s in rig.got(GuardStatus)] == [((), None)]
    rig.tell(FLIGHT)
    rig.run(0.1)
    assert rig.got(GuardStatus)[-1].rc_channels_us == (1099,) * 8


def test_every_stick_is_told_with_its_chunk_as_it_was_sent() -> None:
    rig = Rig().flying()
    sent = [tick for tick in rig.ticks if tick.sent is not None]
    assert [(tick.sent_ns, tick.sent) for tick in sent] == rig.link.decisions
    assert {tick.sent for tick in sent} == {tick.trace.smoothed for tick in sent if tick.trace}
    assert sent[-1].sent == pytest.approx(WANTED)
    assert [tick.chunk_serial for tick in sent] == sorted(tick.chunk_serial for tick in sent)
    rounded, send = Sticks(0.2, 0.2, 0.2, 0.2), rig.link.send
    rig.link.send = lambda one, at_ns: rounded if send(one, at_ns) else None  # type: ignore[method-assign]
    rig.run(0.05)
    assert rig.ticks[-1].sent == rounded


def test_a_packet_that_comes_while_the_link_is_read_belongs_to_the_pass(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A replay receives what had arrived by the time at which the guard woke."""
    rig = Rig().flying()
    late_ns = rig.clock.now_ns() + 20_000

    def receive() -> LinkArrivals:
        rig.clock.sleep_until_ns(late_ns + 1)
        return LinkArrivals((), (ForwardedPacket(late_ns, late_ns, b"attitude"),))

    monkeypatch.setattr(rig.link, "receive", receive)
    rig.tell(rig.chunk())
    rig.loop.step()

    assert rig.ticks[-1].woke_ns == late_ns


def test_motion_alone_is_passed_on_without_a_step_of_the_guard(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rig, steps, step = Rig().flying(), [], Guard.step
    monkeypatch.setattr(Guard, "step", lambda *given: steps.append(1) or step(*given))
    rig.loop.step()
    before = len(steps)
    rig.port.received.clear()
    rig.link.measure()
    rig.loop.step()
    assert [type(message) for message in rig.port.received] == [Samples]
    assert len(steps) == before
    rig.link.change(mode="LOITER")
    rig.loop.step()
    assert len(steps) == before + 1


def test_samples_are_not_passed_on_before_somebody_reads_them() -> None:
    rig = Rig()
    for _ in range(1000):
        rig.link.measure()
        rig.loop.step()
    assert rig.got(Samples) == []
    rig.tell(FLIGHT)
    rig.loop.step()
    rig.link.measure()
    rig.loop.step()
    assert [len(one.samples) for one in rig.got(Samples)] == [4]


# --- what it says


def test_before_a_policy_is_loaded_the_link_is_served_all_the_same() -> None:
    rig = Rig()
    rig.tell("engage", rig.chunk(), because(Code.NO_IMAGE))
    first_ns = rig.loop.step()
    assert first_ns == START_NS + IDLE_PERIOD_NS
    rig.run(0.1)
    assert rig.link.services >= 10
    assert rig.ticks == []
    assert rig.link.decisions == []


# --- the vehicle


def test_sticks_leave_before_requests_and_other_work() -> None:
    rig = Rig(has_receiver=False).flying()
    services, requests = rig.link.services, []
    rig.link.on_send = lambda: requests.append((rig.link.services, list(rig.link.requests)))
    rig.tell(EndRequest(reason=because(Code.SIGNAL)))
    rig.loop.step()
    assert requests == [(services, [])]
    assert rig.link.requests == ["mode LAND"]
    assert rig.link.services == services + 1


def test_every_ground_station_is_told_who_holds_the_sticks() -> None:
    rig = Rig(has_receiver=False).flying()
    rig.tell(EndRequest(reason=because(Code.POLICY_FAILED), end="fault"))
    rig.run(0.5)
    assert rig.ticks[-1].phase is Phase.HOLDING
    assert rig.link.is_engaged
    assert rig.texts[-1].startswith("neutral sticks go on until")  # the screen is told too
    rig.link.change(mode="LOITER")
    rig.run(0.5)
    assert rig.link.announced == [
        "mavbridge: the policy has control",
        "mavbridge: neutral: the policy has failed",
        "mavbridge: neutral sticks go on until you disarm or change the mode",
        "mavbridge: control given back: the policy has failed; then mode changed from BRAKE to "
        "LOITER",
    ]


def test_a_vehicle_that_moves_on_the_way_in_is_followed_as_in_flight() -> None:
    """A new session would give its sticks back, in the middle of a takeoff."""
    arms = flight_settings(engagement=engagement_settings(modes=("ALT_HOLD",), arm=True))
    rig = Rig()
    rig.tell(arms)
    rig.solves = False
    assert rig.run(0.1).ticks[-1].phase is Phase.PREPARING
    assert rig.link.is_engaged


def test_work_that_begins_before_the_slot_sends_at_the_slot() -> None:
    rig = Rig(lead_ns=MS // 2).flying()
    rig.port.received.clear()
    rig.run(0.5)
    on_grid = [tick for tick in rig.ticks if tick.is_slot]
    assert len(on_grid) > 40
    assert {tick.sent_ns - tick.due_ns for tick in on_grid} == {0}
    assert {tick.due_ns - tick.woke_ns for tick in on_grid} == {MS // 2}


def test_a_mode_that_cannot_be_asked_for_does_not_end_the_guard() -> None:
    rig = Rig(pilot_sticks=IDLE).flying()

    def refuse(mode: str) -> None:
        raise UserError(f"no mode {mode}")

    rig.link.set_mode = refuse  # type: ignore[method-assign]
    rig.loop.stop(EndRequest(reason=because(Code.DURATION), end="fault"))
    rig.run(6.0)
    assert rig.link.decisions[-1][1] == NEUTRAL  # over an idle receiver
    assert rig.ticks[-1].phase is Phase.HOLDING


def test_a_chunk_that_has_come_with_the_end_of_the_channel_does_not_fly() -> None:
    rig = Rig().flying()
    rig.tell(rig.chunk(), "engage")
    rig.port.is_closed = True
    rig.loop.step()
    assert rig.link.decisions[-1][1] == NEUTRAL


def test_what_a_dead_flight_process_cannot_show_is_said_on_its_terminal() -> None:
    rig = Rig(has_receiver=False).flying()
    assert rig.said == []
    rig.port.is_closed = True
    rig.run(0.5)
    rig.link.change(mode="LOITER")
    rig.run(0.5)
    assert rig.said == rig.link.announced[1:]
    assert rig.said[0] == "mavbridge: neutral: the flight process has died"
    assert rig.said[-1].startswith("mavbridge: control given back: the flight process has died")


def test_a_terminal_that_shows_nothing_more_does_not_hold_the_guard_up(tmp_path: Path) -> None:
    reader, terminal = os.openpty()
    name = Path(os.ttyname(terminal))
    say_on(name, "a\x1b[2J\nb")
    assert os.read(reader, 1024).split() == [b"a?[2J?b", b"\x1b[?25h"]
    termios.tcflow(terminal, termios.TCOOFF)  # Ctrl-S
    for _ in range(200):
        say_on(name, "x" * 1000)
    os.close(reader)
    os.close(terminal)
    (file := tmp_path / "log").write_text("as it was")
    for other in (name, Path("pipe:[7]"), file):
        say_on(other, "nobody")
    assert file.read_text() == "as it was"


def test_a_message_that_cannot_be_read_ends_the_flight_and_not_the_guard() -> None:
    rig = Rig().flying()
    rig.port.inbox.append(b"Snonsense")
    rig.run(0.05)
    assert rig.ticks[-1].phase is Phase.LEAVING
    assert rig.ticks[-1].release_reason == because(Code.UNREADABLE)
    waiting = Rig()
    waiting.port.inbox.append(b"Snonsense")
    with pytest.raises(ValueError, match="not a message"):
        waiting.run(0.05)


@pytest.mark.parametrize("has_policy", [True, False], ids=["flight", "weights still loading"])
@pytest.mark.parametrize("seconds", [0.5, 60.0])
def test_parameters_are_put_back_at_the_end_for_a_bounded_time(
    has_policy: bool, seconds: float
) -> None:
    rig = Rig()
    rig.tell(*([FLIGHT] if has_policy else []))
    rig.link.is_restored = False
    rig.run(0.1)
    assert rig.link.restores == 0
    rig.tell(EndRequest(reason=because(Code.SIGNAL)))
    stopped_ns = rig.clock.now_ns()
    services = rig.link.services
    rig.run(min(seconds, 1.0))
    assert not rig.loop.is_done
    assert rig.link.restores > 10
    assert rig.link.services > services + 10
    rig.link.is_restored = seconds < 1.0
    rig.run(seconds)
    assert rig.loop.is_done
    assert any("was not put back" in text for text in rig.texts) is (seconds > 1.0)
    took_ns = rig.clock.now_ns() - stopped_ns
    assert took_ns == pytest.approx(min(seconds * NS_PER_S, FINISH_NS), abs=40 * MS)


def test_what_the_link_says_about_putting_back_is_still_passed_on() -> None:
    rig = Rig()
    rig.tell(FLIGHT)
    rig.run(0.1)
    rig.tell(EndRequest(reason=because(Code.SIGNAL)))
    restore = rig.link.restore

    def putting_back() -> bool:
        if not rig.loop.is_done:
            rig.link.texts = ["RC_OVERRIDE_TIME put back to 3"]
        return restore()

    rig.link.restore = putting_back  # type: ignore[method-assign]
    rig.run(0.1)
    assert rig.loop.is_done
    assert "RC_OVERRIDE_TIME put back to 3" in rig.texts


# --- last words, for the death of the guard or a bug of its own


def words(rig: Rig) -> LastWords:
    newest: LastWords = rig.got(LastWords)[-1]
    return newest


def said(rig: Rig) -> list[tuple[int, str]]:
    """The newest last words as (ms, text)."""
    return [(after_ns // MS, packet.decode()) for after_ns, packet in words(rig).packets]


def test_before_and_after_a_flight_there_is_nothing_to_say() -> None:
    rig = Rig()
    rig.tell(FLIGHT)
    rig.run(1.0)
    assert rig.got(LastWords) == []
    rig.tell("engage")
    rig.run(0.1)
    assert words(rig).packets
    rig.link.change(mode="LOITER")
    rig.run(2.0)
    assert rig.ticks[-1].phase is Phase.RELEASED
    assert words(rig) == LastWords(Phase.RELEASED, None, ("127.0.0.1", 1), False, ())


@pytest.mark.parametrize(
    "change",
    [{"mode": "POSHOLD", "armed": False}, {"has_receiver": False}, {"is_position_valid": False}],
)
def test_the_last_words_follow_the_vehicle_at_once(change: dict[str, Any]) -> None:
    rig = Rig(pilot_sticks=IDLE).flying()
    before = words(rig)
    rig.link.change(**change)
    rig.loop.step()
    assert words(rig) != before


def test_nothing_is_prepared_between_two_seconds_in_which_nothing_changes() -> None:
    rig = Rig().flying()
    count = len(rig.got(LastWords))
    rig.run(5.0)
    assert len(rig.got(LastWords)) - count == 5


def test_the_open_link_is_handed_over_once_and_again_when_it_was_opened_again() -> None:
    rig = Rig().flying()
    rig.run(3.0)
    assert rig.port.files == [7]
    rig.link.outlet = rig.link.outlet._replace(opened=2, fd=None)
    rig.loop.step()
    assert words(rig).packets == ()  # the flight process closes its duplicate
    rig.link.outlet = rig.link.outlet._replace(fd=8)
    rig.loop.step()
    assert rig.port.files == [7, 8]
    assert words(rig).brings_file


def test_what_the_flight_process_did_not_take_is_sent_again_with_the_open_link() -> None:
    rig = Rig().flying()
    rig.port.takes = False
    rig.link.change(has_receiver=False)
    rig.loop.step()
    rig.port.takes = True
    rig.run(1.1)
    assert words(rig).brings_file
    assert words(rig).packets


def test_a_guard_that_fails_says_its_last_words_itself() -> None:
    rig = Rig(pilot_sticks=IDLE).flying()
    expected = said(rig)
    died_ns = rig.clock.now_ns()
    rig.port.received.clear()
    rig.loop.abandon()
    transmitted = [((at_ns - died_ns) // MS, text) for at_ns, text in rig.link.transmitted]
    assert transmitted == expected
    # At each packet the flight process hears what is left, so that nothing is said twice.
    whole, *rests = (
        [(after_ns // MS, packet.decode()) for after_ns, packet in told.packets]
        for told in rig.got(LastWords)
    )
    assert whole == expected
    for sent, rest in enumerate(rests, 1):
        since_ms = expected[sent - 1][0]
        assert rest == [(after_ms - since_ms, text) for after_ms, text in expected[sent:]]
    assert rests[-1] == []
    assert rig.port.files == [7]

    def explode() -> None:
        raise OSError("no link")

    rig.link.on_send = explode
    rig.loop.abandon()  # and hides no first error behind a second one
