"""Demonstrations are flights: recorded, labelled, resumable, and the same for the same seed."""

from pathlib import Path

import numpy as np
import pytest

from mavbridge.commands.demonstrate.flight import _Turns, draw
from mavbridge.commands.demonstrate.run import demonstrate
from mavbridge.config.demonstrate import DemonstrateConfig
from mavbridge.config.policy import PolicyConfig
from mavbridge.core.errors import UserError
from mavbridge.recording.flight_folder import RecordedFlight, open_flight

SIZE = 48


def config(
    out: Path, *, episodes: int = 1, seed: int = 3, max_time: float = 40.0
) -> DemonstrateConfig:
    return DemonstrateConfig(
        out=out,
        episodes=episodes,
        speed=6.0,
        max_time=max_time,
        policy=PolicyConfig(image_size=SIZE, seed=seed),
    )


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> RecordedFlight:
    out = tmp_path_factory.mktemp("demonstrations")
    assert demonstrate(config(out)) == 0
    return open_flight(out / "000000")


def column(flight: RecordedFlight, name: str) -> np.ndarray:
    return np.array(flight.ticks[name].to_pylist())


def test_a_demonstration_finishes_its_course_and_says_what_it_was(flight: RecordedFlight) -> None:
    meta = flight.meta
    assert meta.finished
    assert meta.success
    assert meta.source == "demonstration"
    assert meta.course_seed == 30_000
    assert (meta.image_height, meta.image_width) == (SIZE, SIZE)
    assert meta.frames_dropped == meta.ticks_dropped == 0


def test_every_tick_flies_and_has_the_experts_word(flight: RecordedFlight) -> None:
    assert flight.ticks["expert"].null_count == 0
    assert flight.ticks["sent"].null_count == 0
    assert set(column(flight, "mode")) == {"ALT_HOLD"}
    assert np.abs(column(flight, "expert")).max() <= 1.0
    # sticks follow the expert, late by the filter and the delays, and where they were disturbed
    error = np.abs(column(flight, "sent") - column(flight, "expert")).mean()
    assert error < np.abs(column(flight, "expert")).mean()


def test_every_frame_has_an_image_and_the_truth(flight: RecordedFlight) -> None:
    rows = list(flight.frame_rows())
    images = list(flight.images())
    assert len(rows) == len(images) > 30
    assert all(row.truth is not None for row in rows)
    gates = [row.truth.next_gate for row in rows if row.truth is not None]
    seen = [gate for gate in gates if gate is not None]
    assert seen == sorted(seen)
    assert gates[-1] is None  # the last gate is behind
    assert images[0].std() > 0


def test_the_seed_decides_all_of_it(flight: RecordedFlight, tmp_path: Path) -> None:
    assert demonstrate(config(tmp_path)) == 0
    again = open_flight(tmp_path / "000000")
    assert again.ticks.equals(flight.ticks)
    assert again.frames.equals(flight.frames)


def test_what_is_there_is_kept_and_what_was_cut_off_is_flown_again(
    flight: RecordedFlight, tmp_path: Path
) -> None:
    assert demonstrate(config(tmp_path)) == 0
    first = (tmp_path / "000000" / "meta.json").read_text()
    half = tmp_path / "000001"
    half.mkdir()
    (half / "meta.json").write_text(first.replace('"finished": true', '"finished": false'))
    (half / "ticks.arrows").write_bytes(b"")
    assert demonstrate(config(tmp_path, episodes=2)) == 0
    assert (tmp_path / "000000" / "meta.json").read_text() == first
    assert open_flight(half).meta.finished
    assert open_flight(half).meta.course_seed == 30_001


def test_a_folder_of_somebody_elses_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "000000").mkdir()
    (tmp_path / "000000" / "thesis.tex").write_text("years of work")
    with pytest.raises(UserError, match="no recorded flight"):
        demonstrate(config(tmp_path))


def test_a_flight_that_is_to_be_short_is_whole_and_no_success(tmp_path: Path) -> None:
    assert demonstrate(config(tmp_path, seed=2, max_time=1.0)) == 0
    cut = open_flight(tmp_path / "000000")
    sent_ns = cut.ticks["sent_ns"].to_pylist()
    # Of a flight that starts in the air the first moment is left out.
    assert 0.5e9 < sent_ns[-1] - sent_ns[0] < 1.1e9
    assert cut.meta.finished
    assert cut.meta.success is False


@pytest.mark.parametrize(
    "change", [{"episodes": 0}, {"speed": 40.0}, {"workers": 0}, {"max_time": 0.1}]
)
def test_what_cannot_be_flown_is_refused(tmp_path: Path, change: dict[str, float]) -> None:
    with pytest.raises(UserError):
        DemonstrateConfig(out=tmp_path, **change)  # type: ignore[arg-type]


def test_no_demonstration_flies_a_held_out_course(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="seed"):
        config(tmp_path, seed=100)


def test_flights_differ() -> None:
    drawn = [draw(seed) for seed in range(60)]
    assert 5 < sum(one.starts_airborne for one in drawn) < 40
    assert 5 < sum(one.disturbance == 0.0 for one in drawn) < 40
    assert len({one.conditions for one in drawn}) > 30


def test_student_and_expert_fly_in_turns_and_the_seed_decides_whose_it_is() -> None:
    def flown(seed: int) -> list[bool]:
        turns = _Turns(seed)
        return [turns.is_students(5.0 + tick / 100) for tick in range(4_000)]

    flights = [flown(seed) for seed in range(12)]
    assert flown(0) == flights[0]
    assert {one[0] for one in flights} == {True, False}
    for one in flights:
        lengths = np.diff(np.flatnonzero(np.diff(one))) / 100
        assert lengths.min() >= 0.39
        assert lengths.max() <= 6.01
        assert 0.55 < np.mean(one) < 0.95
