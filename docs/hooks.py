"""Hook of mkdocs: links that leave docs/ become plain text, since the site holds docs/ alone."""

import posixpath
import re
from typing import Any

_LINK = re.compile(r"\[([^\]]+)\]\(([^)\s:]+)\)")


def on_page_markdown(markdown: str, *, page: Any, **_: object) -> str:
    """Replace each link to a file outside docs/ with its text."""
    folder = posixpath.dirname(page.file.src_uri)

    def replaced(match: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(folder, match[2]))
        return match[1] if target.startswith("..") or target == "dev/package.md" else match[0]

    return _LINK.sub(replaced, markdown)
