"""Episodes in video files: which file, from when to when."""

from pathlib import Path

import av
import numpy as np
import pytest

from mavbridge.commands.export import files
from mavbridge.commands.export.files import DatasetSpec, VideoFiles, VideoSpan

FPS = 10


def write(folder: Path, lengths: list[int], limit_bytes: int = 10**9) -> list[VideoSpan]:
    spec = DatasetSpec(
        fps=FPS,
        height=32,
        width=32,
        state_frame="ned_frd",
        task="fly",
        video_file_bytes=limit_bytes,
    )
    video = VideoFiles(folder, spec)
    spans = []
    random = np.random.default_rng(0)
    for length in lengths:
        video.begin(length)
        for _ in range(length):
            video.append(random.integers(0, 255, (32, 32, 3), np.uint8))
        spans.append(video.end())
    video.close()
    return spans


def test_episodes_follow_each_other_in_a_file(tmp_path: Path) -> None:
    first, second = write(tmp_path, [5, 7])
    assert (first.file_index, first.from_s, first.to_s) == (0, 0.0, 0.5)
    assert (second.file_index, second.from_s, second.to_s) == (0, 0.5, 1.2)
    (path,) = tmp_path.rglob("*.mp4")
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        frames = [(f.pts * stream.time_base, f.key_frame) for f in container.decode(stream)]
        assert stream.average_rate == FPS
    assert [float(at) for at, _ in frames] == [k / FPS for k in range(12)]
    assert frames[0][1]
    assert frames[5][1]  # decoded without the episode before it


def test_a_file_that_would_grow_too_large_is_followed_by_another(tmp_path: Path) -> None:
    spans = write(tmp_path, [5, 5, 5], limit_bytes=10_000)
    sizes = [path.stat().st_size for path in sorted(tmp_path.rglob("*.mp4"))]
    assert len(sizes) > 1
    assert max(sizes) < 12_000
    assert all(span.from_s == 0 for span in spans if span.file_index != spans[0].file_index)


def test_a_file_that_would_grow_too_long_is_followed_by_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(files, "MAX_FILE_S", 1.0)
    spans = write(tmp_path, [5, 5, 1, 20])
    assert [span.file_index for span in spans] == [0, 0, 1, 2]


def test_files_are_grouped_in_chunks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "FILES_A_CHUNK", 2)
    spans = write(tmp_path, [2, 2, 2], limit_bytes=1)
    assert [(span.chunk_index, span.file_index) for span in spans] == [(0, 0), (0, 1), (1, 0)]
