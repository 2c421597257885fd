"""Whether Python finds our own packages, and not a file of the user's that has their name.

Imports nothing of ours: it is asked before anything else is imported.
"""

import importlib.util
import sys
from importlib.machinery import ModuleSpec
from pathlib import Path

import mavbridge

SAFE_PATH, OUR_SAFE_PATH = "PYTHONSAFEPATH", "mavbridge"
"""Variable that keeps the working directory out of Python's search path, with any value, and ours:
programs of the user's do not get it."""
OURS = ("policy", "sitl")
"""Packages beside ``mavbridge`` that anybody's module may be called like."""
_ROOT = Path(__file__).parents[2]


def hidden_package(root: Path = _ROOT) -> str | None:
    """Say which of the packages in ``root``, the folder of ``mavbridge``, something else hides.

    Python looks first in the current folder (``python -m``), then along PYTHONPATH. Nothing is
    imported. None: both are ours.
    """
    for name in OURS:
        spec = _found(name)
        if spec is None:
            return f"mavbridge's own package {name} is missing: install mavbridge again"
        places = [spec.origin, *(spec.submodule_search_locations or ())]
        found = next(place for place in places if place is not None)
        if Path(found).resolve() != (root / name / "__init__.py").resolve():
            return (
                f"{found} hides mavbridge's own package {name}: run `mavbridge`, not `python -m "
                "mavbridge`, and take that folder off PYTHONPATH; or rename it. As a policy it "
                f"flies by its path: --policy ./{name}.py:Class"
            )
    return None


def _found(name: str) -> ModuleSpec | None:
    """What ``import`` would find if the working directory were not left out."""
    path, sys.path = sys.path, [*mavbridge.left_out, *sys.path]
    try:
        return importlib.util.find_spec(name)
    finally:
        sys.path = path
