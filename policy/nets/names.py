"""User-visible names of sizes and image encoders; imports no torch."""

from typing import Literal, get_args

Size = Literal["small", "medium", "large"]
SIZE_NAMES: tuple[Size, ...] = get_args(Size)

BackboneName = Literal["resnet8", "resnet18", "resnet50"]
BACKBONE_NAMES: tuple[BackboneName, ...] = get_args(BackboneName)
