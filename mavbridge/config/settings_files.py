"""Read, check and write settings files."""

import json
import re
import sys
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from functools import reduce
from pathlib import Path
from typing import Any

from cyclopts import App
from cyclopts.argument import ArgumentCollection, update_argument_collection
from cyclopts.config import Dict

from mavbridge.config.flight import split_camera
from mavbridge.core.errors import UserError
from policy.files import user_path
from policy.nets.names import BUILTIN_KINDS

_DATA_KINDS = (*BUILTIN_KINDS, "scripted", "lerobot", "onnx")
_ADDRESS_KEYS = ("rerun", "host", "ray")
_OUTPUT_KEYS = ("record", "report", "json", "plot", "html", "out", "rerun")
_LOCAL = re.compile(
    r"(?:$|/|serial:|udp://:"
    r"|(?:connect=)?(?:[\w+]+:)?(?://)?(?:127\.0\.0\.1|localhost|\[?::1\]?)(?::\d+)?(?:[/?]|$))"
)
"""Matches addresses on this computer."""
_VIEWER = re.compile(r"(?:off|spawn|connect|[\w./-]+\.rrd)$")
"""Matches forms of ``--rerun`` without an address; plain ``connect`` is this computer's viewer."""


def foreign_policy(spec: str) -> str | None:
    """Return what a policy runs besides reading data, such as Python code; None if nothing."""
    kind = spec.partition(":")[0]
    if kind in ("ws", "wss"):
        return None if _LOCAL.match(spec) else "a server, which would get the images"
    if kind == "torchscript":
        return "a program in TorchScript"
    return None if kind in _DATA_KINDS else "a program in Python"


def untrusted_settings(
    document: Mapping[str, Any], given: Sequence[str]
) -> Iterator[tuple[str, str, str]]:
    """Yield flag, value and description of each setting that a file may not make by itself.

    ``given``: words of the command line; its flags replace those of the file.
    """
    flags = {word.partition("=")[0] for word in given}
    for keys, value in _leaves(document, ()):
        for key in {key.lstrip("-").replace("_", "-").lower() for key in keys}:
            if f"--{key}" not in flags and (what := _foreign(key, value)) is not None:
                yield f"--{key}", value, what


def _leaves(value: Any, keys: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], str]]:
    if isinstance(value, Mapping):
        for key, each in value.items():
            yield from _leaves(each, (*keys, key))
    elif isinstance(value, list):
        for each in value:
            yield from _leaves(each, keys)
    elif isinstance(value, str | int | float) and value is not False:
        yield keys, str(value)


def _foreign(key: str, value: str) -> str | None:
    if key == "policy":
        return foreign_policy(value)
    if key == "camera":
        return "a program" if split_camera(value)[1].startswith("pipe:") else None
    is_local = _LOCAL.match(value) or (key == "rerun" and _VIEWER.match(value))
    if key in _ADDRESS_KEYS and (not is_local or (key == "host" and not value)):
        return "another computer, or a port that is open to others"
    if key in _OUTPUT_KEYS and (value.startswith(("/", "~")) or ".." in Path(value).parts):
        return "a place outside the working directory to write to"
    return None


_HOME = re.compile(r"((?:[\w.-]+=)*(?:[a-z]+:)?)(~[^/]*(?:/.*)?)")
"""A path below a home directory, behind a flag's or camera's name, or a prefix (``lerobot:``)."""


def with_settings(tokens: Sequence[str], texts: Sequence[str]) -> list[str]:
    """Return a command line with the settings of ``--set-config``, each as the hidden flag that it
    is; raise UserError for a malformed one."""
    for text in texts:
        if re.fullmatch(r"[a-z]+\.[\w-]+=.*", text) is None:
            raise UserError(
                f"--set-config {text} is not understood: use SECTION.NAME=VALUE, such as "
                "limits.attitude_age=0.2 (see --print-config)"
            )
    behind = 1 if tokens and not tokens[0].startswith("-") else 0  # the command
    return [*tokens[:behind], *(f"--{text}" for text in texts), *tokens[behind:]]


class Settings(Dict):
    """A settings file, as a cyclopts configuration; keys at its top are flags of the command."""

    def __init__(self, data: Mapping[str, Any], *, source: str) -> None:
        super().__init__(with_home(data), source=source)

    def __call__(self, app: App, commands: tuple[str, ...], arguments: ArgumentCollection) -> None:
        """See ``Dict``, which leaves out keys with the name of a command, such as ``record``.

        Raises UserError for a key that would be ignored, or taken for another one.
        """
        for key, value in self.data.items():
            inner = value if isinstance(value, dict) else {"": value}
            for name in (f"--{key}.{each}".rstrip(".").replace("_", "-") for each in inner):
                if flag := next((a.name for a in arguments if name in a.negatives), None):
                    raise UserError(
                        f"{self.source}: {name[2:]} is no key: write {flag[2:]} = false"
                    )
            is_section = any(a.name.startswith(f"--{key}.") for a in arguments)
            if is_section and not isinstance(value, dict):
                raise UserError(f"{self.source}: {key} is a section: write [{key}], and its keys")
            if isinstance(value, dict) and not is_section:
                raise UserError(
                    f"{self.source}: there is no section [{key}] here: flags go to the top of a "
                    "file, and --print-config shows the sections"
                )
        update_argument_collection(
            {key: value for key, value in self.data.items() if value != {}},
            self.source,
            arguments,
            app.app_stack.stack[-1],
            root_keys=(),
            allow_unknown=self.allow_unknown,
        )


def with_home(value: Any) -> Any:
    """Expand ``~`` in words and settings that name a path.

    Shells do not expand it after a colon or an equals sign: ``lerobot:~/act``, ``--out=~/flights``.
    """
    if isinstance(value, str) and (found := _HOME.match(value)) is not None:
        return f"{found[1]}{user_path(found[2])}"
    if isinstance(value, list):
        return [with_home(each) for each in value]
    if isinstance(value, dict):
        return {name: with_home(each) for name, each in value.items()}
    return value


def print_settings(command: App, asked: object = None) -> None:
    """Print TOML that ``--config`` reads. Settings without a value are commented out.

    ``asked`` is what the command line asks the command for; None: its defaults.
    """
    sections: dict[str, list[str]] = {"": ["# Flags"]}
    for argument in command.assemble_argument_collection(parse_docstring=True):
        if argument.name == "*" or argument.children or not argument.name.startswith("--"):
            continue
        section, _, key = argument.name.removeprefix("--").rpartition(".")
        help_text = " ".join(str(argument.parameter.help or "").split())
        lines = textwrap.wrap(help_text, 96, initial_indent="# ", subsequent_indent="# ")
        default = argument.field_info.default
        value = _toml(default if asked is None else reduce(getattr, argument.keys, asked))
        name = key.replace("-", "_")
        lines.append(f"# {name} =" if value is None else f"{name} = {value}")
        sections.setdefault(section, [f"[{section}]"]).extend(lines)
    sys.stdout.write("\n\n".join("\n".join(lines) for lines in sections.values()) + "\n")


def _toml(value: Any) -> str | None:
    """Return a value in TOML; None if there is no default."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int | float):
        return str(value)
    value = str(value) if isinstance(value, Path) else value
    if not (isinstance(value, tuple | str) and value):
        return None
    # Escaped: what JSON may hold as it is, and TOML or a terminal may not.
    text = json.dumps(value, ensure_ascii=False).replace("\x7f", r"\u007f")
    return text.encode(errors="backslashreplace").decode()
