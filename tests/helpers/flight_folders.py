"""Writer of small flight folders (docs/formats.md) for tests, without the recorder."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from policy.contract import Contract

LEVEL = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -9.80665)
MS = 1_000_000

_STATE, _STICKS, _VECTOR = (pa.list_(pa.float32(), width) for width in (13, 4, 3))


def write_meta(folder: Path, **changes: object) -> None:
    meta = {
        "format": "mavbridge-flight",
        "version": 1,
        "source": "demonstration",
        "contract": asdict(Contract()),
    }
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "meta.json").write_text(json.dumps({**meta, **changes}))


def ticks_table(
    *,
    woke_ns: Sequence[int],
    expert: Sequence[Sequence[float] | None] | None,
    sent: Sequence[Sequence[float] | None],
    state: Sequence[Sequence[float] | None] | None = None,
    captured_ns: Sequence[int | None] | None = None,
    solved_ns: Sequence[tuple[int | None, int | None]] | None = None,
    attitude_lag_ns: int = 0,
    sent_lag_ns: int = 0,
    armed: Sequence[bool] | None = None,
    rc_sticks: Sequence[Sequence[float] | None] | None = None,
    phase: Sequence[str] | None = None,
    mode: Sequence[str] | None = None,
) -> pa.Table:
    count = len(woke_ns)
    state = [LEVEL] * count if state is None else state
    pairs = zip(woke_ns, state, strict=True)
    attitude_ns = [None if s is None else w - attitude_lag_ns for w, s in pairs]
    computed_ns, predict_ns = zip(*(solved_ns or [(None, None)] * count), strict=True)
    columns = {
        "woke_ns": pa.array(woke_ns, pa.int64()),
        "sent_ns": pa.array([w + sent_lag_ns for w in woke_ns], pa.int64()),
        "chunk_computed_ns": pa.array(computed_ns, pa.int64()),
        "predict_ns": pa.array(predict_ns, pa.int64()),
        "feature_captured_ns": pa.array(captured_ns or [None] * count, pa.int64()),
        "state": pa.array(state, _STATE),
        "attitude_ns": pa.array(attitude_ns, pa.int64()),
        "velocity_ns": pa.array(attitude_ns, pa.int64()),
        "sent": pa.array(sent, _STICKS),
        "rc_sticks": pa.array(rc_sticks or [None] * count, _STICKS),
        "phase": pa.array(phase or ["flying"] * count),
        "mode": pa.array(mode or ["ALT_HOLD"] * count),
        "armed": pa.array([True] * count if armed is None else armed, pa.bool_()),
    }
    if expert is not None:
        columns["expert"] = pa.array(expert, _STICKS)
    return pa.table(columns)


def write_video(path: Path, images: Sequence[NDArray[np.uint8]]) -> None:
    movflags = "frag_every_frame+empty_moov+default_base_moof"
    with av.open(str(path), "w", options={"movflags": movflags}) as container:
        stream = container.add_stream("libx264", rate=30, options={"crf": "12", "bf": "0"})
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode(None))


def write_flight(
    folder: Path,
    ticks: pa.Table,
    *,
    captured_ns: Sequence[int],
    images: Sequence[NDArray[np.uint8]],
    gate_body_m: Sequence[Sequence[float] | None] | None = None,
    **meta: object,
) -> Path:
    write_meta(folder, **meta)
    pq.write_table(ticks, folder / "ticks.parquet")
    frames = {"captured_ns": pa.array(captured_ns, pa.int64())}
    if gate_body_m is not None:
        frames["gate_body_m"] = pa.array(gate_body_m, _VECTOR)
        frames["gate_yaw_rad"] = pa.array([0.0] * len(captured_ns), pa.float32())
        frames["gate_after_body_m"] = pa.array([None] * len(captured_ns), _VECTOR)
    pq.write_table(pa.table(frames), folder / "frames.parquet")
    write_video(folder / "camera.mp4", images)
    return folder


def spot(size: int, across: float) -> NDArray[np.uint8]:
    """Return a bright spot on grey, ``across`` from -1 (left edge) to 1."""
    image = np.full((size, size, 3), 90, np.uint8)
    centre = round((across + 1) / 2 * (size - 1))
    image[size // 3 : 2 * size // 3, max(0, centre - 3) : centre + 4] = (250, 220, 40)
    return image


def write_spot_flight(folder: Path, seed: int, *, seconds: float = 3.0, size: int = 32) -> Path:
    """Write a flight whose image alone determines the expert's yaw; the sent sticks are noise."""
    random = np.random.default_rng(seed)
    phase, pace = random.uniform(0, 2 * np.pi), random.uniform(0.8, 1.6)

    def across(at_ns: float) -> float:
        return float(np.sin(phase + pace * 2 * np.pi * (at_ns - 10**9) / 1e9 / 3))

    woke_ns = [10**9 + 10 * MS * index for index in range(round(100 * seconds))]
    captured_ns = [10**9 + 33 * MS * index for index in range(round(30 * seconds))]
    seen = [max((c for c in captured_ns if c <= w - 40 * MS), default=None) for w in woke_ns]
    return write_flight(
        folder,
        ticks_table(
            woke_ns=woke_ns,
            expert=[(0.0, 0.6 * across(w), 0.0, 0.0) for w in woke_ns],
            sent=random.uniform(-0.5, 0.5, (len(woke_ns), 4)).tolist(),
            captured_ns=seen,
        ),
        captured_ns=captured_ns,
        images=[spot(size, across(c)) for c in captured_ns],
        gate_body_m=[(5.0, 3.0 * across(c), 0.0) for c in captured_ns],
    )
