"""Entry point of ``python -m sitl``; reports a missing package in one line."""

import sys
from collections.abc import Sequence

PACKAGES = {"mujoco": "mujoco", "cv2": "opencv-python-headless", "pymavlink": "pymavlink"}
"""Required packages: import name to pip name."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command. Return the exit code: 2 for a usage error or a missing package."""
    try:
        from sitl.app import run
    except ModuleNotFoundError as error:
        if error.name not in PACKAGES:
            raise
        sys.stderr.write(
            f"sitl: error: the simulated vehicle needs {error.name}: pip install "
            f"{PACKAGES[error.name]}\n"
        )
        return 2
    return run(argv)


if __name__ == "__main__":
    sys.exit(main())
