"""Optional packages."""

import importlib.util
from collections.abc import Mapping

from mavbridge.core.errors import UserError


def require_packages(what: str, modules: Mapping[str, str]) -> None:
    """Raise UserError if ``what`` needs a package that is not installed.

    ``modules``: import name and install name of each package.
    """
    missing = [name for name in modules if importlib.util.find_spec(name) is None]
    if missing:
        wanted = " ".join(modules[name] for name in missing)
        raise UserError(f"{what} needs {' and '.join(missing)}: pip install {wanted}")
