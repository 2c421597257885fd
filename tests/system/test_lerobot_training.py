"""Export a flight, train on it with LeRobot's own code, and fly what comes out.

LeRobot cannot share this project's environment. The environment variable names a Python that has
it, with policies, datasets and training (0.4 or newer): MAVBRIDGE_LEROBOT_PYTHON=/path/to/python.
"""

import json
import os
import subprocess
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import torch

from helpers.flight_folders import write_spot_flight
from helpers.policy_servers import when_it_listens
from mavbridge.__main__ import main
from mavbridge.commands.export import stretches
from mavbridge.core.processes import free_port, running
from policy.adapters.lerobot.plan import read_plan
from policy.adapters.lerobot.policy import load_policy_of
from policy.adapters.websocket.kind import load_server_policy
from policy.data.flight_folders import read_flight
from policy.data.lerobot_format import STATE_KEY
from policy.preprocess import image_to_input

PYTHON = os.environ.get("MAVBRIDGE_LEROBOT_PYTHON", "")
pytestmark = [
    pytest.mark.skipif(not PYTHON, reason="MAVBRIDGE_LEROBOT_PYTHON names no Python with LeRobot"),
]
SERVER = Path(__file__).parents[2] / "examples" / "servers" / "lerobot_server.py"
ROW = 20
TINY_ACT = (
    *("--policy.type=act", "--policy.device=cpu", "--policy.push_to_hub=false"),
    *("--policy.pretrained_backbone_weights=null", "--policy.use_vae=false"),
    *("--policy.chunk_size=8", "--policy.n_action_steps=4", "--policy.dim_model=32"),
    *("--policy.dim_feedforward=32", "--policy.n_heads=2", "--policy.n_encoder_layers=1"),
)
PREDICT = """
import json, sys
from pathlib import Path
import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_pre_post_processors

dataset, checkpoint, row, out = sys.argv[1:]
sample = LeRobotDataset("local/flights", root=dataset, video_backend="pyav")[int(row)]
policy = ACTPolicy.from_pretrained(checkpoint).eval()
before, after = make_pre_post_processors(policy.config, pretrained_path=checkpoint)
inputs = {key: sample[key] for key in policy.config.input_features}
image = sample["observation.images.front"].numpy()
chunk = after(policy.predict_action_chunk(before(inputs)))
np.savez(out, image=np.round(image * 255).astype(np.uint8), chunk=chunk.numpy())
"""


def lerobot(*arguments: str) -> None:
    """Run LeRobot's Python without a network, and without this project's own packages."""
    env = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    env |= {"HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [PYTHON, *arguments], env=env, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr[-3000:]


def mavbridge(*arguments: str) -> None:
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 0


@pytest.fixture(scope="module", params=["world", "body"])
def trained(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Sequence[Path]:
    """Flight, dataset and the policy's folder."""
    root = tmp_path_factory.mktemp(request.param)
    flight, dataset, run = root / "flight", root / "dataset", root / "run"
    write_spot_flight(flight, 3, size=64)
    options = ("--image-size", "48", "--state", request.param)
    mavbridge("export", str(flight), "--out", str(dataset), *options)
    lerobot(
        *("-m", "lerobot.scripts.lerobot_train", "--dataset.repo_id=local/flights"),
        *(f"--dataset.root={dataset}", "--dataset.video_backend=pyav", *TINY_ACT),
        *("--batch_size=2", "--num_workers=0", "--steps=2", "--save_freq=2"),
        *("--wandb.enable=false", f"--output_dir={run}"),
    )
    return flight, dataset, run / "checkpoints" / "000002" / "pretrained_model"


def test_a_row_of_the_dataset_gives_the_actions_that_lerobot_gives(
    trained: Sequence[Path], tmp_path: Path
) -> None:
    flight, dataset, checkpoint = trained
    out = tmp_path / "lerobot.npz"
    lerobot("-c", PREDICT, str(dataset), str(checkpoint), str(ROW), str(out))
    expected = np.load(out)
    policy, _ = load_policy_of(
        read_plan(checkpoint, dataset / "mavbridge.toml"), seed=0, num_diffusion_steps=1
    )
    (stretch,) = stretches(read_flight(flight))
    image = image_to_input(expected["image"].transpose(1, 2, 0), policy.contract)
    state = stretch.columns[STATE_KEY][ROW : ROW + 1].astype(np.float32)
    history = torch.zeros(1, policy.contract.history_len, 4)
    with torch.inference_mode():
        chunk = policy.predict(torch.from_numpy(image), torch.from_numpy(state), history, 1)
    assert policy.contract.chunk_dt_s == pytest.approx(1 / 30, abs=1e-6)
    np.testing.assert_allclose(chunk.numpy(), expected["chunk"], atol=1e-4)


def test_the_server_of_the_examples_gives_the_actions_that_are_computed_here(
    trained: Sequence[Path], tmp_path: Path
) -> None:
    _, dataset, checkpoint = trained
    contract_file, port = dataset / "mavbridge.toml", free_port()
    here, _ = load_policy_of(read_plan(checkpoint, contract_file), seed=0, num_diffusion_steps=1)
    contract, random = here.contract, np.random.default_rng(0)
    picture = random.integers(0, 256, (48, 48, 3), dtype=np.uint8)
    state = random.normal(size=(1, *contract.state_shape)).astype(np.float32)
    history = np.zeros((1, *contract.history_shape), np.float32)
    inputs = (image_to_input(picture, contract), state, history)
    with torch.inference_mode():
        expected = here.predict(*map(torch.from_numpy, inputs), 1).numpy()
    command = (PYTHON, str(SERVER), str(checkpoint), "--port", str(port))
    url = f"ws://127.0.0.1:{port}"
    with running(*command, log=tmp_path / "server.log"):
        remote, _ = when_it_listens(lambda: load_server_policy(url, contract_file), within_s=120)
        with closing(remote):
            image = image_to_input(picture, remote.contract)
            chunk = remote.predict(image, state, history, 1)
    np.testing.assert_allclose(chunk, expected, atol=1e-4)


def test_the_policy_flies_by_the_file_that_mavbridge_contract_finds(
    trained: Sequence[Path], tmp_path: Path
) -> None:
    _, dataset, checkpoint = trained
    mavbridge("contract", str(checkpoint))
    contract = checkpoint / "mavbridge.toml"
    assert contract.read_text() == (dataset / "mavbridge.toml").read_text()
    report = tmp_path / "report.json"
    mavbridge(
        *("evaluate", "--policy", f"lerobot:{checkpoint}", "--set-config", "network.engine=torch"),
        *("--episodes", "1", "--max-time", "3", "--json", str(report)),
    )
    contract.unlink()
    (flown,) = json.loads(report.read_text())["episodes"]
    assert flown["flown_s"] > 2.0
