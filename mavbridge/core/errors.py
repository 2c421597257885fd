"""Every error that a user can cause or meet, in one tree.

    MavbridgeError
    +-- UserError      what was asked cannot be done: flag, file, port
    +-- PeerError      the vehicle or the network did not do its part
    +-- CameraError    a video source that cannot be opened, or that died
    +-- PolicyError    a policy, contract, checkpoint or dataset that cannot be used

The process ends with an ``ExitCode``. A message says what was wrong, what was available, and what
to do. Anything else that escapes is a bug of ours and shows its traceback.
"""

from enum import IntEnum

from policy.errors import MavbridgeError, PolicyError

__all__ = ["CameraError", "ExitCode", "MavbridgeError", "PeerError", "PolicyError", "UserError"]


class ExitCode(IntEnum):
    """Exit status of the process; a signal before the flight gives 128 + its number, as in shells.

    docs/commands.md has the table for users.
    """

    DONE = 0
    """What was asked was done; a flight was flown and ended in order."""
    BUG = 1
    """An error of ours, shown with its traceback; the interpreter's own choice."""
    REFUSED = 2
    """A flag, a file or a policy that cannot be used; also the parser's of the command line."""
    NOT_FLOWN = 3
    """The vehicle, the camera or the network did not do its part, or the vehicle never left the
    ground or was disarmed under the policy."""
    FAULT = 4
    """The policy flew, and a fault ended its flight."""
    DIFFERENT = 5
    """A replay differs from its recording by more than the tolerance."""
    CRASHED = 6
    """The policy flew without a fault, and the vehicle hit something or was seen to crash."""


class UserError(MavbridgeError):
    """The request cannot be carried out as given."""


class PeerError(MavbridgeError):
    """The other side is absent, wrong or silent."""

    exit_code = ExitCode.NOT_FLOWN


class CameraError(MavbridgeError):
    """A video source cannot be opened, or has died."""

    exit_code = ExitCode.NOT_FLOWN
