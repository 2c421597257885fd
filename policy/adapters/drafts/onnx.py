"""Drafts of contract files from ONNX: its graphs say names and shapes of inputs and outputs."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from policy.adapters.drafts.entries import (
    Entry,
    action_entries,
    camera_entries,
    frame_entry,
    rate_entry,
    state_entries,
)
from policy.adapters.interface import UNANSWERED
from policy.adapters.onnx.files import read_graph
from policy.contract import ACTION_DIM, IMAGENET_MEAN_RGB, IMAGENET_STD_RGB


class _Port(NamedTuple):
    """An input or output."""

    name: str
    where: str
    shape: tuple[int | None, ...]
    """None where the size is open."""


def onnx_files(source: Path) -> list[Path]:
    """The graphs of a file, or of a folder; empty where it is neither."""
    if source.is_dir():
        return sorted(source.glob("*.onnx"))
    return [source] if source.suffix == ".onnx" and source.is_file() else []


def onnx_entries(files: Sequence[Path]) -> list[Entry]:
    """All that graphs say: names and sizes of image, state, history and chunk."""
    inputs, outputs = _ports(files)
    images = [port for port in inputs if len(port.shape) >= 4 and port.shape[-3] in (1, 3)]
    histories = [port for port in inputs if "history" in port.name and len(port.shape) >= 2]
    given = [port.shape for port in outputs]  # an input of the shape of an output is a hidden state
    others = [
        port
        for port in inputs
        if port not in images + histories and len(port.shape) >= 2 and port.shape not in given
    ]
    states = [port for port in others if "state" in port.name] or others
    chunks = [port for port in outputs if port.shape[-1:] == (ACTION_DIM,) and len(port.shape) > 1]
    entries = [rate_entry(None, ""), frame_entry(None, "to answer", ""), *action_entries(None, "")]
    for name, ports, axis in (
        ("image_height", images, -2),
        ("image_width", images, -1),
        ("history_len", histories, -2),
        ("horizon", chunks, -2),
    ):
        entries += [_size(name, port, axis) for port in ports[:1]]
    for port in images[:1]:
        kind = _NORMALISATION if port.shape[-3] == 3 else [_DEPTH]
        entries += [*kind, *camera_entries([port.name], port.where)]
    for port in states[:1]:
        key = Entry(table="state", name="key", value=port.name, origin="read", why=port.where)
        entries += [key, *state_entries(None, port.shape[-1] or 0, port.where)]
    return entries


_DEPTH = Entry(
    table="contract",
    name="image_channels",
    value="depth",
    origin="guessed",
    why="it takes one channel: depth in metres, 0 where it is not known",
)
_NORMALISATION = [
    Entry(
        table="contract",
        name=name,
        value=list(value),
        origin="guessed",
        why="it takes (rgb / 255 - mean) / std; zeros and ones for images in [0, 1]",
    )
    for name, value in (("image_mean_rgb", IMAGENET_MEAN_RGB), ("image_std_rgb", IMAGENET_STD_RGB))
]


def _size(name: str, port: _Port, axis: int) -> Entry:
    size = port.shape[axis]
    if size is None:
        why = f"{port.where} leaves its size open"
        return Entry(table="contract", name=name, value=UNANSWERED, origin="to answer", why=why)
    return Entry(table="contract", name=name, value=size, origin="read", why=port.where)


def _ports(files: Sequence[Path]) -> tuple[list[_Port], list[_Port]]:
    """Inputs and outputs of all graphs."""
    inputs: list[_Port] = []
    outputs: list[_Port] = []
    for file in files:
        model = read_graph(file)
        for kind, ports, found in (
            ("input", model.inputs, inputs),
            ("output", model.outputs, outputs),
        ):
            for port in ports:
                name = min(port.get_names(), default="")
                sizes = port.get_partial_shape()
                shape = tuple(size.get_length() if size.is_static else None for size in sizes)
                found.append(_Port(name, f"{kind} {name} of {file.name}", shape))
    return inputs, outputs
