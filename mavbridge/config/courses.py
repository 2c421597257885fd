"""Simulated vehicles and seeds of gate courses: training, its checks and evaluation share none."""

from typing import Literal

AutopilotKind = Literal["ardupilot", "px4"]
CourseKind = Literal["easy", "race"]
"""Family of courses; each has seeds of its own, and in them the same ranges."""
ConditionsKind = Literal["nominal", "random", "held-out"]
"""Vehicles, wind and light: the same for every course, drawn as demonstrations do, or with looks
that no demonstration has."""

RACE_COURSE_SEED = 1_000_000_000
"""Seeds of race courses begin here (`sitl.course.RACE_SEEDS`)."""

CHECK_COURSE_SEED = 900_000
"""Courses from here on are flown during training, and neither learned from nor evaluated."""

HELD_OUT_COURSE_SEED = 1_000_000
"""Courses from here on are for evaluation: nothing is ever trained on them."""

MAX_EPISODES = 10_000
"""Most episodes of one evaluation, so that another seed has other courses."""

MAX_EVALUATION_SEED = (RACE_COURSE_SEED - HELD_OUT_COURSE_SEED) // MAX_EPISODES - 1
"""From the next on, easy courses of an evaluation would be races, some of them trained on."""


def first_seed(courses: CourseKind) -> int:
    """Seed 0 of a family."""
    return RACE_COURSE_SEED if courses == "race" else 0
