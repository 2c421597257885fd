"""Hostile datagrams against a link with a key: nothing is taken but what its holder has signed."""

from random import Random

from pymavlink.dialects.v20 import ardupilotmega as dialect

from fuzz.codec_target import judging, sample
from fuzz.datagrams import Datagrams
from helpers.wire import WireEnd
from mavbridge.mavlink.codec.packets import Codec
from mavbridge.mavlink.codec.signing import EPOCH_NS, TICK_NS, Signing

_UNIX_NS = EPOCH_NS + 350_000_000 * 10**9
_SAMPLE_EVERY = 20
_SEAL_BYTES, _HASH_BYTES = 13, 6


def fuzz_signing(seed: int, count: int) -> None:
    """Feed ``count`` datagrams, some of them packets with valid signatures.

    Raises:
        FuzzError: an invariant does not hold.
    """
    draw = Random(f"signing {seed}")
    source = Datagrams(draw)
    key = draw.randbytes(32)
    vehicle, forger = _signing_end(key), _signing_end(draw.randbytes(32))
    signing = Signing(key, unix_ns=lambda: _UNIX_NS)
    codec = Codec(source_system=255, signing=signing)
    fresh: set[bytes] = set()
    for number in range(count):
        is_genuine = number % _SAMPLE_EVERY == 0
        if is_genuine:
            data = sample(vehicle, draw)
            source.heard.append(data)
            fresh.add(data)
            if draw.random() < 0.2:
                continue  # lost on the way, and known to the attacker alone
        else:
            data = _hostile(source, forger, draw)
        with judging(data):
            taken = list(codec.decode_datagram(data))
            for message in taken:
                if message.name != "RADIO_STATUS":  # of a radio, which knows no key
                    fresh.remove(message.packet)  # each once
            assert not is_genuine or len(taken) == 1, "a packet of the vehicle is refused"
            assert signing.state.sent_ticks <= vehicle.mav.signing.timestamp
            assert len(signing.state.heard_ticks) <= 1
    assert sum(signing.refused.values()) > count // 10, "the datagrams reach no judgement"


def _signing_end(key: bytes) -> WireEnd:
    end = WireEnd()
    end.mav.signing.secret_key = key
    end.mav.signing.sign_outgoing = True
    end.mav.signing.timestamp = (_UNIX_NS - EPOCH_NS) // TICK_NS
    return end


def _hostile(source: Datagrams, forger: WireEnd, draw: Random) -> bytes:
    """A forgery of somebody without the key, from heard packets or from nothing."""
    kind = draw.random()
    if kind < 0.3 or not source.heard:
        return source.own() if draw.random() < 0.7 else source.foreign()
    if kind < 0.45:
        return sample(forger, draw)
    data = bytearray(draw.choice(source.heard))
    if kind < 0.6:
        data[draw.randrange(len(data))] ^= 1 << draw.randrange(8)
    elif kind < 0.7:  # a later timestamp
        at = len(data) - _HASH_BYTES
        ticks = int.from_bytes(data[at - 6 : at], "little") + draw.choice((1, 1000, 2**30, 2**40))
        data[at - 6 : at] = (ticks % 2**48).to_bytes(6, "little")
    elif kind < 0.8:  # the signature of another packet
        data[-_SEAL_BYTES:] = draw.choice(source.heard)[-_SEAL_BYTES:]
    elif kind < 0.9:  # another payload, with its right checksum
        data[draw.randrange(10, 10 + data[1])] ^= 1 << draw.randrange(8)
        end = 10 + data[1]
        number = int.from_bytes(data[7:10], "little")
        extra = bytes((dialect.mavlink_map[number].crc_extra,))
        checksum: int = dialect.x25crc(bytes(data[1:end]) + extra).crc
        data[end : end + 2] = checksum.to_bytes(2, "little")
    return bytes(data)
