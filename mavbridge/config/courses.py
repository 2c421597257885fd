"""Seeds of gate courses: training, its checks and evaluation never share one."""

CHECK_COURSE_SEED = 900_000
"""Courses from here on are flown during training, and neither learned from nor evaluated."""

HELD_OUT_COURSE_SEED = 1_000_000
"""Courses from here on are for evaluation: nothing is ever trained on them."""

MAX_EPISODES = 10_000
"""Most episodes of one evaluation, so that another seed has other courses."""
