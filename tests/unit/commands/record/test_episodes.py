import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import pytest

from helpers.factories import make_plan, make_tick
from helpers.fakes import START_NS, FakeClock
from helpers.recordings import make_frame
from mavbridge.commands import record_episodes as episodes
from mavbridge.commands.record_episodes import Episodes, disk_left_gb, prepare_out
from mavbridge.core.errors import UserError
from mavbridge.core.vehicle import ForwardedPacket
from mavbridge.recording.flight_folder import RecordedFlight, open_flight
from mavbridge.recording.recorder import Recorder
from mavbridge.recording.video_writer import WriterDiedError

PACKET = bytes(20)


@dataclass
class Stand:
    """Episodes, their log, and what was told."""

    out: Path
    told: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.episodes = Episodes(
            self.out,
            make_plan(),
            clock=FakeClock(),
            autopilot=lambda: "ardupilot 4.7.0",
            report=self.told.append,
        )

    def record(self, first: int, count: int = 3, **changes: object) -> None:
        """One episode of ticks and frames whose numbers begin at ``first``."""
        self.episodes.watch_packets((ForwardedPacket(START_NS, START_NS, b"early"),))
        self.episodes.begin()
        self.episodes.watch_packets((ForwardedPacket(START_NS, START_NS, PACKET),))
        for number in range(first, first + count):
            self.episodes.emit(make_tick(number, **changes))
            self.episodes.emit(make_frame(number))
        self.episodes.end("a key")
        self.episodes.watch_packets((ForwardedPacket(START_NS, START_NS, b"late"),))

    def flight(self, number: int) -> RecordedFlight:
        return open_flight(self.out / f"episode-{number:04}")


@pytest.fixture
def stand(tmp_path: Path) -> Iterator[Stand]:
    prepare_out(tmp_path / "out")
    stood = Stand(tmp_path / "out")
    yield stood
    stood.episodes.end("the test")


def test_each_episode_is_a_flight_of_its_own_without_drops(stand: Stand) -> None:
    stand.record(5)
    stand.record(40)
    for number in (1, 2):
        flight = stand.flight(number)
        assert flight.meta.finished
        assert flight.meta.source == "pilot"
        assert (flight.meta.ticks, flight.meta.frames) == (3, 3)
        assert (flight.meta.ticks_dropped, flight.meta.frames_dropped) == (0, 0)
        assert flight.meta.success is None
        assert (flight.folder / "link.tlog").read_bytes()[8:] == PACKET
        assert not (flight.folder / "solves.parquet").exists(), "there is nothing to replay"
    assert [row.tick.index for row in stand.flight(2).tick_rows()] == [40, 41, 42]
    assert stand.episodes.counts.total() == 2


@pytest.mark.usefixtures("in_process_writer")
def test_an_episode_begins_when_its_writer_runs(
    stand: Stand, monkeypatch: pytest.MonkeyPatch
) -> None:
    begin = Recorder.__init__

    def begin_late(*args: object, **kwargs: object) -> None:
        stand.episodes.emit(make_tick(3))
        stand.episodes.emit(make_frame(3))
        begin(*args, **kwargs)

    monkeypatch.setattr(Recorder, "__init__", begin_late)
    stand.record(4)
    assert [row.tick.index for row in stand.flight(1).tick_rows()] == [4, 5, 6]
    assert [row.frame_id for row in stand.flight(1).frame_rows()] == [
        make_frame(number).frame_id for number in (4, 5, 6)
    ]


@pytest.mark.usefixtures("in_process_writer")
@pytest.mark.parametrize(("mark", "success"), [("good", True), ("bad", False)])
def test_a_mark_counts_before_and_after_the_end(stand: Stand, mark: str, success: bool) -> None:
    stand.episodes.begin()
    stand.episodes.mark("bad" if success else "good")
    stand.episodes.mark("good" if success else "bad")
    stand.episodes.emit(make_tick(0))
    stand.episodes.end("a key")
    assert stand.flight(1).meta.success is success
    stand.episodes.mark("bad" if success else "good")
    assert stand.flight(1).meta.success is not success
    assert stand.flight(1).meta.ticks == 1
    assert stand.episodes.counts == {not success: 1}


@pytest.mark.usefixtures("in_process_writer")
def test_a_crash_is_bad_by_itself_and_a_mark_has_the_last_word(stand: Stand) -> None:
    stand.record(0, texts=("vehicle: Crash: Disarming",))
    meta = stand.flight(1).meta
    assert meta.success is False
    assert meta.crash == "the vehicle said 'Crash: Disarming'"
    assert stand.episodes.counts == {False: 1}
    stand.episodes.mark("good")
    assert stand.flight(1).meta.success is True
    assert stand.flight(1).meta.crash == meta.crash


@pytest.mark.usefixtures("in_process_writer")
def test_an_episode_cannot_go_on_after_a_crash_or_without_recorder_or_images(stand: Stand) -> None:
    stand.episodes.begin()
    episode = stand.episodes.current
    assert episode.obstacle is None
    episode.recorder._flight.crash_watch.reason = "it fell"
    assert episode.obstacle == "a crash (it fell)"
    episode.recorder._flight.writer.video_failure = WriterDiedError("the writer process has died")
    assert episode.obstacle == "an error (the writer process has died)"
    episode.recorder.failure = "the disk is full"
    assert episode.obstacle == "an error (the disk is full)"


@pytest.mark.usefixtures("in_process_writer")
def test_a_later_session_goes_on_counting(stand: Stand) -> None:
    stand.record(0)
    again = Stand(stand.out)
    again.record(0)
    assert again.episodes.number == 3
    assert stand.flight(2).meta.ticks == 3


@pytest.mark.usefixtures("in_process_writer")
def test_a_flight_is_no_folder_for_flights(stand: Stand) -> None:
    stand.record(0)
    with pytest.raises(UserError, match="is a flight itself"):
        prepare_out(stand.out / "episode-0001")
    (stand.out / "file").write_text(json.dumps({}))
    with pytest.raises(UserError, match="cannot be made"):
        prepare_out(stand.out / "file")


def test_the_room_on_the_disk_counts_down_to_the_reserve(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for free, left_gb in ((3.5e9, 2.5), (0.5e9, 0.0)):
        monkeypatch.setattr(episodes, "disk_usage", lambda _, free=free: SimpleNamespace(free=free))
        assert disk_left_gb(tmp_path, 1.0) == pytest.approx(left_gb)
