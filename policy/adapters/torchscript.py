"""A TorchScript archive: torch.jit.load runs it, and nothing in it is a program for Python.

It has modules or methods as ``adapters.modules`` says, and may hold a file policy.json as
``adapters.description`` says (``torch.jit.save(..., _extra_files={"policy.json": text})``).
"""

import warnings
from dataclasses import replace
from pathlib import Path

import torch

from policy.adapters.description import Description
from policy.adapters.modules import PARTS, adopt_modules, make_schedule
from policy.errors import CheckpointError
from policy.files import why_unreadable
from policy.protocol import SingleRatePolicy


def load_torchscript(
    spec: str, path: Path, description: Description, seed: int
) -> SingleRatePolicy:
    """The policy of an archive, on the CPU."""
    try:
        # torch says that this will go one day, in favour of a format that few export to so far.
        with warnings.catch_warnings(action="ignore", category=DeprecationWarning):
            module = torch.jit.load(path, map_location="cpu").eval()  # type: ignore[no-untyped-call]
    except (RuntimeError, OSError) as error:
        raise CheckpointError(why_unreadable(path, error)) from error
    contract = replace(description.interface.contract, arrays="torch")
    schedule = make_schedule(path, description.schedule) if description.schedule else None
    policy = adopt_modules(
        spec,
        module,
        replace(description.interface, contract=contract),
        schedule=schedule,
        seed=seed,
        inputs=description.inputs,
        outputs=description.outputs,
    )
    if policy is None:
        raise CheckpointError(f"--policy {spec}: the archive has none of {PARTS}")
    return policy
