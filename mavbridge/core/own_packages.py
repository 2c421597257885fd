"""Check that a user's module does not shadow our own packages.

Imports nothing of ours: it runs before anything else is imported.
"""

import importlib.util
import sys
from importlib.machinery import ModuleSpec
from pathlib import Path

import mavbridge

SAFE_PATH, OUR_SAFE_PATH = "PYTHONSAFEPATH", "mavbridge"
"""Variable that keeps the working directory off Python's search path, and our value of it. Programs
of the user do not inherit ours."""
OURS = ("policy", "sitl")
"""Packages beside ``mavbridge`` whose names a user's module may have."""
_ROOT = Path(__file__).parents[2]
"""Folder of ``mavbridge`` and of the packages beside it."""


def hidden_package() -> str | None:
    """Return an error message if another module hides one of our packages, else None.

    Python searches the working directory first (``python
    -m``), then PYTHONPATH. Nothing is imported.
    """
    for name in OURS:
        spec = _found(name)
        if spec is None:
            return f"mavbridge's own package {name} is missing: install mavbridge again"
        places = [spec.origin, *(spec.submodule_search_locations or ())]
        found = next(place for place in places if place is not None)
        if Path(found).resolve() != (_ROOT / name / "__init__.py").resolve():
            return (
                f"{found} hides mavbridge's own package {name}: run `mavbridge`, not `python -m "
                "mavbridge`, and take that folder off PYTHONPATH; or rename it. As a policy it "
                f"flies by its path: --policy ./{name}.py:Class"
            )
    return None


def _found(name: str) -> ModuleSpec | None:
    """Return what ``import`` would find with the working directory on the search path."""
    path, sys.path = sys.path, [*mavbridge.left_out, *sys.path]
    try:
        return importlib.util.find_spec(name)
    finally:
        sys.path = path
