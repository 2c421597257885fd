"""Packages that only a part of mavbridge needs."""

import importlib.util
from collections.abc import Mapping

from mavbridge.core.errors import UserError


def require_packages(what: str, modules: Mapping[str, str]) -> None:
    """Raise UserError if ``what`` needs something that is not installed.

    ``modules``: names to import, each with the name to install it by.
    """
    missing = [name for name in modules if importlib.util.find_spec(name) is None]
    if missing:
        wanted = " ".join(modules[name] for name in missing)
        raise UserError(f"{what} needs {' and '.join(missing)}: pip install {wanted}")
