"""Flights to a LeRobot dataset and back, under the rules of lerobot's reader."""

import json
import signal
from collections.abc import Callable, Container
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from helpers.flight_folders import (
    LEVEL,
    MS,
    spot,
    ticks_table,
    write_flight,
    write_meta,
    write_spot_flight,
)
from helpers.lerobot_rules import require_readable
from helpers.status import status_of, told_by
from mavbridge.commands.config import ExportConfig
from mavbridge.commands.export import export, stretches, whole_or_nothing
from policy.adapters.interface import BODY_STATE_NAMES, Interface, read_interface
from policy.contract import Contract
from policy.data import lerobot_format as names
from policy.data.flight_folders import read_flight
from policy.data.lerobot import read_dataset
from policy.data.lerobot_format import STATE_KEY
from policy.data.tables import vectors
from policy.errors import ContractError, DatasetError
from policy.preprocess import resize

START = 10**9
SIZE = 48


def fly(
    folder: Path,
    *,
    frames: int = 30,
    period_ms: float = 33.0,
    expert: bool = True,
    released: range = range(0),
    refused: Container[int] = (),
    video_frames: int | None = None,
    size: int = SIZE,
    number: int = 0,
    **meta: object,
) -> Path:
    """A flight of 100 and 30 Hz in which every tick has a state and sticks of its own."""
    captured = [START + 7 * MS + round(k * period_ms * MS) for k in range(frames)]
    woke = list(range(START, captured[-1] + 50 * MS, 10 * MS))
    count = len(woke)
    state = [(0.01 * k, number, *LEVEL[2:]) for k in range(count)]
    sticks = [(-0.001 * k, 0.0, 0.0, 0.5) for k in range(count)]
    sent = [None if k in released or k in refused else sticks[k] for k in range(count)]
    labels = [(0.001 * k, 0.1, 0.2, 0.3) for k in range(count)] if expert else None
    shown = frames if video_frames is None else video_frames
    return write_flight(
        folder,
        ticks_table(
            woke_ns=woke,
            expert=labels,
            sent=sent,
            state=state,
            attitude_lag_ns=2 * MS,
            sent_lag_ns=1 * MS,
            phase=["released" if k in released else "flying" for k in range(count)],
        ),
        captured_ns=captured,
        images=[spot(size, 2 * k / frames - 1) for k in range(shown)],
        **meta,
    )


def exported(flights: list[Path], out: Path, **options: object) -> Path:
    config = ExportConfig(out=out, task="race")
    assert export(flights, replace(config, **options)) == 0  # type: ignore[arg-type]
    require_readable(out)
    return out


