"""An interrupted evaluation goes on: with the same flags and weights, and with no others."""

import errno
import json
import os
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from helpers.evaluated_flights import finished
from mavbridge.commands.evaluate import EpisodeSpec, FlownEpisode, evaluate
from mavbridge.config.episodes import EvaluateConfig, WorkersConfig
from mavbridge.config.policy import PolicyConfig
from mavbridge.core.errors import PeerError, UserError
from mavbridge.core.files import write_output
from mavbridge.core.reasons import Code, because


class Flights:
    """Stands in for the simulator: remembers what was flown, and fails once at an index."""

    def __init__(self) -> None:
        self.flown: list[int] = []
        self.fails_at: int | None = None
        self.path: Path | None = None
        self.on_disk: list[int] = []
        """Flights in the file at ``path`` as each one ends."""

    def fly(self, spec: EpisodeSpec, _: Any) -> FlownEpisode:
        if spec.index == self.fails_at:
            raise PeerError("the vehicle is gone")
        self.flown.append(spec.index)
        if spec.index and self.path is not None:
            self.on_disk.append(len(json.loads(self.path.read_text())["episodes"]))
        result = finished(
            course_seed=spec.course_seed,
            seed=spec.seed,
            distance_m=30.0 + spec.index,
            lost=because(Code.TOO_SLOW, chunks=5, age_ms=9.5, limit_ms=5.0) if spec.index else None,
        )
        return FlownEpisode(engine="numpy", result=result)


@pytest.fixture
def flights(monkeypatch: pytest.MonkeyPatch) -> Flights:
    made = Flights()
    monkeypatch.setattr(f"{evaluate.__module__}.fly_simulated", made.fly)
    return made


@pytest.fixture
def config(tmp_path: Path) -> EvaluateConfig:
    policy = PolicyConfig(policy="scripted:circle", seed=3)
    return EvaluateConfig(policy=policy, episodes=5, json=tmp_path / "out.json", resume=True)


def test_what_was_flown_is_on_disk_and_not_flown_again(
    flights: Flights, config: EvaluateConfig, tmp_path: Path
) -> None:
    flights.fails_at, flights.path = 3, config.json
    with pytest.raises(PeerError):
        evaluate(config)
    flights.fails_at = None
    assert evaluate(config) == 0
    assert flights.on_disk == [1, 2, 3, 4], "each flight, as the next one begins"
    assert flights.flown == [0, 1, 2, 3, 4]
    flights.path = None
    at_once = replace(config, json=tmp_path / "at_once.json")
    evaluate(at_once)
    assert config.json.read_text() == at_once.json.read_text()


def test_a_full_disk_ends_the_evaluation_and_keeps_its_results(
    flights: Flights, config: EvaluateConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    evaluate(replace(config, episodes=2))
    text = config.json.read_text()

    def fail(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(UserError, match=r"cannot write --json .*/out.json: No space left"):
        evaluate(config)
    assert flights.flown == [0, 1, 2]
    assert config.json.read_text() == text
    assert [*config.json.parent.iterdir()] == [config.json]


def test_a_link_planted_for_the_temporary_file_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / f"out.{os.getpid()}-{threading.get_native_id()}").symlink_to(tmp_path / "victim")
    write_output(tmp_path / "out.json", "caf\udce9", "--json")
    text = r"caf\udce9"
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"out.json": text}


@pytest.mark.parametrize("number", [errno.EBUSY, errno.EROFS])
def test_a_file_that_cannot_be_replaced_is_written_in_place(
    number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Such as one that is mounted into a container."""

    def fail(_temporary: Path, _target: Path) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(Path, "replace", fail)
    write_output(tmp_path / "out.json", "caf\udce9", "--json")
    text = r"caf\udce9"
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"out.json": text}


def test_more_episodes_and_workers_go_on_and_fewer_lose_none(
    flights: Flights, config: EvaluateConfig
) -> None:
    evaluate(config)
    evaluate(replace(config, episodes=7, workers=WorkersConfig(workers=1)))
    text = config.json.read_text()
    with pytest.raises(UserError, match="holds 7 flights"):
        evaluate(replace(config, episodes=2))
    assert flights.flown == [0, 1, 2, 3, 4, 5, 6]
    assert config.json.read_text() == text


def test_flights_by_other_flags_or_weights_are_not_mixed(
    flights: Flights, config: EvaluateConfig, tmp_path: Path
) -> None:
    weights = tmp_path / "weights.safetensors"
    weights.write_text("one")
    config = replace(config, policy=replace(config.policy, checkpoint=weights))
    evaluate(config)
    with pytest.raises(UserError, match="other flags, weights or versions"):
        evaluate(replace(config, gusts=1.0))
    weights.write_text("another")
    with pytest.raises(UserError, match="other flags, weights or versions"):
        evaluate(config)


@pytest.mark.parametrize("text", ["", "[]", '{"flown_by": 1, "engine": "", "episodes": [{}]}'])
def test_a_file_that_is_no_evaluation_is_refused_and_kept(
    config: EvaluateConfig, text: str
) -> None:
    config.json.write_text(text)
    with pytest.raises(UserError, match="no evaluation that can go on"):
        evaluate(config)
    assert config.json.read_text() == text
