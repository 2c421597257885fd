"""Flies faults of the catalogue; `make faults` flies all of them, with every vehicle."""

import zlib
from dataclasses import replace
from itertools import chain

import pytest

from faults.run import MOST_STALL_MS, fly_scenario
from faults.scenario import Scenario, load_catalogue

SLACK_MS = 250.0
"""Added to the limits of the catalogue: other tests run on the same cores."""
FLY_ON_S = 1.0
"""In place of the catalogue's: a vehicle that falls shows it at once."""
CATALOGUE = load_catalogue()
HARMLESS = (
    *("busy-thread", "wall-clock", "viewer-slow", "viewer-gone", "images-resized"),
    *("full-disk", "no-more-files", "loss"),
)
"""Faults that one policy flies through, one after the other."""


def assert_ends_as_told(scenario: Scenario) -> None:
    variants = scenario.variants
    variant = variants[zlib.crc32(scenario.name.encode()) % len(variants)]
    verdict = fly_scenario(scenario, variant, slack_ms=SLACK_MS, fly_on_s=FLY_ON_S)
    if verdict.late and not verdict.wrong and verdict.stall_ms > MOST_STALL_MS:
        pytest.skip(
            f"this computer stood still for {verdict.stall_ms:.0f} ms in each of {verdict.runs} "
            f"flights, which proves nothing: {verdict.failures}"
        )
    assert verdict.passed, f"{variant.text}: {verdict.failures}\n{verdict.output}"


@pytest.mark.parametrize("name", [name for name in CATALOGUE if name not in HARMLESS])
def test_a_fault_ends_as_the_catalogue_says(name: str) -> None:
    if CATALOGUE[name].untested:
        pytest.skip(CATALOGUE[name].untested)
    assert_ends_as_told(CATALOGUE[name])


def test_no_fault_of_these_ends_a_flight() -> None:
    rows = [CATALOGUE[name] for name in HARMLESS]
    assert all(row.outcome == "keeps" and not row.untested for row in rows)
    flags = chain.from_iterable(row.flags for row in rows)
    assert_ends_as_told(
        replace(
            rows[0],
            name="harmless",
            steps=tuple(chain.from_iterable(row.steps for row in rows)),
            flags=list(dict.fromkeys(flags)),
            environment=CATALOGUE["wall-clock"].environment,
            receivers=["mid"],
            says=CATALOGUE["full-disk"].says,
        )
    )
