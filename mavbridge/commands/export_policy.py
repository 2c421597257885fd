"""Export of one of our policies to files for other programs, with proof that both are equal."""

from dataclasses import replace
from pathlib import Path

from mavbridge.commands.config import ExportPolicyConfig
from mavbridge.commands.output import text_console
from mavbridge.core.errors import UserError
from policy.adapters.export import export_onnx
from policy.engines.choose import chunks_of_samples, make_parity_samples, parity_failure
from policy.errors import require_packages
from policy.loading.builtin import load_builtin
from policy.loading.load import load_policy
from policy.loading.request import PolicyRequest
from policy.nets.names import BUILTIN_KINDS


def export_policy(checkpoint: Path | None, config: ExportPolicyConfig) -> int:
    """Write a policy, and compare the written files with it."""
    console = text_console(stderr=True)
    kind = config.policy.partition(":")[0]
    if kind not in BUILTIN_KINDS:
        raise UserError(f"--policy {config.policy}: policies of toge and resnet-unet are exported")
    ours = PolicyRequest(spec=config.policy, checkpoint=checkpoint, engine="torch")
    require_packages("export-policy", "onnx")
    if config.out.is_file() or (config.out.is_dir() and any(config.out.iterdir())):
        raise UserError(f"--out {config.out} is taken: name a new or empty folder")
    policy, notes = load_builtin(ours)
    if policy.contract.action != "sticks":
        raise UserError(
            f"{config.policy} flies by {policy.contract.action}: policies by sticks are exported"
        )
    try:
        config.out.mkdir(parents=True, exist_ok=True)
        export_onnx(policy, config.out)
    except OSError as error:
        raise UserError(
            f"--out {config.out} cannot be written: {error.strerror or error}"
        ) from error
    spec = f"onnx:{config.out}"
    reason = _difference(ours, PolicyRequest(spec=spec))
    if reason is not None:
        raise UserError(f"{config.out} was written, but it is another policy: {reason}")
    for note in notes:
        console.print(note, soft_wrap=True)
    flight = f"mavbridge --connect ... --policy {spec}"
    console.print(f"wrote {config.out}; it agrees with torch. Fly it: {flight}", soft_wrap=True)
    return 0


def _difference(ours: PolicyRequest, written: PolicyRequest) -> str | None:
    """Return how two policies differ from image to stick, or None."""
    chunks = []
    for request in (ours, written):
        runner = load_policy(replace(request, dual_rate=False), now_s=lambda: 0.0).runner
        chunks.append(chunks_of_samples(runner, make_parity_samples(runner.contract)))
    return parity_failure(chunks[0], chunks[1])
