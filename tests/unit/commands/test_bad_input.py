"""What a user can get wrong: one message each, never a traceback, and no file is touched."""

import shlex
from dataclasses import asdict, replace
from pathlib import Path

import pytest

from helpers.flight_folders import write_meta, write_spot_flight
from helpers.recordings import make_meta
from helpers.rollouts import TINY, TinyWorld, write_flight
from helpers.status import told_by
from mavbridge.config.episodes import MAX_EVALUATION_SEED
from policy.checkpoints.networks import save_world_model
from policy.checkpoints.tensors import read_tensors, write_tensors
from policy.contract import Contract

ENU = Contract(state_frame="enu_flu")
IMAGINE = "imagine --ddim-steps 1 --out a.mp4"
START = f"{IMAGINE} --start flight --world-model world.safetensors"
TOGE = (
    "--decider toge --policy toge:small:resnet18 --set-config network.allow_untrained=true "
    "--set-config network.image_size=32 --set-config network.engine=torch --num-diffusion-steps 2"
)
FLY = "--connect udp:127.0.0.1:1"
BLIND = "--policy scripted --camera none"
RECORD = "record --out recorded"
LISTEN = f"{RECORD} --connect udp:127.0.0.1:14999"
LONG = "n" * 300
"""A name that no file system takes. A folder that is forbidden to the user fails alike."""
TRAIN = "train spots --out a.safetensors"
TRAIN_WORLD = "train-world-model spots --out a.safetensors"

