"""Every error that a user can cause or meet, in one tree.

    MavbridgeError
    +-- UserError      what was asked cannot be done: flag, file, port
    +-- PeerError      the vehicle or the network did not do its part
    +-- CameraError    a video source that cannot be opened, or that died
    +-- PolicyError    a policy, contract, checkpoint or dataset that cannot be used

A message says what was wrong, what was available, and what to do. Anything else that escapes is a
bug of ours and shows its traceback.
"""

from policy.errors import MavbridgeError, PolicyError

__all__ = ["CameraError", "MavbridgeError", "PeerError", "PolicyError", "UserError"]


class UserError(MavbridgeError):
    """The request cannot be carried out as given."""


class PeerError(MavbridgeError):
    """The other side is absent, wrong or silent."""


class CameraError(MavbridgeError):
    """A video source cannot be opened, or has died."""
