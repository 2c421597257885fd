import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from policy.motion.controllers import PROGRAM_NAMES
from policy.motion.scripted import ScriptedPolicy

FEATURE, HISTORY = np.zeros((1, 8), np.float32), np.zeros((1, 4, 4), np.float32)
STATES = st.lists(st.floats(-50, 50, width=32), min_size=13, max_size=13)
TICKS = st.lists(st.tuples(st.floats(0, 5), STATES), min_size=1, max_size=10)


@given(program=st.sampled_from(PROGRAM_NAMES), ticks=TICKS)
def test_any_flight_gives_finite_sticks_in_range(program, ticks):
    now_s = 0.0
    policy = ScriptedPolicy(program, lambda: now_s)
    for step_s, state in ticks:
        now_s += step_s
        chunk = policy.predict_fast(FEATURE, np.array([state], np.float32), HISTORY, 10)
        assert np.isfinite(chunk).all()
        assert np.abs(chunk).max() <= 1.0
