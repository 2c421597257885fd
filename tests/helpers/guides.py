"""Reader of the project's Markdown: fenced blocks and their commands, links and pictures."""

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby, takewhile
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGES = sorted(
    [
        *(ROOT / f"{name}.md" for name in ("README", "CONTRIBUTING", "SECURITY")),
        ROOT / "policy" / "weights" / "README.md",
        *(ROOT / "docs").rglob("*.md"),
        *(ROOT / "examples").rglob("*.md"),
    ]
)
_BLOCK = re.compile(
    r"(?:^<!-- (?P<mark>[^\n]*) -->\n+)?^```(?P<kind>\w*)\n(?P<text>.*?)^```$", re.M | re.S
)
_INLINE = re.compile(r"(?<!`)`([^`\n]+)`(?!`)")
_LINK = re.compile(r"\]\(([^)\s]+)\)")
_SEPARATORS = ("&&", ";", "|", "&")
_ASSIGNMENT = re.compile(r"[A-Z_]+=\S*")


@dataclass(frozen=True, kw_only=True)
class Block:
    """A fenced block, with the HTML comment above it."""

    page: str
    """Path relative to the project's folder."""
    kind: str
    """Language of the block; empty if it names none."""
    mark: str
    """Test that runs it, as in ``run by tests/system/test_guides.py``; empty if none is named."""
    text: str


def page_name(page: Path) -> str:
    """Return the path of a page from the project's folder."""
    return str(page.relative_to(ROOT))


def blocks(page: Path) -> Iterator[Block]:
    """Return all fenced blocks of a page."""
    for match in _BLOCK.finditer(page.read_text()):
        yield Block(
            page=page_name(page),
            kind=match["kind"],
            mark=match["mark"] or "",
            text=match["text"],
        )


def command_lines(text: str) -> Iterator[list[str]]:
    """Yield the words of each shell command, without environment, redirection and comments."""
    for line in text.replace("\\\n", " ").splitlines():
        try:
            words = shlex.split(line.removeprefix("$ "), comments=True)
        except ValueError:  # prose or TOML with an apostrophe
            continue
        for is_separator, group in groupby(words, lambda word: word in _SEPARATORS):
            command = [*takewhile(lambda word: word != ">", group)]
            while command and _ASSIGNMENT.fullmatch(command[0]):
                del command[0]
            if command and not is_separator:
                yield command


def inline_codes(page: Path) -> Iterator[tuple[str, bool]]:
    """Yield each text in backticks outside fenced blocks, and True for a table's first cell."""
    for line in _BLOCK.sub("", page.read_text()).splitlines():
        for match in _INLINE.finditer(line):
            yield match[1], line.startswith("|") and "|" not in line[1 : match.start()]


def links(page: Path) -> Iterator[tuple[Path, str]]:
    """Return file and anchor of each link and picture of a page that points into the project."""
    for target in _LINK.findall(_BLOCK.sub("", page.read_text())):
        if "://" in target or target.startswith("mailto:"):
            continue
        name, _, anchor = target.partition("#")
        yield (page.parent / name if name else page).resolve(), anchor


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.+)$", _BLOCK.sub("", page.read_text()), re.M)
    texts = (re.sub(r"[^\w\- ]", "", heading.lower()) for heading in headings)
    return {text.replace(" ", "-") for text in texts}
