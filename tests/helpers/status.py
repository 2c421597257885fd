"""The command line, run inside the test."""

import pytest

from mavbridge.__main__ import main


def status_of(*arguments: object) -> int:
    """Exit status of ``mavbridge`` with these arguments."""
    with pytest.raises(SystemExit) as stopped:
        main([str(argument) for argument in arguments])
    assert isinstance(stopped.value.code, int)
    return stopped.value.code
