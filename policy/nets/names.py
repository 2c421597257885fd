"""User-visible names of built-in policies, sizes and image encoders; imports no torch."""

from typing import Literal, get_args

BUILTIN_KINDS = ("toge", "toge-rates")

Size = Literal["small", "medium", "large"]
SIZE_NAMES: tuple[Size, ...] = get_args(Size)

BackboneName = Literal["resnet8", "resnet18", "resnet50"]
BACKBONE_NAMES: tuple[BackboneName, ...] = get_args(BackboneName)
