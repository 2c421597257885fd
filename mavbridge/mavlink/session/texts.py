"""Status texts that come in several pieces."""

from mavbridge.core.clock import NS_PER_S
from mavbridge.mavlink.codec.messages import StatusText

_WAIT_NS = NS_PER_S
"""Longest wait for a lost piece."""
_GAP = "..."


class TextJoiner:
    """Puts the pieces of one text together, in any order; a lost one shows as dots."""

    def __init__(self) -> None:
        self._text_id = 0
        self._pieces: dict[int, str] = {}
        self._last: int | None = None
        """Place of the piece with the end, once it has come."""
        self._since_ns = 0

    def receive(self, body: StatusText, now_ns: int) -> list[str]:
        """Take a piece; returns the texts that are complete, or will not become so."""
        if body.text_id == 0:
            return [body.text.rstrip()]
        texts = [] if body.text_id == self._text_id else self._end()
        if not self._pieces:
            self._text_id, self._since_ns = body.text_id, now_ns
        self._pieces[body.sequence] = body.text
        if not body.is_full:
            self._last = body.sequence
        if self._last is not None and len(self._pieces) > self._last:
            texts += self._end()
        return texts

    def step(self, now_ns: int) -> list[str]:
        """The text whose missing pieces were waited for, if any."""
        return self._end() if now_ns - self._since_ns > _WAIT_NS else []

    def _end(self) -> list[str]:
        if not self._pieces:
            return []
        end = max(self._pieces) + 1
        text = "".join(self._pieces.get(place, _GAP) for place in range(end))
        if self._last is None:
            text += _GAP
        self._text_id, self._pieces, self._last = 0, {}, None
        return [text.rstrip()]