BAD = [
    ("", "--connect"),
    (f"{FLY} --fly-high", "Unknown option: --fly-high"),
    (f"{FLY} --set-config rates.action=fast", "Invalid value for --rates.action"),
    (f"{FLY} --readonly --arm", "--readonly sends nothing"),
    (f"{FLY} --set RC_OVERRIDE_TIME", "use NAME=VALUE"),
    (f"{FLY} --set-config link.accept_risk=all", "endless-override"),
    (f"{FLY} --config none.toml", "none.toml"),
    (f"{FLY} --gates none.json", "--gates none.json"),
    (f"{FLY} --policy toge:medium", "network.allow_untrained"),
    (f"{FLY} --policy tog", "tog"),
    (f"{FLY} --policy nowhere.at_all:Policy", "nowhere"),
    (f"{FLY} --camera none --policy pathlib:Path", "its member contract"),
    (f"{FLY} --policy scripted:loop", "square"),
    (f"{FLY} --policy scripted:yaw:position", "velocity"),
    (f"{FLY} --checkpoint no.safetensors", "no.safetensors"),
    (f"{FLY} --checkpoint corrupt.safetensors", "corrupt.safetensors"),
    (f"{FLY} --policy toge:huge", "small"),
    (f"{FLY} --policy scripted --camera no.mp4", "no.mp4"),
    (f"{FLY} --policy scripted --rerun flight.txt", ".rrd"),
    (f"{FLY} --policy scripted --record foreigners", "is not empty"),
    (f"{FLY} --policy scripted --record taken.mp4", "cannot be written"),
    (f"{FLY} --mode", "--mode requires an argument"),
    (f"fly now {FLY}", "unexpected word 'now'"),
    (f"identify {FLY} --policy tog", "tog"),
    (f"identify {FLY} --json /proc/none/x.json", "--json"),
    ("identify --arm", "--connect"),
    ("evalute", "did you mean evaluate?"),
    (f"--connect /dev/null,57600 {BLIND}", "no serial port"),
    (f"--connect /dev/none,57600 {BLIND}", "no such"),
    (f"--connect bluetooth {BLIND} --record recorded --report a.mp4", "HOST:PORT"),
    *(
        (f"--connect nowhere {flag}", "--connect 'nowhere' is not understood")
        for flag in ("--dual-rate", "--no-dual-rate", "--single-rate")
    ),
    ("--connect udp:127.0.0.1:1 --log-file /proc/x/y", "cannot write --log-file /proc/x/y"),
    *(
        (f"{words}{LONG}/x.safetensors", "File name too long")
        for words in (
            *(f"{FLY} {BLIND} --record ", f"{FLY} --checkpoint ", f"{FLY} --policy onnx:"),
            *("contract ", "demonstrate --out ", "export-policy --out ", f"{TRAIN} --start-from "),
        )
    ),
    ("check --connect none --policy none --soak 60", "--soak needs a policy"),
    ("contract empty", "neither a LeRobot policy"),
    ("contract broken.onnx", "broken.onnx cannot be read as ONNX"),
    ("contract act --dataset foreign-words", "mavbridge.toml cannot be copied"),
    ("demonstrate --out /proc/none --episodes 1", "--out /proc/none"),
    ("demonstrate --out new --seed 100", "--seed must be between 0 and"),
    ("demonstrate --out new --solve-time 100", "solve time: the expert has none"),
    ("demonstrate --out new --policy toge-rates", "policy: the expert has none"),
    ("demonstrate --out new --by-rates --device banana", "by rates, device: the expert has none"),
    ("demonstrate --out new --single-rate", "leave out --single-rate"),
    ("demonstrate --out foreigners --episodes 1", "no recorded flight"),
    (f"evaluate --seed {MAX_EVALUATION_SEED + 1}", "--seed must be between 0 and"),
    ("evaluate --resume", "--resume needs the --json FILE"),
    ("evaluate --conditions stormy", "--conditions"),
    ("evaluate --set-config rates.action=0", "between 0.5 and 500 Hz"),
    ("evaluate --policy toge:medium", "network.allow_untrained"),
    ("evaluate --policy scripted --json /proc/none/out.json", "cannot write"),
    ("evaluate --policy scripted --json /", "cannot write --json /"),
    ("evaluate --policy scripted --ray cluster", "--ray cluster: nothing answers there"),
    ("export foreign --out new", "not of a recorded flight"),
    ("export spots --out foreigners", "not empty"),
    ("export spots --out left", "was killed"),
    ("export spots --out .", "name a new folder"),
    ("export spots --out taken.mp4/new", "--out taken.mp4/new cannot be written"),
    ("export spots --out new --image-size 0", "--image-size"),
    ("export spots --out new --image-size 97", "--image-size"),
    ("export spots --out new --image-size 5000", "--image-size"),
    ("export spots --out new --task ' '", "--task"),
    ("export spots --out new --task caf\udce9", "--task"),
    ("export spots --out caf\udce9", "is not UTF-8: rename it"),
    (f"{IMAGINE} --start flight --world-model caf\udce9.safetensors", "is not UTF-8: rename it"),
    ("export-policy --out new --policy scripted", "policies of toge are exported"),
    ("export-policy --out new --policy toge:medium", "needs trained weights"),
    ("export-policy --out taken.mp4", "is taken"),
    ("export-policy --out taken.mp4/onnx", "--out taken.mp4/onnx cannot be written"),
    ("identify --connect udp:127.0.0.1:1 --readonly", "--readonly"),
    (f"{START} --exe-steps 5 --frames 4", "--exe-steps 5 exceeds --frames 4"),
    (f"{START} --frames 17", "--frames 17 is more than the 16"),
    (f"{START} --exe-steps 17", "--exe-steps 17 is more than the 16"),
    ("imagine --start flight --out a.mp4 --ddim-steps 101", "1..100"),
    (f"{START} --start-at 5", "no image within 0.05 s of 5.10 s"),
    (f"{START} --decider toge --policy toge:medium", "--checkpoint"),
    (f"{START} --checkpoint a.safetensors", "add --decider toge"),
    (f"{START} --policy onnx:a --single-rate", "policy, dual rate: not of --decider world-model"),
    (f"{START} {TOGE} --fast-policy-no-decode", "fast policy no decode: not of --decider toge"),
    (f"{START} --decider pilot", "pilot"),
    (f"{START} --device cuda:9", "cuda:9 is not available"),
    (f"{IMAGINE} --start nowhere", "no folder nowhere"),
    (f"{IMAGINE} --start empty", "empty is empty"),
    (f"{IMAGINE} --start foreign", "is not of a recorded flight"),
    (f"{IMAGINE} --start enu", "trained with state_frame ned_frd, --start enu has enu_flu"),
    (f"{IMAGINE} --start enu --world-model enu.safetensors {TOGE}", "enu_flu"),
    (f"{IMAGINE} --start flight --world-model none.safetensors", "none.safetensors"),
    (f"{IMAGINE} --start flight --world-model taken.mp4", "taken.mp4"),
    (f"{IMAGINE} --start flight --world-model broken.safetensors", "NaN or infinity"),
    ("imagine --start flight --out taken.mp4", "taken.mp4 is there already"),
    ("imagine --start flight --out a.avi", "must end in .mp4"),
    ("imagine --start flight --out taken.mp4/a.mp4", "cannot write --out"),
    ("check --connect none --policy none --json /dev/full", "cannot write --json /dev/full"),
    ("inspect flight --json /dev/full", "cannot write --json /dev/full"),
    ("inspect flight --html /dev/full", "cannot write --html /dev/full"),
    ("inspect nowhere --rerun nonsense", "--rerun"),
    ("inspect [a]", "no folder [a]"),
    ("replay flight --plot sticks.txt", "name a file that ends in .png"),
    (RECORD, "name the vehicle: --connect"),
    (f"{RECORD} --connect udp:nowhere", "udp:nowhere"),
    (f"{LISTEN} --camera none", "nothing to learn from without images"),
    (f"{LISTEN} --camera nowhere.mp4", "no such file"),
    (f"{LISTEN} --on-arm --episode-channel 7", "leave one out"),
    ("train --out a.safetensors", "name the flights"),
    ("train spots", "--out"),
    ("train spots --out a.pt", ".safetensors"),
    ("train spots --out no/a.safetensors", "no folder no"),
    ("train missing --out a.safetensors", "no such folder"),
    ("train foreign --out a.safetensors", "not of a recorded flight"),
    (f"{TRAIN} --policy scripted", "cannot be trained"),
    (f"{TRAIN} --policy toge:huge", "neither a size"),
    (f"{TRAIN} --device cuda:9", "not available"),
    (f"{TRAIN} --ages 90:40", "LOW:HIGH"),
    (f"{TRAIN} --ages few:many", "LOW:HIGH"),
    (f"{TRAIN} --batch-size 1", "--batch-size must be between 2 and"),
    (f"{TRAIN} --minutes nan", "--minutes"),
    (f"{TRAIN} --steps 1 --minutes 1", "contradict"),
    (f"{TRAIN} --start-from b.safetensors", "no such file"),
    ("train spots --out folder.safetensors --steps 1", "folder.safetensors: Is a directory"),
    (f"{TRAIN} --camera-key front", "these flights have one"),
    ("train two --out a.safetensors", "several cameras ['down', 'front']: name one by"),
    ("train two --out a.safetensors --camera-key up", "no camera up; it has ['down'"),
    (f"{TRAIN} --policy=world-model --pack", "has a command of its own"),
    (f"{TRAIN_WORLD} --ages 40:90", "Unknown option"),
    (f"{TRAIN_WORLD} --start-from b.safetensors", "no such file"),
    (f"{TRAIN_WORLD} --image-size 40", "multiple of 16"),
    (TRAIN_WORLD, "fly longer"),
]
"""Command lines, and what they are told."""


