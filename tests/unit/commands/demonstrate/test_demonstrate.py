"""Demonstrations are flights: recorded, labelled, resumable, and the same for the same seed."""

import multiprocessing
import shutil
from collections.abc import Callable
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mavbridge.commands.demonstrate import DemonstrationSpec, demonstrate, fly_demonstration
from mavbridge.commands.demonstrate_expert import TurnSchedule, draw_variation, from_now
from mavbridge.commands.train import fit_to_flights
from mavbridge.config.episodes import COURSE_SEEDS, AutopilotKind, DemonstrateConfig
from mavbridge.config.policy import PolicyConfig
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.errors import UserError
from mavbridge.core.vehicle import BodyRates, Sticks
from mavbridge.recording.flight_folder import RecordedFlight, open_flight
from mavbridge.recording.folder import write_meta
from mavbridge.recording.video_writer import WriterDiedError
from mavbridge.simulation.referee import EpisodeInterruptedError
from policy.data.flight_folders import read_flight
from policy.loading.builtin import SHIPPED, SHIPPED_RATES
from policy.nets.toge import TogeConfig
from policy.training.settings import TrainSettings

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
    assert 0 <= flight.ticks["woke_ns"][0].as_py() - meta.start_ns < 60 * NS_PER_S
    assert meta.course_seed == 30_000
    assert meta.frames_dropped == meta.ticks_dropped == 0


def test_every_tick_and_frame_has_the_experts_word_and_the_truth(flight: RecordedFlight) -> None:
    assert flight.ticks["expert"].null_count == 0
    assert flight.ticks["sent"].null_count == 0
    assert set(column(flight, "mode")) == {"ALT_HOLD"}
    # sticks follow the expert, late by the filter and the delays, and where they were disturbed
    error = np.abs(column(flight, "sent") - column(flight, "expert")).mean()
    assert error < np.abs(column(flight, "expert")).mean()
    rows = list(flight.frame_rows())
    images = list(flight.images())
    assert len(rows) == len(images) > 30
    gates = [row.truth.next_gate for row in rows if row.truth is not None]
    assert len(gates) == len(rows)
    seen = [gate for gate in gates if gate is not None]
    assert seen == sorted(seen)
    assert gates[-1] is None  # the last gate is behind
    assert images[0].shape == (SIZE, SIZE, 3)
    assert images[0].std() > 0


@pytest.mark.usefixtures("in_process_writer")
def test_the_seed_decides_all_of_it(tmp_path: Path) -> None:
    for name in "ab":
        assert demonstrate(config(tmp_path / name, max_time=2.0)) == 0
    flight, again = (open_flight(tmp_path / name / "000000") for name in "ab")
    assert again.ticks.equals(flight.ticks)
    assert again.frames.equals(flight.frames)


@pytest.mark.usefixtures("in_process_writer")
def test_a_finished_flight_is_kept_and_an_unfinished_one_is_flown_again(
    flight: RecordedFlight, tmp_path: Path
) -> None:
    kept, unfinished = tmp_path / "000000", tmp_path / "000001"
    shutil.copytree(flight.folder, kept)
    flown = replace(flight.meta, plan=flight.meta.plan | {"max_time_s": 1.0})
    write_meta(kept, flown)
    meta = (kept / "meta.json").read_text()
    unfinished.mkdir()
    write_meta(unfinished, replace(flown, finished=False, course_seed=30_001))
    (unfinished / "ticks.arrows").write_bytes(b"")
    assert demonstrate(config(tmp_path, episodes=2, max_time=1.0)) == 0
    assert (kept / "meta.json").read_text() == meta
    again = open_flight(unfinished)
    assert again.meta.course_seed == 30_001
    assert again.meta.finished
    assert again.meta.success is False  # a second does not reach the last gate
    sent_ns = again.ticks["sent_ns"].to_pylist()
    # A flight that starts in the air is recorded from 0.3 s on.
    assert 0.5e9 < sent_ns[-1] - sent_ns[0] < 1.1e9


