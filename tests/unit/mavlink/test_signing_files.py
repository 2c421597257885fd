"""Key files that are refused, and timestamps that outlive a process."""

import json
import os

import pytest

from helpers.fakes import FakeClock
from mavbridge.core.errors import UserError
from mavbridge.core.link_settings import SigningFiles
from mavbridge.mavlink.codec.packets import Codec
from mavbridge.mavlink.transport.signing_files import (
    AHEAD_TICKS,
    MOST_PACKETS,
    SigningStore,
    read_key,
)

KEY = bytes(range(32))


def write_key(folder, data=KEY, mode=0o600):
    path = folder / "key"
    path.write_bytes(data)
    path.chmod(mode)
    return path


def make_store(folder, data=KEY):
    files = SigningFiles(key_file=write_key(folder, data), state_folder=folder / "state")
    return SigningStore(files, FakeClock())


@pytest.mark.parametrize(
    "data",
    [KEY, KEY.hex().encode("utf-8-sig"), b" " + KEY.hex().upper().encode() + b"\n"],
)
def test_a_key_is_32_bytes_or_64_hexadecimal_digits(data, tmp_path):
    assert read_key(write_key(tmp_path, data)) == KEY


@pytest.mark.parametrize(
    "data",
    [
        b"",
        KEY[1:],
        KEY + b"\n",
        KEY.hex()[1:].encode(),
        b"g" * 64,
        b"a passphrase of 32 characters ok!",
    ],
)
def test_anything_else_is_no_key(data, tmp_path):
    with pytest.raises(UserError, match=r"32 random bytes or 64 hexadecimal digits; make one with"):
        read_key(write_key(tmp_path, data))


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o620, 0o610])
def test_a_key_that_others_may_use_is_refused(mode, tmp_path):
    with pytest.raises(UserError, match=r"may be used by others .*: chmod 600"):
        read_key(write_key(tmp_path, mode=mode))


def test_a_key_that_is_not_there_is_refused_with_the_way_to_make_one(tmp_path):
    with pytest.raises(UserError, match=r"No such file.*openssl rand -hex 32"):
        read_key(tmp_path / "key")
    with pytest.raises(UserError, match="Is a directory"):
        read_key(tmp_path)


def test_a_key_in_utf_16_one_of_zeros_and_a_pipe_are_refused(tmp_path):
    with pytest.raises(UserError, match="is text in UTF-16 or UTF-32: save it as UTF-8"):
        read_key(write_key(tmp_path, KEY.hex().encode("utf-16")))
    with pytest.raises(UserError, match="shall not sign"):
        read_key(write_key(tmp_path, bytes(32)))
    os.mkfifo(tmp_path / "pipe", 0o600)
    with pytest.raises(UserError, match="holds 0 bytes"):
        read_key(tmp_path / "pipe")


def sign_one(signing):
    """The timestamp of one more packet."""
    packet = Codec(source_system=255, signing=signing).encode_heartbeat()
    return int.from_bytes(packet[-12:-6], "little")


def saved_ticks(store):
    return json.loads(store.path.read_text())["sent_ticks"]


def kill(store):
    """End the saving as a kill does: the file stays as it is."""
    text = store.path.read_text()
    store.__exit__()
    store.path.write_text(text)


def test_kills_never_repeat_a_timestamp_and_gain_no_more_than_packets_could_take(tmp_path):
    newest = 0
    for number in range(12):
        signing = (store := make_store(tmp_path)).__enter__()
        ticks = sign_one(signing)
        assert ticks > newest
        assert ticks - signing.now_ticks <= AHEAD_TICKS + number * (MOST_PACKETS + 1)
        newest = max(sign_one(signing) for _ in range(50))
        kill(store)
    with make_store(tmp_path) as signing:  # and an end in order takes nothing of it further
        first = sign_one(signing)
    with make_store(tmp_path) as signing:
        assert sign_one(signing) == first + 1


def test_timestamps_are_reserved_at_once_and_the_end_saves_what_was_really_sent(tmp_path):
    store = make_store(tmp_path)
    with store as signing:
        assert saved_ticks(store) >= signing.now_ticks + AHEAD_TICKS - 100_000
        assert (store._thread.is_alive(), store._thread.name) == (True, "mavbridge-signing")
        signing._heard[(0, 1, 1)] = 77
        ticks = sign_one(signing)
    assert (saved_ticks(store), store.problem, store._thread.is_alive()) == (ticks, None, False)
    with make_store(tmp_path) as again:
        assert dict(again.state.heard_ticks) == {(0, 1, 1): 77}


def test_each_key_has_a_state_of_its_own_that_does_not_tell_it(tmp_path):
    with (store := make_store(tmp_path)), (other := make_store(tmp_path, bytes(range(1, 33)))):
        assert store.path != other.path
        files = SigningFiles(key_file=tmp_path / "key", state_folder=tmp_path)
        assert KEY.hex() not in store.path.name + store.path.read_text() + repr(files)


def test_a_damaged_state_is_told(tmp_path):
    with (store := make_store(tmp_path)):
        pass
    for text in (
        "",
        "[]",
        '{"sent_ticks": 1}',
        '{"sent_ticks": 1, "heard_ticks": {"1": 2}}',
        '{"sent_ticks": 281474976710656, "heard_ticks": {}}',
    ):
        store.path.write_text(text)
        with pytest.raises(UserError, match=r"timestamps of signed packets .* remove it"):
            make_store(tmp_path)


def test_a_folder_that_cannot_be_written_is_told_and_survived(tmp_path):
    (tmp_path / "state").write_text("a file where the folder should be")
    with pytest.raises(UserError, match="Not a directory"):
        make_store(tmp_path)
    (tmp_path / "state").unlink()
    store = make_store(tmp_path)
    (tmp_path / "state").write_text("")
    with store:
        assert "cannot be kept" in store.problem
