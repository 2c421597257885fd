"""Files of MAVLink 2 signing: the key, and the state that must survive a restart."""

import codecs
import hashlib
import json
import os
import re
import stat
import threading
from pathlib import Path

from mavbridge.core.clock import NS_PER_S, Clock, wall_offset_ns
from mavbridge.core.errors import UserError
from mavbridge.core.files import write_durably
from mavbridge.core.link_settings import SigningFiles
from mavbridge.mavlink.codec.signing import (
    KEY_BYTES,
    LATEST_TICKS,
    TICK_NS,
    Signing,
    SigningState,
    Stream,
)
from policy.files import stand_in_of

SAVE_S = 10.0
AHEAD_TICKS = 2 * round(SAVE_S) * NS_PER_S // TICK_NS
"""Reserve of timestamps beyond the wall time, saved while packets are sent: lasts until the next
save, and for one save more."""
MOST_PACKETS = 2 * round(SAVE_S) * 2000
"""Reserve beyond the newest timestamp if that is ahead of the wall time and rises by one tick per
packet; no link carries 2,000 packets per second."""
JOIN_S = 2.0
MOST_BYTES = 1024
_MADE = "make one with: (umask 077; openssl rand -hex 32 > FILE)"


def read_key(path: Path) -> bytes:
    """Return the 32 bytes of a key file, which holds them raw or as 64 hexadecimal digits.

    No error text contains any of them.

    Raises:
        UserError: the file cannot be read, others may read it, or it holds no key.
    """
    try:
        # A pipe without a writer must not block.
        with os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK), "rb") as file:
            mode, data = os.fstat(file.fileno()).st_mode, file.read(MOST_BYTES)
    except OSError as error:
        raise UserError(f"--signing-key-file {path}: {error.strerror}; {_MADE}") from error
    if stat.S_IMODE(mode) & (stat.S_IRWXG | stat.S_IRWXO):
        raise UserError(
            f"--signing-key-file {path} may be used by others (mode {stat.S_IMODE(mode):03o}), who "
            f"could then steer the vehicle: chmod 600 {path}, and think of a new key"
        )
    key = _key(data)
    if key is None:
        if data.strip() and (found := stand_in_of(data)) is not None:
            raise UserError(f"--signing-key-file {path} is {found[0]}: {found[1]}")
        raise UserError(
            f"--signing-key-file {path} holds {len(data)} bytes, but a key is 32 random bytes or "
            f"64 hexadecimal digits; {_MADE}, or from the passphrase of a ground station: "
            "printf %s 'the words' | sha256sum | cut -c1-64"
        )
    if not any(key):
        raise UserError(
            f"--signing-key-file {path}: a key of zeros means to a vehicle that it shall not sign; "
            f"{_MADE}"
        )
    return key


def _key(data: bytes) -> bytes | None:
    text = data.removeprefix(codecs.BOM_UTF8).strip()
    if re.fullmatch(rb"[0-9A-Fa-f]{64}", text):
        return bytes.fromhex(text.decode())
    is_text = data.isascii() and data.decode().isprintable()  # a passphrase, or half of a key
    return data if len(data) == KEY_BYTES and not is_text else None


class SigningStore:
    """``Signing`` with timestamps that continue those of an earlier process with this key.

    A separate thread saves them, since a disk may be slow.
    """

    def __init__(self, files: SigningFiles, clock: Clock) -> None:
        """Read the key and the state; nothing is written before the context is entered.

        Raises:
            UserError: as ``read_key``, or the state is damaged.
        """
        key = read_key(files.key_file)
        name = hashlib.sha256(b"name of the state of " + key).hexdigest()[:16]
        self.path = files.state_folder / "signing" / f"{name}.json"
        offset_ns = wall_offset_ns(clock)
        self.signing = Signing(
            key, unix_ns=lambda: clock.now_ns() + offset_ns, state=_read_state(self.path)
        )
        self.problem: str | None = None
        """Why the timestamps cannot be saved, or None."""
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="mavbridge-signing", daemon=True)

    def __enter__(self) -> Signing:
        """Reserve the first timestamps, then more every ten seconds."""
        self._save(is_over=False)
        self._thread.start()
        return self.signing

    def __exit__(self, *_: object) -> None:
        """Save the newest used timestamp, without the unused reserve."""
        self._stop.set()
        self._thread.join(JOIN_S)

    def _run(self) -> None:
        while not self._stop.wait(SAVE_S):
            self._save(is_over=False)
        self._save(is_over=True)

    def _save(self, *, is_over: bool) -> None:
        sent_ticks, heard = self.signing.state
        if not is_over:  # not from an earlier reserve: each start would gain 20 s
            now_ticks = self.signing.now_ticks
            sent_ticks = max(sent_ticks + MOST_PACKETS, now_ticks + AHEAD_TICKS)
        streams = {"/".join(map(str, stream)): ticks for stream, ticks in heard.items()}
        text = json.dumps({"sent_ticks": sent_ticks, "heard_ticks": streams})
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            write_durably(self.path, text)
        except OSError as error:
            self.problem = (
                f"timestamps of signed packets cannot be kept in {self.path} ({error.strerror}): "
                "if the time of day steps back, the vehicle will ignore the next flight"
            )


def _read_state(path: Path) -> SigningState:
    try:
        document = json.loads(path.read_text())
        streams = {_stream(name): int(ticks) for name, ticks in document["heard_ticks"].items()}
        sent_ticks = int(document["sent_ticks"])
        if not all(0 <= ticks <= LATEST_TICKS for ticks in (sent_ticks, *streams.values())):
            raise ValueError("a timestamp that no clock shows")
        return SigningState(sent_ticks, streams)
    except FileNotFoundError:
        return SigningState()
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(
            f"cannot read {path}, which keeps the timestamps of signed packets ({error}): remove "
            "it if the time of day is right on this computer"
        ) from error


def _stream(name: str) -> Stream:
    link_id, system, component = map(int, name.split("/"))
    return link_id, system, component