@pytest.mark.parametrize(
    ("changes", "said", "is_finished"),
    [
        ({"courses": "race"}, "course seed 30000, not 1000030000", True),
        ({"policy": PolicyConfig(seed=4)}, "course seed 30000, not 40000", False),
        ({"action": "rates"}, "--action sticks, not rates", True),
        ({"autopilot": "px4"}, "--autopilot ardupilot, not px4", False),
        ({"speed": 9.0}, r"--speed 6\.0, not 9\.0", True),
        ({"max_time": 60.0}, r"--max-time 40\.0, not 60\.0", True),
        ({"policy": PolicyConfig(checkpoint=SHIPPED, seed=3)}, "--checkpoint none, not ", False),
        ({"policy": PolicyConfig(image_size=64, seed=3)}, "image_size 48, not 64", True),
    ],
)
def test_a_flight_of_other_settings_is_neither_counted_nor_overwritten(
    flight: RecordedFlight, tmp_path: Path, changes: dict[str, Any], said: str, is_finished: bool
) -> None:
    shutil.copytree(flight.folder, tmp_path / "000000")
    write_meta(tmp_path / "000000", replace(flight.meta, finished=is_finished))
    with pytest.raises(UserError, match=said):
        demonstrate(replace(config(tmp_path), **changes))
    assert (tmp_path / "000000/camera.mp4").is_file()


@pytest.mark.usefixtures("in_process_writer")
def test_no_other_student_goes_on_where_no_files_tell_two_apart(
    flight: RecordedFlight, tmp_path: Path
) -> None:
    meta = replace(flight.meta, source="dagger", policy="scripted:circle:air")
    (tmp_path / "000000").mkdir()
    write_meta(tmp_path / "000000", meta)
    wanted = [
        replace(config(tmp_path), policy=PolicyConfig(policy=f"scripted:{name}:air", seed=3))
        for name in ("circle", "square")
    ]
    assert demonstrate(wanted[0]) == 0
    with pytest.raises(UserError, match="--policy scripted:circle:air, not scripted:square:air"):
        demonstrate(wanted[1])


def kill_the_writer() -> bool:
    for child in multiprocessing.active_children():
        child.kill()
    return False


@pytest.mark.parametrize(
    ("act", "error"), [(lambda: True, EpisodeInterruptedError), (kill_the_writer, WriterDiedError)]
)
def test_a_demonstration_that_is_interrupted_or_loses_its_images_is_unfinished(
    tmp_path: Path, act: Callable[[], bool], error: type[Exception]
) -> None:
    spec = DemonstrationSpec(folder=tmp_path / "000000", seed=30_000, config=config(tmp_path))
    steps = count()
    with pytest.raises(error):
        fly_demonstration(spec, lambda: next(steps) >= 2_000 and act())  # 5 s of vehicle steps
    assert not open_flight(spec.folder).meta.finished


def test_a_slow_student_flies_along_its_plan_from_an_old_image() -> None:
    plan = np.arange(16, dtype=np.float32).reshape(1, 4, 4)
    assert from_now(plan, 1.5)[0, :, 0].tolist() == [6.0, 10.0, 12.0, 12.0]
    fast, slow = draw_variation(7), draw_variation(7, longest_solve_ns=400_000_000)
    assert 100_000_000 <= slow.delays.vision.offset_ns <= 400_000_000
    assert fast.delays.vision.offset_ns == 0
    assert replace(slow, delays=fast.delays) == fast, "all else is as without it"


@pytest.mark.usefixtures("in_process_writer")
def test_a_slow_student_sees_old_images_and_every_tick_has_a_label(tmp_path: Path) -> None:
    slow = replace(
        config(tmp_path, max_time=2.0),
        policy=PolicyConfig(checkpoint=SHIPPED, seed=3),
        solve_time=400.0,
    )
    assert demonstrate(slow) == demonstrate(slow) == 0
    with pytest.raises(UserError, match=r"\(--solve-time 400\.0, not 300\.0\)"):
        demonstrate(replace(slow, solve_time=300.0))
    with pytest.raises(UserError, match=r"\(--checkpoint [0-9a-f]{8}, not [0-9a-f]{8}\)"):
        demonstrate(replace(slow, policy=replace(slow.policy, checkpoint=SHIPPED_RATES)))
    ticks = open_flight(tmp_path / "000000").ticks
    ages_ns = np.array(ticks["sent_ns"]) - np.array(ticks["feature_captured_ns"])
    assert ages_ns.min() > 100_000_000
    assert len(set(ticks["chunk_serial"].to_pylist())) == ticks.num_rows > 100
    assert ticks["expert"].null_count == 0


STUDENT = """
from numpy import zeros
from policy.contract import Contract
class Single:
    contract = Contract(arrays="numpy")
    def predict(self, image, state, action_history, num_diffusion_steps):
        return zeros((1, self.contract.horizon, 4), "f4")
"""


