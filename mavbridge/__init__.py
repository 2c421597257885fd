"""mavbridge flies an autopilot with a vision policy.

    camera --30 Hz--> vision_loop --publish--> [feature_cache] --latest--> action_loop --100 Hz--> mavlink/link <=> vehicle
                      policy.encode_visual      value + age                13-D state, predict_fast,        (ArduPilot,
                                                                           smoothing, safety                 PX4, sitl)
                                                                             `--Tick--> bounded queue --> rerun_view

The slow path encodes images in a thread and caches the feature. The fast path joins the newest
vehicle state with that feature, samples the action head and sends sticks. Everything that does not
fly is a ``Release(reason)``: the pilot's sticks win.
"""  # noqa: E501 - the picture is wider than the text

__version__ = "0.1.0"
