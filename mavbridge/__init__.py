"""mavbridge flies an autopilot with a vision policy.

    flight process: may be slow, hang or die                      gate process: never waits for it

    camera --> vision_loop --> [feature_cache] --> policy_loop --chunks--> gate --> mavlink/link <=> vehicle
                                                    ^      ^    ages, who holds the sticks,         (ArduPilot,
                                       vehicle_view-'      '-history   limits, smoothing             PX4, sitl)
                                             ^                 ^                |
                                             '--packets, phases, sent sticks ---'
                                             '--Tick--> bounded queues --> terminal, recording, Rerun

The slow path encodes images in a thread and caches the feature. The fast path joins the newest
attitude with that feature and computes a chunk of actions, each with the time at which it acts. The
gate alone sends to the autopilot: it samples the newest chunk while the policy has the sticks, and
gives them back in order when the pilot takes them or anything fails (docs/SAFETY.md).
"""  # noqa: E501 - the picture is wider than the text

__version__ = "0.1.0"