@pytest.fixture(scope="module")
def flights(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    root = tmp_path_factory.mktemp("flights")
    return [fly(root / str(k), frames=20 + 5 * k, number=k) for k in range(3)]


@pytest.fixture(scope="module")
def dataset(flights: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three episodes."""
    return exported(flights, tmp_path_factory.mktemp("exported") / "dataset")


def test_the_files_are_where_the_reader_looks(dataset: Path) -> None:
    files = [str(path.relative_to(dataset)) for path in dataset.rglob("*") if path.is_file()]
    assert sorted(files) == [
        *(f"data/chunk-000/file-00{k}.parquet" for k in range(3)),
        "mavbridge.toml",
        "meta/episodes/chunk-000/file-000.parquet",
        "meta/info.json",
        "meta/stats.json",
        "meta/tasks.parquet",
        *(f"videos/observation.images.front/chunk-000/file-00{k}.mp4" for k in range(3)),
    ]


def test_a_round_trip_keeps_rows_and_images(flights: list[Path], dataset: Path) -> None:
    for folder, back in zip(flights, read_dataset(dataset), strict=True):
        flight = read_flight(folder)
        assert back.contract.state_frame == flight.contract.state_frame
        np.testing.assert_array_equal(back.captured_ns, flight.captured_ns)
        (part,) = stretches(flight)  # whose rows the tests of rows compare with the flight
        for name, values in {
            names.STATE_KEY: back.state,
            names.ACTION_KEY: back.target,
            names.SENT: back.sent,
            names.ATTITUDE: back.attitude_ns,
            names.ACTED: back.target_ns,
            names.SENT_AT: back.sent_ns,
        }.items():
            np.testing.assert_array_equal(values, part.columns[name])
        before = np.stack(list(flight.decode())).astype(int)
        after = np.stack(list(back.decode())).astype(int)
        # closer to its own image than to the next one, every one of them
        own = np.abs(after - before).mean(axis=(1, 2, 3))
        assert own.max() < 3.0
        assert (own[:-1] < np.abs(after[:-1] - before[1:]).mean(axis=(1, 2, 3))).all()


def test_files_are_grouped_in_chunks(
    flights: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mavbridge.commands.export_dataset.FILES_A_CHUNK", 2)
    out = exported(flights, tmp_path / "out")
    assert [len(list(each.decode())) for each in read_dataset(out)] == [20, 25, 30]


def test_a_pause_makes_two_episodes(tmp_path: Path) -> None:
    flight = fly(tmp_path / "a", expert=False, released=range(40, 60), source="flight")
    first, second = read_dataset(exported([flight], tmp_path / "out"))
    np.testing.assert_array_equal(first.target, first.sent)  # there is no expert
    assert (first.target_ns <= first.captured_ns).all()
    released = (START + 400 * MS, START + 600 * MS)
    assert first.captured_ns[-1] <= released[0] + 33 * MS
    assert second.captured_ns[0] >= released[1] - 33 * MS
    images = list(read_flight(flight).decode())
    skipped = len(images) - len(second.captured_ns)
    error = np.abs(next(iter(second.decode())).astype(int) - images[skipped].astype(int))
    assert error.mean() < 3.0


def test_actions_that_the_link_refused_cut_no_episode(tmp_path: Path) -> None:
    refused = np.flatnonzero(np.random.default_rng(0).random(110) < 0.4).tolist()
    (whole,) = stretches(read_flight(fly(tmp_path / "a", expert=False)))
    (part,) = stretches(read_flight(fly(tmp_path / "b", expert=False, refused=refused)))
    np.testing.assert_array_equal(part.columns[STATE_KEY], whole.columns[STATE_KEY])


def test_a_video_that_breaks_off_ends_its_episode(tmp_path: Path) -> None:
    flights = [fly(tmp_path / "a", video_frames=12), fly(tmp_path / "b", number=1)]
    out = exported(flights, tmp_path / "out")
    assert [len(episode.captured_ns) for episode in read_dataset(out)] == [12, 30]


def test_statistics_are_those_of_the_data(dataset: Path) -> None:
    stats = json.loads((dataset / "meta/stats.json").read_text())
    back = read_dataset(dataset)
    state = np.concatenate([episode.state for episode in back]).astype(np.float64)
    found = stats["observation.state"]
    np.testing.assert_allclose(found["mean"], state.mean(axis=0), atol=1e-6)
    np.testing.assert_allclose(found["std"], state.std(axis=0), atol=1e-6)
    np.testing.assert_allclose(found["q90"], np.quantile(state, 0.9, axis=0), atol=1e-6)
    assert found["count"] == [75]
    images = np.concatenate([np.stack(list(episode.decode())) for episode in back]) / 255
    colours = stats["observation.images.front"]
    np.testing.assert_allclose(np.ravel(colours["mean"]), images.mean(axis=(0, 1, 2)), atol=0.02)
    np.testing.assert_allclose(np.ravel(colours["std"]), images.std(axis=(0, 1, 2)), atol=0.02)
    assert np.ravel(colours["q01"]).min() < np.ravel(colours["q50"]).min() < 0.4


def test_the_command_exports_what_train_can_read(tmp_path: Path) -> None:
    for k in range(2):
        fly(tmp_path / "flights" / str(k), number=k)
    fly(tmp_path / "flights" / "failed", success=False)
    out = tmp_path / "data[set]"
    status, text = told_by("export", tmp_path / "flights", "--out", out, "--task", "race")
    assert (status, "1 of 3 flights" in text, f"{out}: 2 episodes" in text) == (0, True, True)
    require_readable(out)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["data[set]", "flights"]
    assert [len(episode.captured_ns) for episode in read_dataset(out)] == [30, 30]
    small = ("--policy", "toge:small:resnet8", "--image-size", "32", "--steps", "1")
    status, text = told_by("train", out, "--out", tmp_path / "a.safetensors", *small)
    assert (status, "--ages" in text) == (0, True)  # the only thing that such a dataset lacks
    everything = ("export", tmp_path / "flights", "--out", tmp_path / "all", "--include-failed")
    status, text = told_by(*everything)
    assert (status, "left out" in text) == (0, False)
    assert len(read_dataset(tmp_path / "all")) == 3


def _flights(*each: dict[str, Any]) -> Callable[[Path], None]:
    def prepare(root: Path) -> None:
        for number, changes in enumerate(each):
            fly(root / "flights" / str(number), **changes)

    return prepare


def _other_clock(root: Path) -> None:
    folder = fly(root / "flights" / "a")
    table = pq.read_table(folder / "frames.parquet")
    late = pa.array([at + 10**12 for at in table["captured_ns"].to_pylist()], pa.int64())
    pq.write_table(table.set_column(0, "captured_ns", late), folder / "frames.parquet")


@pytest.mark.parametrize(
    ("prepare", "says"),
    [
        (_flights({}, {"size": 64}), "images of 64x64"),
        (_flights({}, {"period_ms": 66}), "here 15: export it apart"),
        (_flights({"period_ms": 640, "frames": 5}), "has 1.56 frames a second"),
        (_flights({}, {"contract": {"state_frame": "enu_flu"}}), "one kind at a time"),
        (
            _flights({}, {"contract": {"state_frame": "ned_frd", "yaw_dead_zone": 0.0}}),
            "yaw_dead_zone 0.04",
        ),
        (_flights({"success": False}), "have failed"),
        (_flights({"video_frames": 1}), "nothing to export"),
        (_other_clock, "of one clock"),
    ],
)
def test_bad_input_is_one_message_and_leaves_nothing(
    prepare: Callable[[Path], None], says: str, tmp_path: Path
) -> None:
    prepare(tmp_path)
    before = sorted(path.name for path in tmp_path.iterdir())
    status, text = told_by("export", tmp_path / "flights", "--out", tmp_path / "out")
    assert (status, says in text) == (2, True), text
    assert sorted(path.name for path in tmp_path.iterdir()) == before


def full(*_: object, **__: object) -> None:
    raise OSError(28, "No space left on device")


def interrupted(*_: object, number: int = signal.SIGINT, **__: object) -> None:
    assert signal.getsignal(number) is not signal.SIG_DFL
    signal.raise_signal(number)


@pytest.mark.parametrize(
    ("name", "act", "status"),
    [
        ("export_dataset.pq.write_table", full, 2),
        ("export.read_flights", interrupted, 130),
        ("export.read_flights", partial(interrupted, number=signal.SIGTERM), 130),
    ],
)
def test_nothing_is_left_of_an_export_that_breaks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, act: object, status: int
) -> None:
    flight = fly(tmp_path / "a")
    monkeypatch.setattr(f"mavbridge.commands.{name}", act)
    assert status_of("export", flight, "--out", tmp_path / "out") == status
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


@pytest.mark.parametrize("name", ["disk", "link"])
def test_a_folder_that_is_there_is_filled_and_not_replaced(tmp_path: Path, name: str) -> None:
    """It may be a mounted one."""
    (tmp_path / "disk").mkdir()
    (tmp_path / "link").symlink_to("disk")
    was = (tmp_path / "disk").stat().st_ino
    with whole_or_nothing(tmp_path / name) as part:
        (part / "meta").mkdir()
    assert [entry.name for entry in (tmp_path / "disk").iterdir()] == ["meta"]
    assert (tmp_path / "disk").stat().st_ino == was
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["disk", "link"]


USUAL = Contract()


def flight(folder: Path, contract: Contract = USUAL, size: int = 64) -> Path:
    write_spot_flight(folder, 1, seconds=1.0, size=size)
    write_meta(folder, contract=asdict(contract))
    return folder


def test_images_are_resized_as_a_policy_gets_them(tmp_path: Path) -> None:
    flights = [flight(tmp_path / "a"), flight(tmp_path / "b", size=96)]
    out = exported(flights, tmp_path / "out", image_size=48)
    for folder, back in zip(flights, read_dataset(out), strict=True):
        wanted = [resize(image, 48, 48) for image in read_flight(folder).decode()]
        found = list(back.decode())
        assert found[0].shape == (48, 48, 3)
        # Other pixels at the edges of colours alone, for the video keeps colours at half the size.
        assert np.abs(np.subtract(found, wanted, dtype=float)).mean() < 3.0


def test_the_contract_file_has_the_flights_rate_and_terms(tmp_path: Path) -> None:
    contract = Contract(
        modes=("LOITER",), full_lean_deg=45.0, yaw_dead_zone=0.1, max_feature_age_s=0.2
    )
    out = exported([flight(tmp_path / "a", contract)], tmp_path / "out")
    assert read_interface(out / "mavbridge.toml") == Interface(
        contract=replace(contract, chunk_dt_s=0.033333),
        state_names=contract.state_names,
        action_names=("throttle", "yaw", "pitch", "roll"),
        image_keys=("observation.images.front",),
        prompt="race",
    )
    (back,) = read_dataset(out)
    assert back.contract == replace(contract, max_feature_age_s=USUAL.max_feature_age_s)
    entries = (out / "mavbridge.toml").read_text()
    (out / "mavbridge.toml").write_text(entries.replace("lean_deg = 45.0", 'lean_deg = "?"'))
    with pytest.raises(DatasetError, match=r"mavbridge\.toml .*: full_lean_deg must be in .*'\?'"):
        read_dataset(out)


def test_terms_in_which_flights_differ_are_asked_of_the_user(tmp_path: Path) -> None:
    flights = [
        flight(tmp_path / "a", Contract(max_height_m=45.0)),
        flight(tmp_path / "b", Contract(max_tilt_deg=50.0)),
    ]
    out = exported(flights, tmp_path / "out") / "mavbridge.toml"
    with pytest.raises(
        ContractError, match=r"2 answers are missing: \[contract\] max_tilt_deg, .* max_height_m\."
    ):
        read_interface(out)
    assert "different ones: 45.0, null" in out.read_text()


def test_a_state_in_body_axes_is_what_the_policy_gets_in_flight(tmp_path: Path) -> None:
    folder = flight(tmp_path / "a")
    out = exported([folder], tmp_path / "out", state="body")
    interface = read_interface(out / "mavbridge.toml")
    assert interface.state_names == BODY_STATE_NAMES
    (stretch,) = stretches(read_flight(folder))
    flown = interface.to_state(stretch.columns[STATE_KEY].astype(np.float32))
    (data,) = (out / "data").rglob("*.parquet")
    kept = vectors("rows", pq.read_table(data), STATE_KEY)
    np.testing.assert_allclose(kept, flown, atol=1e-6)
    mean = json.loads((out / "meta/stats.json").read_text())[STATE_KEY]["mean"]
    np.testing.assert_allclose(mean, flown.mean(axis=0), atol=1e-6)
    with pytest.raises(DatasetError, match=r"observation\.state has shape"):
        read_dataset(out)  # mavbridge train takes the world's axes
