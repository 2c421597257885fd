"""``mavbridge contract`` and ``export-policy``: drafts of foreign policies' contracts, from their
files, and our policies as ONNX, with proof that both are equal."""

from dataclasses import replace
from pathlib import Path

from mavbridge.commands.config import ContractConfig, ExportPolicyConfig
from mavbridge.commands.output import text_console
from mavbridge.core.errors import UserError
from mavbridge.core.files import write_output
from policy.adapters.drafts import (
    Entry,
    checkpoint_entries,
    dataset_entries,
    dataset_of,
    draft_text,
    onnx_entries,
    onnx_files,
)
from policy.adapters.export import export_onnx
from policy.adapters.lerobot.config import CONFIG_FILE
from policy.data.lerobot_format import is_lerobot
from policy.engines.choose import chunks_of_samples, make_parity_samples, parity_failure
from policy.errors import require_packages
from policy.files import CONTRACT_FILE, UNANSWERED, read_text, read_toml
from policy.loading.builtin import load_builtin
from policy.loading.load import load_policy
from policy.loading.request import PolicyRequest
from policy.nets.names import BUILTIN_KINDS


def contract(source: Path, config: ContractConfig) -> int:
    """Write a contract file for a LeRobot policy or dataset, or for ONNX.

    ``source`` may have the prefix that it has in ``--policy``.
    """
    source = Path(str(source).removeprefix("lerobot:").removeprefix("onnx:"))
    out = config.out or (source if source.is_dir() else source.parent) / CONTRACT_FILE
    if out.exists() or out.is_symlink():  # a link of a stranger may lead anywhere
        raise UserError(f"{out} is there already: change that, or name another file by --out")
    text, summary = _draft(source, config.dataset)
    write_output(out, text, "--out")
    text_console().print(f"{out}: {summary}", soft_wrap=True)
    return 0


def _draft(source: Path, dataset: Path | None) -> tuple[str, str]:
    """Return the text of the contract file, and notes for the user."""
    if dataset is not None and not is_lerobot(dataset):
        raise UserError(f"--dataset {dataset}: not a LeRobot dataset, it has no meta/info.json")
    if is_lerobot(source):
        return _described(source, dataset_entries(source))
    if graphs := onnx_files(source):
        return _described(source, onnx_entries(graphs))
    if not (source / CONFIG_FILE).is_file():
        raise UserError(
            f"{source}: neither a LeRobot policy (a folder with {CONFIG_FILE}), nor a LeRobot "
            "dataset (a folder with meta/info.json), nor ONNX (a file, or a folder of them)"
        )
    dataset = dataset or dataset_of(source)
    if dataset is not None and (described := dataset / CONTRACT_FILE).is_file():
        try:
            read_toml(described)  # which may hold open questions: no read_interface
            text = read_text(described)
        except (OSError, ValueError) as error:
            raise UserError(f"{described} cannot be copied: {error}") from error
        return text, f"a copy of {described}, which mavbridge export wrote"
    text, summary = _described(source, checkpoint_entries(source, dataset))
    if dataset is None:
        return text, f"{summary}\nmore is known with the dataset that it was trained on: --dataset"
    return text, f"{summary}\nits dataset is {dataset}"


def _described(source: Path, entries: list[Entry]) -> tuple[str, str]:
    counts = {
        origin: [f"[{entry.table}] {entry.name}" for entry in entries if entry.origin == origin]
        for origin in ("read", "guessed", "to answer")
    }
    lines = [f"{len(names)} entries {origin}" for origin, names in counts.items()]
    summary = ", ".join(lines)
    for origin, request in (("guessed", "check"), ("to answer", "answer")):
        if counts[origin]:
            summary += f"\nplease {request}: {', '.join(counts[origin])}"
    title = (
        f"Contract of {source}, drafted by mavbridge contract: what its own files do not say. "
        f"Check what was guessed, and replace every {UNANSWERED!r}: it does not fly before."
    )
    return draft_text(title, entries), summary


def export_policy(checkpoint: Path | None, config: ExportPolicyConfig) -> int:
    """Write a policy, and compare the written files with it."""
    console = text_console(stderr=True)
    kind = config.policy.partition(":")[0]
    if kind not in BUILTIN_KINDS:
        raise UserError(f"--policy {config.policy}: policies of toge are exported")
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
