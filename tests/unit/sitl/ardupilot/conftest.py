import pytest

from helpers.ends import Ends


@pytest.fixture
def station():
    """The far end of an ArduPilot vehicle's link."""
    return Ends()
