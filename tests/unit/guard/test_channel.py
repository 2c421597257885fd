import os
import platform
import subprocess
import threading

import pytest

from mavbridge.guard.channel import SocketPort, channel_pair


def pair() -> tuple[SocketPort, SocketPort]:
    one, other = channel_pair()
    return SocketPort(one), SocketPort(other)


def test_messages_arrive_whole_and_in_order() -> None:
    one, other = pair()
    sent = [bytes([k]) * size for k, size in enumerate((1, 0, 300, 70_000))]
    assert all(one.send(message) for message in sent)
    received = list(other.receive())
    one.send(b"last")  # takes the rest of the long one with it
    received += other.receive()
    assert received == [*sent, b"last"]
    one.close()
    other.close()


def test_nobody_waits_for_a_reader_and_what_is_dropped_is_counted() -> None:
    one, other = pair()
    results = [one.send(bytes(10_000)) for _ in range(2000)]
    assert not all(results)
    assert one.dropped == results.count(False)
    received = list(other.receive())
    while one.send(b"end") is False:
        received += other.receive()
    received += other.receive()
    assert {len(message) for message in received} == {10_000, 3}
    assert len(received) == results.count(True) + 1
    one.close()
    other.close()


@pytest.mark.parametrize("unread", [0, 5])
def test_the_end_of_the_other_side_is_noticed_after_its_last_message(unread: int) -> None:
    one, other = pair()
    for _ in range(unread):
        other.send(b"never read")
    one.send(b"the last")
    one.close()
    assert list(other.receive())[-1:] in ([b"the last"], [])
    assert other.is_closed
    assert not other.send(b"too late")
    other.close()


@pytest.mark.skipif(platform.system() != "Linux", reason="flags in /proc are Linux's")
def test_the_death_of_the_other_process_is_noticed_before_its_socket_closes() -> None:
    with subprocess.Popen(["cat"], stdin=subprocess.PIPE) as process:
        end, other_end = channel_pair()
        one, other = SocketPort(end), SocketPort(other_end, peer_pid=process.pid)
        one.send(b"before")
        assert other.receive() == [b"before"]
        assert not other.is_closed
        one.send(b"the last")
        process.kill()
        os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
        assert other.receive() == [b"the last"]
        assert other.is_closed
    one.close()
    other.close()


def test_the_last_message_waits_for_a_reader_that_lags() -> None:
    one, other = pair()
    while one.send(bytes(10_000)):
        pass
    last_words = threading.Thread(target=one.finish, args=(b"the last", 10.0), name="last-words")
    last_words.start()
    received: list[bytes] = []
    while not other.is_closed:
        received += other.receive()
    last_words.join(10.0)
    assert received[-1] == b"the last"
    assert {len(message) for message in received} == {10_000, 8}
    other.close()


def test_the_last_message_does_not_wait_for_ever() -> None:
    one, other = pair()
    while one.send(bytes(10_000)):
        pass
    one.finish(b"the last", 0.01)
    assert other.receive()
    other.close()


def test_nothing_is_inherited_by_a_child() -> None:
    one, other = channel_pair()
    assert not one.get_inheritable()
    assert not other.get_inheritable()
    one.close()
    other.close()
