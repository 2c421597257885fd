"""Files that other users read, as that of a service, have the permissions of the umask."""

import os
import stat
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import rerun as rr
import rerun.blueprint as rrb
import torch

from helpers.factories import make_tick
from helpers.flight_folders import write_spot_flight
from helpers.recordings import make_frame, make_meta
from helpers.rollouts import TINY
from mavbridge.commands.config import ExportConfig
from mavbridge.commands.export import mcap_file
from mavbridge.commands.export.run import export
from mavbridge.core.files import write_durably
from mavbridge.observe.viewer.target import RerunRecording
from mavbridge.recording.flight_writer import FlightWriter
from mavbridge.recording.tlog import open_tlog_pipe
from policy.adapters.export import export_onnx, export_torchscript
from policy.checkpoints.networks import save_checkpoint, save_world_model
from policy.contract import Contract
from policy.data.flight_folders import read_flight
from policy.data.frames import store_frames
from policy.engines.openvino_compile import CompileCache
from policy.nets.toge import Toge, TogeConfig
from policy.nets.world_model.model import WorldModel
from policy.training.run_folder import RunFolder, TrainingPosition

ROOT = Path(__file__).parents[3]
UMASK = 0o027


def toge(size: int = 32) -> Toge:
    contract = Contract(image_height=size, image_width=size)
    return Toge(TogeConfig(backbone="resnet8", contract=contract)).eval()


def write_world_model(out: Path) -> None:
    save_world_model(out / "world.safetensors", WorldModel(TINY))


def write_training_state(out: Path) -> None:
    run = RunFolder(out / "run", "identity")
    run.save(TrainingPosition(), {"weights": torch.zeros(3)})
    run.log({"step": 1})


def write_decoded_frames(out: Path) -> None:
    store_frames([read_flight(write_spot_flight(out / "flight", 0, seconds=0.2))], out, 32)


def write_dataset(out: Path) -> None:
    flight = write_spot_flight(out / "flight", 0, seconds=0.5)
    assert export([flight], ExportConfig(out=out / "dataset", task="fly")) == 0


def write_mcap(out: Path) -> None:
    flight = ROOT / "examples" / "start"
    assert mcap_file.export([flight], ExportConfig(out=out / "mcap", format="mcap")) == 0


def write_recording(out: Path) -> None:
    (out / "flight").mkdir()
    pipe = open_tlog_pipe()
    pipe.writer.close()
    writer = FlightWriter(out / "flight", make_meta(), pressure="offline", tlog_pipe=pipe)
    for k in range(10):
        writer.tick(make_tick(k))
        writer.frame(make_frame(k))
    writer.finish(writer.meta)


def write_viewer_recording(out: Path) -> None:
    recording = RerunRecording("test", str(out / "flight.rrd"))
    recording.open(rrb.Blueprint())
    recording.stream.log("a", rr.Scalars(1.0))
    recording.close()


WRITERS: dict[str, tuple[Callable[[Path], object], set[str]]] = {
    "checkpoint": (
        lambda out: save_checkpoint(out / "toge.safetensors", toge()),
        {"toge.safetensors"},
    ),
    "packed checkpoint": (
        lambda out: save_checkpoint(out / "toge.safetensors", toge(), packed=True),
        {"toge.safetensors"},
    ),
    "world model": (write_world_model, {"world.safetensors"}),
    "onnx": (lambda out: export_onnx(toge(96), out), {"encoder.onnx", "denoiser.onnx"}),
    "torchscript": (lambda out: export_torchscript(toge(), out / "toge.pt"), {"toge.pt"}),
    "training state": (write_training_state, {"state.pt", "log.jsonl"}),
    "decoded frames": (write_decoded_frames, set()),
    "compiled graph": (lambda out: CompileCache(out).store("key", b"blob"), set()),
    "dataset": (write_dataset, {"info.json"}),
    "mcap": (write_mcap, {"start.mcap"}),
    "recording": (
        write_recording,
        {"camera.mp4", "frames.parquet", "link.tlog", "meta.json", "ticks.parquet"},
    ),
    "viewer's recording": (write_viewer_recording, {"flight.rrd"}),
    "report": (lambda out: write_durably(out / "report.json", "{}"), {"report.json"}),
}


@pytest.fixture(autouse=True)
def _umask() -> Iterator[None]:
    before = os.umask(UMASK)
    yield
    os.umask(before)


@pytest.mark.parametrize("writer", WRITERS)
def test_the_umask_decides_who_reads_a_file(writer: str, tmp_path: Path) -> None:
    write, names = WRITERS[writer]
    out = tmp_path / "out"
    out.mkdir()
    write(out)
    files = [path for path in out.rglob("*") if path.is_file()]
    assert files
    assert names <= {path.name for path in files}
    modes = {path: stat.S_IMODE(path.stat().st_mode) for path in files}
    assert {path.name for path, mode in modes.items() if mode != 0o666 & ~UMASK} == set()
    folders = [path for path in out.rglob("*") if path.is_dir()]
    assert {
        path for path in folders if stat.S_IMODE(path.stat().st_mode) != 0o777 & ~UMASK
    } == set()
