"""Write the flags of docs/commands.md: ``python -m benchmarks.commands_page``."""

import inspect
import re
from collections.abc import Iterator
from pathlib import Path

from cyclopts import App
from cyclopts.argument import Argument

from benchmarks.safety_table import with_generated
from mavbridge.cli import cli

PAGE = Path(__file__).parents[1] / "docs" / "commands.md"
MOST_WORDS = 15
_UNNAMED = ("Arguments", "Parameters", "Flags")
"""Groups with a meaningless name: their flags are named one by one."""


def flags() -> str:
    """Return every command with its flags, each under its first command, then the settings.

    Long help texts are shortened; ``--help`` has the rest.
    """
    seen: dict[tuple[str, str], str] = {}
    lines: list[str] = []
    for name in (name for name in cli if not name.startswith("-")):
        lines += [f"## {name}", "", _text(inspect.getdoc(cli[name].default_command)), ""]
        lines += [*_flags_of(cli[name], seen), ""]
    lines += ["## Flags of every command", "", *_list(_arguments(cli.meta)), ""]
    lines += ["## Settings", "", *_settings(cli["fly"])]
    return "\n".join(lines) + "\n"


def _flags_of(app: App, seen: dict[tuple[str, str], str]) -> Iterator[str]:
    """Yield the flags not listed before, by group, then the names of the other groups."""
    new: dict[str, list[Argument]] = {}
    shared: dict[str, None] = {}
    for argument in _arguments(app):
        key = (argument.name, str(argument.parameter.help))
        group = _group(argument)
        if key in seen:
            shared[f"`{argument.name}`" if seen[key] in _UNNAMED else seen[key]] = None
        else:
            seen[key] = group
            new.setdefault(group, []).append(argument)
    for group, arguments in new.items():
        yield from ([f"**{group}**", ""] if len(new) > 1 else [])
        yield from [*_list(arguments), ""]
    if shared:
        yield f"Also, from above: {', '.join(shared)}."


def _arguments(app: App) -> list[Argument]:
    """Return the flags that the help shows."""
    arguments = app.assemble_argument_collection(parse_docstring=True)
    return [each for each in arguments if each.show and not each.children and each.name != "*"]


def _group(argument: Argument) -> str:
    groups = argument.parameter.group or ()
    names = [str(getattr(group, "name", group)) for group in groups]  # type: ignore[union-attr]
    return names[0] if names else "Flags"


def _list(arguments: list[Argument]) -> Iterator[str]:
    for argument in arguments:
        yield f"- `{argument.name}`{_default(argument)}: {_text(argument.parameter.help)}"


def _settings(app: App) -> Iterator[str]:
    """Yield the keys of each section of a settings file, with their defaults."""
    sections: dict[str, list[str]] = {}
    for argument in app.assemble_argument_collection(parse_docstring=True):
        section, found, key = argument.name.removeprefix("--").partition(".")
        if found and not argument.children:
            name = f"`{key.replace('-', '_')}`{_default(argument)}"
            sections.setdefault(section, []).append(name)
    for section, keys in sections.items():
        yield f"- `[{section}]`: {', '.join(keys)}."


def _default(argument: Argument) -> str:
    """Return the default in brackets, or nothing if it is not informative."""
    default = argument.field_info.default
    shown = isinstance(default, str | int | float) and not isinstance(default, bool)
    return f" ({default})" if shown and default != "" else ""


def _text(text: object) -> str:
    """Return a help text on one line, or the first sentence or clause of a long one."""
    words = str(text or "").split("Args:")[0].split()
    line = " ".join(words)
    return line if len(words) <= MOST_WORDS else re.split(r"[.;] ", line)[0].rstrip(".") + "."


def with_flags(page: str) -> str:
    """Return the page with the current flags."""
    return with_generated(page, "benchmarks.commands_page", flags())


if __name__ == "__main__":
    PAGE.write_text(with_flags(PAGE.read_text()))