def save_broken_world_model(path: Path) -> None:
    """Weights that are finite, although nothing that they make is."""
    model = TinyWorld()
    for weight in model.dynamics.parameters():
        weight.data.fill_(1e30)
    save_world_model(path, TinyWorld())
    header, _ = read_tensors(path)
    weights = {name: value.contiguous() for name, value in model.state_dict().items()}
    write_tensors(path, weights, header)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Flights, world models, and things that are neither."""
    folder = tmp_path_factory.mktemp("stock")
    write_flight(folder / "flight")
    write_flight(folder / "enu", meta=make_meta(contract=ENU))
    write_spot_flight(folder / "spots", 0, seconds=0.3)
    two = write_spot_flight(folder / "two", 0, seconds=0.3)
    write_meta(two, contract=asdict(Contract(cameras=("down", "front"))))
    write_meta(folder / "foreign", format="something else")
    (folder / "empty").mkdir()
    (folder / "left/.unfinished").mkdir(parents=True)
    (folder / "folder.safetensors").mkdir()
    for name, text in (
        ("act/config.json", b"{}"),
        ("foreign-words/meta/info.json", b"{}"),
        ("corrupt.safetensors", b"these are no weights"),
        ("foreign-words/mavbridge.toml", "Flüge".encode("latin-1")),
    ):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(text)
    (folder / "broken.onnx").write_bytes(b"not a graph")
    (folder / "foreigners/000000").mkdir(parents=True)
    (folder / "foreigners/000000/thesis.tex").write_text("years of work")
    for name in ("world", "caf\udce9"):
        save_world_model(folder / f"{name}.safetensors", TinyWorld())
    save_world_model(folder / "enu.safetensors", TinyWorld(replace(TINY, contract=ENU)))
    save_broken_world_model(folder / "broken.safetensors")
    (folder / "taken.mp4").write_text("precious")
    return folder


def contents(folder: Path) -> dict[Path, int]:
    """All files and folders, and when they were changed."""
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*")}


@pytest.mark.parametrize(("command", "told"), BAD)
def test_bad_input_is_one_message(
    command: str, told: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    before = contents(folder)
    status, text = told_by(*shlex.split(command))
    assert status == 2
    assert told in text
    after = contents(folder)
    assert {path: after.get(path) for path in before} == before
    assert not {"a.mp4", "a.safetensors", "recorded"} & {path.name for path in after}
