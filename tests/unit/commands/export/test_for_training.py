"""What ``mavbridge export`` does for a policy that LeRobot trains: size, axes, contract file."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from helpers.flight_folders import write_meta, write_spot_flight
from helpers.lerobot_rules import broken_rules
from mavbridge.commands.config import ExportConfig
from mavbridge.commands.export.run import export, stretches
from policy.adapters.interface import BODY_STATE_NAMES, Interface, read_interface
from policy.contract import Contract
from policy.data.flight_data import DatasetError
from policy.data.flight_folders import read_flight
from policy.data.lerobot import read_dataset
from policy.data.lerobot_format import STATE_KEY
from policy.data.tables import vectors
from policy.errors import ContractError
from policy.preprocess import resize

USUAL = Contract()


def flight(folder: Path, contract: Contract = USUAL, size: int = 64) -> Path:
    write_spot_flight(folder, 1, seconds=1.0, size=size)
    write_meta(folder, contract=asdict(contract))
    return folder


def exported(flights: list[Path], out: Path, **options: object) -> Path:
    config = ExportConfig(out=out, task="race")
    assert export(flights, replace(config, **options)) == 0  # type: ignore[arg-type]
    assert broken_rules(out) == []
    return out


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
    kept = vectors("rows", pq.read_table(data), STATE_KEY, len(BODY_STATE_NAMES))
    np.testing.assert_allclose(kept, flown, atol=1e-6)
    mean = json.loads((out / "meta/stats.json").read_text())[STATE_KEY]["mean"]
    np.testing.assert_allclose(mean, flown.mean(axis=0), atol=1e-6)
    with pytest.raises(DatasetError, match=r"observation\.state has shape"):
        read_dataset(out)  # mavbridge train takes the world's axes
