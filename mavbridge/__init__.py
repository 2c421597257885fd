"""mavbridge flies an autopilot with a vision policy.

    flight process: may be slow, hang or die                      guard process: never waits for it

    camera --> vision_loop --> [feature_cache] --> policy_loop --chunks--> guard --> mavlink/link <=> vehicle
                                                    ^      ^    ages, who holds the sticks,         (ArduPilot,
                                       telemetry_cache-'      '-history   limits, smoothing             PX4, sitl)
                                             ^                 ^                |
                                             '--packets, phases, sent sticks ---'
                                             '--Tick--> bounded queues --> terminal, recording, Rerun

The slow path encodes images in a thread and caches the feature. The fast path joins the newest
attitude with that feature and computes a chunk of actions, each with the time at which it acts. The
guard alone sends to the autopilot: it samples the newest chunk while the policy has the sticks, and
gives them back in order when the pilot takes them or anything fails (docs/safety.md).
"""  # noqa: E501 - the picture is wider than the text

import os
import sys

left_out: list[str] = []
"""The working directory, if `python -m mavbridge` has put it first: modules that lie there beside
somebody's weights are not ours to run."""
if sys.argv[:1] == ["-m"] and not sys.flags.safe_path:  # so while Python looks for the module
    _root = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))  # noqa: PTH100, PTH120
    left_out = [entry for entry in sys.path[:1] if entry != _root]
    sys.path[: len(left_out)] = []

SAFE_PATH, OUR_SAFE_PATH = "PYTHONSAFEPATH", "mavbridge"
"""Variable that keeps the working directory off Python's search path, and our value of it. Programs
of the user do not inherit ours."""

__version__ = "0.1.0"
