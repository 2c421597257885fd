import pytest

from helpers.fakes import FakeClock


@pytest.fixture
def clock():
    return FakeClock()
