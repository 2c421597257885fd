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
    """Exit status of the process. A signal before the flight gives 128 + its number, as in shells.

    docs/commands.md has the table for users.
    """

    DONE = 0
    """Success; a flight was flown and ended in order."""
    BUG = 1
    """Bug of mavbridge, shown with its traceback; the interpreter's own choice."""
    REFUSED = 2
    """A flag, file or policy cannot be used; also the status of the command line's parser."""
    NOT_FLOWN = 3
    """The vehicle, camera or network was not usable, or the vehicle never left the ground or was
    disarmed under the policy."""
    FAULT = 4
    """The policy flew, and a fault ended its flight."""
    DIFFERENT = 5
    """A replay differs from its recording by more than the tolerance."""
    CRASHED = 6
    """The policy flew without a fault, and the vehicle crashed or hit something."""


class UserError(MavbridgeError):
    """The request cannot be carried out as given."""


class PeerError(MavbridgeError):
    """The vehicle or server is absent, silent or incompatible."""

    exit_code = ExitCode.NOT_FLOWN


class CameraError(MavbridgeError):
    """A video source cannot be opened, or has died."""

    exit_code = ExitCode.NOT_FLOWN
