"""What a TorchScript archive says of itself, read without torch."""

import zipfile
import zlib
from pathlib import Path

from policy.adapters.description import DESCRIPTION, Description, describe
from policy.errors import CheckpointError
from policy.files import why_unreadable


def read_description(spec: str, path: Path, contract_file: Path | None) -> Description:
    """What the archive of the policy ``spec`` says of itself: milliseconds."""
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
            extra = [name for name in names if name.endswith(f"/extra/{DESCRIPTION}")]
            text = archive.read(extra[0]).decode() if extra else None
    except (OSError, zipfile.BadZipFile, zlib.error, RuntimeError, EOFError, ValueError) as error:
        raise CheckpointError(f"--policy {spec}: {why_unreadable(path, error)}") from error
    if not any("/code/" in name for name in names):
        raise CheckpointError(
            f"--policy {spec}: {path} is not a TorchScript archive: write it with "
            "torch.jit.script(module).save(FILE), or torch.jit.trace"
        )
    where = path / DESCRIPTION
    return describe(spec, text, where=where, beside=path.parent, contract_file=contract_file)
