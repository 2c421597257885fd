"""What every command that draws has in common."""

from collections.abc import Iterator
from contextlib import contextmanager

from mavbridge.core.errors import UserError


@contextmanager
def needs_matplotlib() -> Iterator[None]:
    """Around the import of a figure, before the run that it will show.

    Raises:
        UserError: matplotlib is not installed.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        if error.name != "matplotlib":
            raise
        raise UserError(
            "--plot needs the package matplotlib: pip install 'mavbridge[bench]'"
        ) from error
