"""The fit finds what made a synthetic response."""

import numpy as np
import pytest

from mavbridge.commands.identify.fit import Array, fit_response

INPUT_S = np.arange(0.0, 3.0, 0.01)
OUTPUT_S = np.arange(0.2, 2.9, 0.01) + 0.003
DOUBLET = np.where((INPUT_S > 0.5) & (INPUT_S < 1.7), 0.6, 0.0) - np.where(INPUT_S >= 1.7, 0.6, 0.0)


def respond(
    inputs: Array, *, dead_s: float, lag_s: float, up: float, down: float, offset: float = 0.0
) -> Array:
    """A lag of first order behind a dead time, integrated on a grid ten times finer."""
    step_s = 0.0005
    fine_s = np.arange(-1.0, 3.0, step_s)
    newest = np.searchsorted(INPUT_S, fine_s, side="right") - 1
    held = np.where(newest < 0, 0.0, inputs[np.clip(newest, 0, None)])
    wanted = np.where(held > 0, up * held, down * held)
    outputs, value = np.empty(len(fine_s)), 0.0
    for index, now in enumerate(wanted):
        outputs[index] = value
        value += (1 - np.exp(-step_s / lag_s)) * (now - value)
    return offset + np.interp(OUTPUT_S - dead_s, fine_s, outputs)


@pytest.mark.parametrize(
    ("dead_s", "lag_s", "up", "down", "noise"),
    [
        (0.08, 0.08, 30.0, 30.0, 0.0),
        (0.08, 0.08, 30.0, 30.0, 0.5),
        (0.02, 0.05, 200.0, 180.0, 3.0),
        (0.25, 0.40, 2.5, 1.5, 0.05),
        (0.0, 0.70, 1.0, 1.0, 0.02),
        (0.15, 0.10, -5.0, -4.0, 0.1),
    ],
)
def test_gains_of_both_sides_dead_time_and_lag_are_found(
    dead_s: float, lag_s: float, up: float, down: float, noise: float
) -> None:
    outputs = respond(DOUBLET, dead_s=dead_s, lag_s=lag_s, up=up, down=down, offset=0.3)
    outputs += np.random.default_rng(0).normal(0.0, noise, len(outputs))
    found = fit_response(INPUT_S, DOUBLET, OUTPUT_S, outputs)
    assert found is not None
    assert found.gain_up == pytest.approx(up, rel=0.05)
    assert found.gain_down == pytest.approx(down, rel=0.05)
    assert found.dead_time_s == pytest.approx(dead_s, abs=0.02)
    assert found.time_63_s == pytest.approx(dead_s + lag_s, rel=0.06)
    assert found.r_squared > 0.97


def test_an_input_that_never_rests_will_do() -> None:
    """As body rates are that a feedback has made."""
    inputs = 0.5 * np.sin(7 * INPUT_S) + 0.3 * np.sign(np.sin(3 * INPUT_S))
    outputs = respond(inputs, dead_s=0.03, lag_s=0.06, up=1.0, down=1.0)
    found = fit_response(INPUT_S, inputs, OUTPUT_S, outputs)
    assert found is not None
    assert (found.gain_up, found.gain_down) == (pytest.approx(1, rel=0.02),) * 2
    assert found.time_63_s == pytest.approx(0.09, abs=0.01)


def test_a_gust_does_not_move_the_result() -> None:
    outputs = respond(DOUBLET, dead_s=0.1, lag_s=0.15, up=30.0, down=30.0)
    clean = fit_response(INPUT_S, DOUBLET, OUTPUT_S, outputs)
    outputs += np.random.default_rng(1).normal(0.0, 0.2, len(outputs))
    outputs[130:140] += 25.0
    found = fit_response(INPUT_S, DOUBLET, OUTPUT_S, outputs)
    assert clean is not None
    assert found is not None
    assert found.gain_up == pytest.approx(clean.gain_up, rel=0.03)
    assert found.time_63_s == pytest.approx(clean.time_63_s, rel=0.1)
    assert found.r_squared < 0.99  # the gust is counted, though


def test_known_gains_are_kept() -> None:
    outputs = respond(DOUBLET, dead_s=0.1, lag_s=0.15, up=30.0, down=20.0)
    found = fit_response(INPUT_S, DOUBLET, OUTPUT_S, outputs, gains=(30.0, 20.0))
    assert found is not None
    assert (found.gain_up, found.gain_down) == (30.0, 20.0)
    assert found.time_63_s == pytest.approx(0.25, abs=0.01)


@pytest.mark.parametrize("outputs", [np.zeros(len(OUTPUT_S)), np.ones(5)])
def test_what_does_not_move_or_is_too_short_has_no_response(outputs: Array) -> None:
    assert fit_response(INPUT_S, DOUBLET, OUTPUT_S[: len(outputs)], outputs) is None


def test_a_motion_that_has_nothing_to_do_with_the_input_is_not_explained() -> None:
    outputs = np.random.default_rng(2).normal(0.0, 1.0, len(OUTPUT_S))
    found = fit_response(INPUT_S, DOUBLET, OUTPUT_S, outputs)
    assert found is not None
    assert found.r_squared < 0.3
