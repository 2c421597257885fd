"""Names in a LeRobot dataset of format v3.0, shared by writer and reader.

Source: lerobot 0.6.1, ``datasets/utils.py`` (paths, info), ``datasets/dataset_writer.py``,
``datasets/dataset_metadata.py`` (columns of the episodes), ``utils/constants.py`` (features).
"""

from collections.abc import Mapping
from pathlib import Path

from policy.contract import StateFrame

CODEBASE_VERSION = "v3.0"

INFO = "meta/info.json"
STATS = "meta/stats.json"
TASKS = "meta/tasks.parquet"
EPISODES = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"

CAMERA_KEY = "observation.images.front"
STATE_KEY = "observation.state"
ACTION_KEY = "action"

CAPTURED, TICK, ATTITUDE, VELOCITY, ACTED, SENT_AT = (
    *("stamp.captured_ns", "stamp.tick_ns", "stamp.attitude_ns", "stamp.velocity_ns"),
    *("stamp.action_ns", "stamp.sent_ns"),
)
STAMPS = (CAPTURED, TICK, ATTITUDE, VELOCITY, ACTED, SENT_AT)
"""mavbridge's columns with the true stamps of a row: exposure of the image, tick of the state,
measurement of its attitude and velocity, stamp of the action, stamp of the sticks that flew.

LeRobot takes every feature whose name begins with "observation" or "action" for an input or output
of its policies (``utils/feature_utils.py:dataset_to_policy_features``), so these begin with
neither.
"""
SENT = "sent"
"""mavbridge's column with the sticks that flew."""
LEAST_GRAVITY_MPS2 = 5.0
STATE_FRAME = "state_frame"
"""In the ``info`` of the state's feature: ``Contract.state_frame``."""


def feature_names(feature: object) -> list[str] | None:
    """Return the names of a feature's numbers; None if it has none."""
    names = feature.get("names") if isinstance(feature, dict) else None
    if isinstance(names, dict) and len(names) == 1:  # {"motors": [...]}, as older datasets have it
        names = next(iter(names.values()))
    return [str(name) for name in names] if isinstance(names, list) else None


def is_lerobot(folder: Path) -> bool:
    """True for a LeRobot dataset of any version."""
    return (folder / INFO).is_file()


def noted_frame(feature: Mapping[str, object]) -> object:
    """Return the state frame that mavbridge noted in the state's feature; None if it did not."""
    about = feature.get("info")
    return about.get(STATE_FRAME) if isinstance(about, dict) else None


def frame_by_gravity(az_mps2: float) -> StateFrame | None:
    """Tell the frame by the usual force along z: in level flight -z is up in FRD, +z in FLU.

    None: it is no specific force, which includes gravity, or not in m/s^2.
    """
    if not abs(az_mps2) > LEAST_GRAVITY_MPS2:
        return None
    return "ned_frd" if az_mps2 < 0 else "enu_flu"
