import pytest

from helpers.ends import px4_ends


@pytest.fixture
def ends():
    return px4_ends()
