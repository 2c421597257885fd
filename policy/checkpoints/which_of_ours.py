"""Which of this project's networks a state dict belongs to, by names and shapes."""

from collections.abc import Iterator, Mapping
from dataclasses import replace

import torch
from torch import Tensor

from policy.checkpoints.state_dicts import Shapes, misfits
from policy.checkpoints.tensors import shapes_of
from policy.contract import Contract
from policy.nets.names import BACKBONE_NAMES, SIZE_NAMES
from policy.nets.resnet_unet import ResnetUnet, ResnetUnetConfig
from policy.nets.toge import Toge, TogeConfig


def which_of_ours(state: Mapping[str, Tensor], contract: Contract) -> str:
    """What to do with weights that do not fit what was asked for, as a sentence.

    Every network is built without memory for its weights; all of them take about a second.
    """
    places = {spec: misfits(state, shapes) for spec, shapes in _networks(contract)}
    spec, problems = min(places.items(), key=lambda item: len(item[1]))
    if not problems:
        return f"It fits --policy {spec}"
    if 2 * len(problems) < len(state):
        some = "; ".join(problems[:2])
        return f"It is nearest to --policy {spec}, but for {len(problems)} weights: {some}"
    return (
        "It belongs to no network of this project: write a class that builds its own "
        "(--policy ./file.py:Class), which gets the file by --checkpoint"
    )


def _networks(contract: Contract) -> Iterator[tuple[str, Shapes]]:
    """A spec of each network, with the contract's dimensions, and the shapes of its weights."""
    with torch.device("meta"):
        toge = replace(contract, feature_dim=0, arrays="torch")
        for size in SIZE_NAMES:
            for backbone in BACKBONE_NAMES:
                config = TogeConfig(size=size, backbone=backbone, contract=toge)
                yield f"toge:{size}:{backbone}", shapes_of(Toge(config))
            net = ResnetUnet(ResnetUnetConfig(size=size, contract=toge))
            yield f"resnet-unet:{size}", shapes_of(net)
