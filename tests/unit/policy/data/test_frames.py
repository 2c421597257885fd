from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from helpers.flight_folders import write_spot_flight
from policy.contract import Contract
from policy.data import frames as dataset_frames
from policy.data.flight_data import FlightData
from policy.data.flight_folders import read_flight
from policy.data.frames import shifted, store_frames
from policy.errors import DatasetError
from policy.preprocess import image_to_input
from policy.training.batches import normalise_image


@pytest.fixture(scope="module")
def episode(tmp_path_factory: pytest.TempPathFactory) -> FlightData:
    return read_flight(write_spot_flight(tmp_path_factory.mktemp("f") / "a", 0, seconds=0.4))


def test_training_and_flight_prepare_images_alike(episode: FlightData, tmp_path: Path) -> None:
    """Stored at the net's size and normalised for a step: the same as image_to_input."""
    contract = Contract(image_height=20, image_width=20)
    images, proportions = store_frames([episode], tmp_path / "frames", 20)
    assert proportions == [1.0]
    image = torch.from_numpy(images[[3]])
    planes = normalise_image(image.permute(0, 3, 1, 2).float() / 255, contract)
    expected = image_to_input(list(episode.decode())[3], contract)
    np.testing.assert_allclose(planes.numpy(), expected, atol=1e-6)


def test_a_shift_moves_down_and_right_and_repeats_the_edge() -> None:
    image = np.arange(16, dtype=np.uint8).reshape(1, 4, 4, 1).repeat(3, axis=3)
    moved = shifted(image, np.array([[1, -1]]))[0, :, :, 0]
    assert moved[0].tolist() == [1, 2, 3, 3]
    assert moved[1].tolist() == [1, 2, 3, 3]
    assert moved[3].tolist() == [9, 10, 11, 11]


def test_a_disk_without_room_is_refused_before_decoding(episode, tmp_path, monkeypatch):
    full = SimpleNamespace(free=1000)
    monkeypatch.setattr(dataset_frames.shutil, "disk_usage", lambda path: full)
    with pytest.raises(DatasetError, match=r"0\.0 GB are free"):
        store_frames([episode], tmp_path / "frames", 32)
    assert not list(tmp_path.iterdir())
