"""Flies each fault of the catalogue once; `make faults` flies them with every vehicle."""

import zlib

import pytest

from faults.run import MOST_STALL_MS, fly_scenario
from faults.scenario import load_catalogue

pytestmark = pytest.mark.system

SLACK_MS = 250.0
"""Added to the limits of the catalogue: other tests run on the same cores."""
CATALOGUE = load_catalogue()


@pytest.mark.parametrize("name", CATALOGUE)
def test_a_fault_ends_as_the_catalogue_says(name: str) -> None:
    scenario = CATALOGUE[name]
    if scenario.untested:
        pytest.skip(scenario.untested)
    variants = scenario.variants
    variant = variants[zlib.crc32(name.encode()) % len(variants)]
    verdict = fly_scenario(scenario, variant, slack_ms=SLACK_MS)
    if verdict.late and not verdict.wrong and verdict.stall_ms > MOST_STALL_MS:
        pytest.skip(
            f"this computer stood still for {verdict.stall_ms:.0f} ms in each of {verdict.runs} "
            f"flights, which proves nothing: {verdict.failures}"
        )
    assert verdict.passed, f"{variant.text}: {verdict.failures}\n{verdict.output}"