@pytest.mark.usefixtures("in_process_writer")
def test_a_student_without_a_checkpoint_flies(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(STUDENT)
    spec = f"{tmp_path}/mine.py:Single"
    asked = replace(config(tmp_path / "a", max_time=1.0), policy=PolicyConfig(policy=spec))
    assert demonstrate(asked) == 0
    meta = open_flight(tmp_path / "a/000000").meta
    assert (meta.source, meta.policy, meta.mode, meta.action_hz) == ("dagger", spec, "single", 30)
    assert list(meta.policy_files) == [f"{tmp_path}/mine.py"]


REFUSING = f"""
from policy.errors import NoChunkError
calls = 0
{STUDENT.replace("return", "refuse_some(); return")}
def refuse_some():
    global calls
    calls += 1
    if calls % 7 in (2, 4):
        raise NoChunkError("not now")
"""


@pytest.mark.usefixtures("in_process_writer")
def test_labels_are_of_the_rows_own_solves_if_the_student_refuses_some(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "mine.py").write_text(REFUSING)
    monkeypatch.setattr(
        "mavbridge.commands.demonstrate_expert.expert_sticks",
        lambda _guide, _body, now_s: Sticks(0.0, 0.0, 0.0, now_s / 1e4),  # when it was asked
    )
    policy = PolicyConfig(policy=f"{tmp_path}/mine.py:Single", seed=3)
    asked = replace(config(tmp_path, max_time=1.5), policy=policy)
    fly_demonstration(
        DemonstrationSpec(folder=tmp_path / "000000", seed=30_000, config=asked), lambda: False
    )
    flight = open_flight(tmp_path / "000000")
    solved_ns = column(flight, "chunk_computed_ns") - column(flight, "predict_ns")
    assert len(solved_ns) > 10
    np.testing.assert_allclose(1e4 * column(flight, "expert")[:, 3], solved_ns / 1e9, atol=1e-3)


@pytest.mark.usefixtures("in_process_writer")
def test_a_scripted_student_lives_in_simulated_time(tmp_path: Path) -> None:
    sent = []
    for name in ("a", "b"):
        circle = PolicyConfig(policy="scripted:circle:air")
        assert demonstrate(replace(config(tmp_path / name, max_time=2.0), policy=circle)) == 0
        sent.append(column(open_flight(tmp_path / name / "000000"), "sent"))
    np.testing.assert_array_equal(*sent)


def test_student_and_expert_fly_in_turns_and_the_seed_decides_whose_it_is() -> None:
    def flown(seed: int) -> list[bool]:
        turns = TurnSchedule(seed)
        return [turns.is_students(5.0 + tick / 100) for tick in range(4_000)]

    flights = [flown(seed) for seed in range(12)]
    assert flown(0) == flights[0]
    assert {one[0] for one in flights} == {True, False}
    for one in flights:
        lengths = np.diff(np.flatnonzero(np.diff(one))) / 100
        assert lengths.min() >= 0.39
        assert lengths.max() <= 6.01
        assert 0.55 < np.mean(one) < 0.95


@pytest.mark.usefixtures("in_process_writer")
@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
def test_by_body_rates_races_are_demonstrated_and_read_back(
    tmp_path: Path, autopilot: AutopilotKind
) -> None:
    by_rates = replace(
        config(tmp_path, max_time=3.0), action="rates", courses="race", autopilot=autopilot
    )
    assert demonstrate(by_rates) == 0
    flight = open_flight(tmp_path / "000000")
    assert flight.meta.course_seed == COURSE_SEEDS["race"] + 30_000
    assert set(column(flight, "mode")) == {
        "GUIDED_NOGPS" if autopilot == "ardupilot" else "OFFBOARD"
    }
    first, *words = [row.expert for row in flight.tick_rows()]
    assert first is None or isinstance(first, BodyRates)  # the chunk may be from before
    assert {type(word) for word in words} == {BodyRates}
    data = read_flight(flight.folder)
    assert (data.contract.action, data.contract.hover_thrust) == ("rates", 0.39)
    assert 0.1 < np.abs(data.target).max() <= 1.0
    assert not data.sent.any()
    network = fit_to_flights(TogeConfig(), [data], TrainSettings(out=tmp_path / "a.safetensors"))
    assert (network.contract.action, network.contract.max_tilt_deg) == ("rates", 80.0)
    assert network.contract.stops_at_end
    assert network.contract.modes == ("GUIDED_NOGPS", "GUIDED", "OFFBOARD")


def test_a_student_is_flown_by_what_it_was_trained_for(tmp_path: Path) -> None:
    by_rates = replace(config(tmp_path), action="rates")
    student = replace(
        by_rates, policy=replace(by_rates.policy, image_size=None, checkpoint=SHIPPED)
    )
    with pytest.raises(UserError, match=r"flies by sticks, and the expert by rates \(--action\)"):
        demonstrate(student)
