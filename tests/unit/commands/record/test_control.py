import pytest

from helpers.factories import make_tick
from mavbridge.commands.record_episodes import EpisodeControl
from mavbridge.core.clock import NS_PER_MS

STEP_NS = 50 * NS_PER_MS
LOW, MIDDLE, HIGH = 1000, 1500, 2000
CHANNEL = 7


class Session:
    """Records what is wanted, as a recording session does."""

    def __init__(self, *, has_switch: bool = False, on_arm: bool = False) -> None:
        self.control = EpisodeControl(on_arm=on_arm, channel=CHANNEL if has_switch else None)
        self.now_ns = 0
        self.is_recording = False
        self.may_begin = True

    def step(
        self, *, keys: str = "", switch_us: int = 0, armed: bool = False, times: int = 1
    ) -> list[str]:
        """What was done in these steps."""
        done: list[str] = []
        for _ in range(times):
            self.read(switch_us)
            mark = self.control.step(
                self.now_ns, armed=armed, is_recording=self.is_recording, keys=keys
            )
            keys, wanted = "", self.control.wanted is not None
            if mark is not None:
                done.append(mark)
            if wanted != self.is_recording and (self.may_begin or not wanted):
                self.is_recording = wanted
                done.append("begin" if wanted else "end")
        return done

    def read(self, switch_us: int, *, times: int = 1) -> None:
        """Readings of the switch without a step, as while an episode is closed."""
        for _ in range(times):
            self.now_ns += STEP_NS
            channels_us = (*[MIDDLE] * (CHANNEL - 1), switch_us, MIDDLE)
            self.control.emit(make_tick(woke_ns=self.now_ns, rc_channels_us=channels_us))

    def crash(self) -> None:
        """The episode ends by itself, as also with a full disk."""
        self.is_recording, self.control.wanted = False, None


def test_a_key_begins_and_ends_and_marks() -> None:
    session = Session()
    assert session.step() == []
    assert session.step(keys="r") == ["begin"]
    assert session.step(keys="g") == ["good"]
    assert session.step(keys=" ") == ["end"]
    assert session.step(keys="b") == ["bad"]
    assert session.step(keys="gb") == ["bad"], "the last word counts"
    assert session.step(keys="rr") == [], "begun and ended at once"


def test_a_switch_records_while_it_is_high_and_its_middle_marks_as_bad() -> None:
    session = Session(has_switch=True)
    for switch_us, times, done in (
        (HIGH, 5, []),  # it is high already
        (LOW, 5, []),
        (MIDDLE, 5, []),
        (HIGH, 5, ["begin"]),
        (0, 20, []),  # a lost radio ends nothing
        (HIGH, 1, []),
        (MIDDLE, 3, ["end"]),  # passing through the middle
        (LOW, 20, []),
        (HIGH, 5, ["begin"]),
        (LOW, 1, ["end"]),
        (LOW, 5, []),
        (HIGH, 5, ["begin"]),
        (MIDDLE, 20, ["end", "bad"]),
        (HIGH, 5, ["begin"]),  # the next one
        (LOW, 1, ["end"]),
        (MIDDLE, 20, []),  # it did not come from high
    ):
        assert session.step(switch_us=switch_us, times=times) == done, (switch_us, times)


def test_the_middle_marks_only_an_episode_of_this_move_of_the_switch() -> None:
    session = Session(has_switch=True)
    session.step(switch_us=LOW, times=5)
    assert session.step(switch_us=HIGH, times=5) == ["begin"]
    assert session.step(switch_us=LOW, times=5) == ["end"]
    assert session.step(switch_us=LOW, keys="g") == ["good"]
    session.may_begin = False
    assert session.step(switch_us=HIGH, times=5) == []
    assert session.step(switch_us=MIDDLE, times=20) == [], "the good one stays good"
    session.may_begin = True
    assert session.step(switch_us=HIGH, times=6) == ["begin"]
    session.crash()
    assert session.step(switch_us=HIGH, times=5) == []
    assert session.step(switch_us=MIDDLE, times=20) == ["bad"]


@pytest.mark.parametrize(("after", "marks"), [(MIDDLE, ["bad"]), (LOW, [])])
def test_the_last_episode_waits_for_its_mark(after: int, marks: list[str]) -> None:
    session = Session(has_switch=True)
    session.step(switch_us=LOW, times=5)
    session.step(switch_us=HIGH, times=5)
    assert not session.control.may_mark
    assert session.step(switch_us=MIDDLE) == ["end"]
    assert session.control.may_mark
    assert session.step(switch_us=after, times=7) == marks
    assert not session.control.may_mark


def test_the_switch_is_read_while_an_episode_is_closed() -> None:
    session = Session(has_switch=True)
    session.step(switch_us=LOW, times=5)
    session.step(switch_us=HIGH, times=5)
    assert session.step(switch_us=LOW) == ["end"]
    session.read(LOW, times=20)
    session.read(HIGH, times=20)
    assert session.step(switch_us=HIGH) == ["begin"]


@pytest.mark.parametrize(
    ("before", "between", "times"),
    [
        (LOW, (65535, 2201, 32767), 40),  # nobody drives the channel
        (LOW, (HIGH, LOW), 40),  # a contact that bounces
        (HIGH, (LOW, LOW, LOW), 1),  # a dropout shorter than the debounce
        (LOW, (0,) * 11 + (HIGH,) * 20, 1),  # a radio that was away in between
    ],
)
def test_what_is_no_hand_begins_no_episode(
    before: int, between: tuple[int, ...], times: int
) -> None:
    session = Session(has_switch=True)
    session.step(switch_us=before, times=20)
    done = [act for us in between * times for act in session.step(switch_us=us)]
    if before == HIGH:
        done += session.step(switch_us=HIGH, times=20)
    assert done == []
    session.step(switch_us=LOW, times=5)
    assert session.step(switch_us=HIGH, times=5) == ["begin"]


def test_armed_is_recording_and_a_second_longer() -> None:
    session = Session(on_arm=True)
    assert session.step() == []
    assert session.step(armed=True, times=10) == ["begin"]
    assert session.step(armed=False, times=19) == [], "a fall has time to show"
    assert session.step(armed=False, times=5) == ["end"]
    assert session.step(armed=True) == ["begin"]
    assert session.step(armed=False, times=3) == []
    assert session.step(armed=True, times=3) == [], "armed again within the second: the same one"


@pytest.mark.parametrize("switch", [True, False])
def test_what_could_not_begin_begins_when_it_can_for_as_long_as_it_is_wanted(switch: bool) -> None:
    session = Session(has_switch=switch, on_arm=not switch)
    session.step(switch_us=LOW, times=5)
    session.may_begin = False
    assert session.step(switch_us=HIGH, armed=True, times=5) == []
    session.may_begin = True
    assert session.step(switch_us=HIGH, armed=True, times=3) == ["begin"]
    session.crash()
    assert session.step(switch_us=HIGH, armed=True, times=5) == []
    session.step(switch_us=LOW, times=30)
    session.may_begin = False
    assert session.step(switch_us=HIGH, armed=True, times=2) == []
    assert session.step(switch_us=LOW, times=30) == []
    session.may_begin = True
    assert session.step(switch_us=LOW, times=5) == []
