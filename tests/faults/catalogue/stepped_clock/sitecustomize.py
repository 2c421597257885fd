"""Steps wall time by an hour in every Python process that has this folder in PYTHONPATH.

Only root could step the computer's own clock, and that would affect all programs. Python imports
this module at its start; the step is in effect while the file of STEPPED_CLOCK exists.
"""

import os
import time

STEP_S = 3600
_path = os.environ["STEPPED_CLOCK"]
_time, _time_ns = time.time, time.time_ns  # noqa: TID251 - these are replaced


def _step_s() -> int:
    return STEP_S if os.access(_path, os.F_OK) else 0


time.time = lambda: _time() + _step_s()  # noqa: TID251
time.time_ns = lambda: _time_ns() + _step_s() * 10**9  # noqa: TID251
