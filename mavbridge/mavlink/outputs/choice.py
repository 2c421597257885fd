"""Which output carries the actions of a policy to a vehicle."""

from mavbridge.core.errors import PeerError
from mavbridge.core.vehicle import ActionMeaning, Output
from mavbridge.mavlink.codec.packets import Codec
from mavbridge.mavlink.outputs.manual_control import ManualControlOutput
from mavbridge.mavlink.outputs.output import ActionOutput
from mavbridge.mavlink.outputs.override import OverrideOutput


def choose_output(
    meaning: ActionMeaning, wanted: Output | None, *, autopilot: str, codec: Codec
) -> ActionOutput:
    """The output that was asked for, or the usual one of such actions and this vehicle.

    Raises:
        PeerError: this vehicle cannot be flown with it.
    """
    is_px4 = autopilot == "px4"
    name = wanted or ("manual-control" if is_px4 else "rc-override")
    if name == "rc-override" and is_px4:
        raise PeerError("PX4 cannot release an RC_CHANNELS_OVERRIDE: use --output manual-control")
    if name == "manual-control" and not is_px4:
        raise PeerError("ArduPilot cannot release a MANUAL_CONTROL: use --output rc-override")
    return ManualControlOutput(codec) if is_px4 else OverrideOutput(codec)
