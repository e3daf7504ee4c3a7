"""The short cut for a reply that arrives whole decides as the codec and `answers` do."""

from __future__ import annotations

import random

import pytest

from servobus.protocols.sms.codec import Packet, SmsCodec, encode
from servobus.protocols.sms.requests import Fence, Read


def by_codec(request: Read[bytes], data: bytes) -> Packet | None:
    """The reply, if the bytes are one frame that answers the request and nothing else."""
    codec = SmsCodec()
    codec.receive_data(data)
    reply = codec.next_reply()
    if reply is None or reply.frame != data or not request.answers(reply):
        return None
    return reply


@pytest.mark.parametrize("size", [1, 2, 3, 15])
def test_it_takes_what_the_codec_takes_and_nothing_else(size: int) -> None:
    rng = random.Random(size)
    request = Read(7, 56, size, bytes)
    taken = 0
    for _ in range(3000):
        node, length = rng.choice((7, 7, 7, 8, 254, 255)), rng.choice((size, size, size, size - 1, size + 1))
        data = bytearray(encode(node if node < 255 else 7, rng.choice((0, 1, 32)), rng.randbytes(length)))
        if rng.random() < 0.5:
            data[rng.randrange(len(data))] = rng.choice((0, 7, 0xFF, rng.randrange(256)))
        if rng.random() < 0.1:
            data = data[: rng.randrange(len(data))] if rng.random() < 0.5 else data + rng.randbytes(1)
        reply = request.whole_reply(bytes(data))
        assert reply == by_codec(request, bytes(data)), data.hex(" ")
        taken += reply is not None
    assert taken > 500


def test_it_leaves_a_fence_to_the_codec() -> None:
    """A fence checks the id inside the reply too."""
    request: Read[bytes] = Fence(7, 3)
    for first in (7, 8):
        assert request.whole_reply(encode(7, 0, bytes((first, 0, 0)))) is None
