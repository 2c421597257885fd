"""Checks of a training command that take no time; this module must not load torch."""

import os
from collections.abc import Sequence
from pathlib import Path

from mavbridge.core.errors import UserError
from mavbridge.recording.folder import require_extra
from policy.training.settings import RunSettings


def prepare(command: str, flights: Sequence[Path], settings: RunSettings) -> None:
    """Refuse paths that could not be used, before torch and the flights are loaded.

    Raises:
        UserError: an extra, a folder or a file is missing, or --out cannot be written.
    """
    require_extra(command)
    if not flights:
        raise UserError(f"name the flights to learn from: mavbridge {command} DIR... --out FILE")
    for path in flights:
        if not path.is_dir():
            raise UserError(f"{path}: no such folder")
    folder = settings.out.parent
    if not folder.is_dir():
        raise UserError(f"--out {settings.out}: there is no folder {folder}")
    if not os.access(folder, os.W_OK):
        raise UserError(f"--out {settings.out}: {folder} cannot be written to")
    for name in ("start_from", "backbone_weights"):
        weights: Path | None = getattr(settings, name, None)
        if weights is not None and not weights.is_file():
            raise UserError(f"--{name.replace('_', '-')} {weights}: no such file")
    # torch's threads else spin at every barrier: on a core that something else uses too, ten times
    # the time. OpenMP reads it once, as torch is loaded.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
