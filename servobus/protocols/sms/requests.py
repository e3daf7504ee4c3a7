"""The instructions of SMS 1.0 (1.3 and 1.4) as requests that know their reply.

A reply names only its servo, so `reply_key` is its number of parameters: replies of one servo with the same key can be mistaken
for each other. The echo of a request has the shape of a reply too; `plain()` returns the same question in a form whose echo
cannot be a reply.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, TypeVar

from servobus.protocols.base import Request
from servobus.protocols.model import Register
from servobus.protocols.sms.codec import BROADCAST_ID, HEADER, OVERHEAD, Instruction, Packet, encode

R = TypeVar("R")

ID_ADDRESS = 5
"""The same in every FEETECH memory table."""


class SmsRequest(Request[R]):
    """An instruction packet. `answered` says whether a reply is due."""

    __slots__ = ("frame", "node", "nodes", "replies", "reply_key", "reply_size")

    def __init__(self, node: int, instruction: Instruction, params: bytes = b"", *, size: int = 0, answered: bool = True) -> None:
        self.node = node
        self.nodes = (node,) if answered and node != BROADCAST_ID else ()
        self.frame = encode(node, instruction, params)
        self.replies = 1 if answered else 0
        self.reply_size = OVERHEAD + size
        self.reply_key: int = size

    def answers(self, reply: Packet) -> bool:
        return reply.id == self.node and len(reply.params) == self.reply_key

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.frame.hex(' ')})"


class Ping(SmsRequest[int | None]):
    """PING (SMS 1.0, 1.3.1): returns the health byte. Any servo answers the broadcast id, so only one may be on the line."""

    changes = False

    def __init__(self, node: int) -> None:
        super().__init__(node, Instruction.PING)

    def answers(self, reply: Packet) -> bool:
        return not reply.params and self.node in (reply.id, BROADCAST_ID)

    def parse(self, replies: Sequence[Packet]) -> int | None:
        return replies[0].code

    def plain(self) -> Request[int | None]:
        """The echo of PING looks like a reply with status 1; a reply with one parameter has no such echo."""
        return PingById(self.node)


class PingById(SmsRequest[int | None]):
    """READ of the id register, for its health byte."""

    changes = False

    def __init__(self, node: int) -> None:
        super().__init__(node, Instruction.READ, bytes((ID_ADDRESS, 1)), size=1)

    def parse(self, replies: Sequence[Packet]) -> int | None:
        return replies[0].code


class Read(SmsRequest[R]):
    """READ DATA (SMS 1.0, 1.3.2) of `size` bytes from `address`; `decode` turns them into the value."""

    __slots__ = ("_prefix", "address", "decode")
    changes = False

    def __init__(self, node: int, address: int, size: int, decode: Callable[[bytes], R]) -> None:
        super().__init__(node, Instruction.READ, bytes((address, size)), size=size)
        self.address = address
        self.decode = decode
        self._prefix = HEADER + bytes((node, size + 2))

    def whole_reply(self, data: bytes) -> Packet | None:
        if len(data) != self.reply_size or data[:4] != self._prefix or ~sum(data[2:-1]) & 0xFF != data[-1]:
            return None
        return Packet(self.node, data[4], data[5:-1], data)

    def parse(self, replies: Sequence[Packet]) -> R:
        return self.decode(replies[0].params)

    def plain(self) -> Request[R] | None:
        """The echo of a READ has two parameters, so only a READ of two bytes is in doubt: it asks for three instead."""
        if self.reply_key != 2:
            return None
        decode = self.decode
        if self.address:
            return Read(self.node, self.address - 1, 3, lambda data: decode(data[1:]))
        return Read(self.node, 0, 3, lambda data: decode(data[:2]))


class RegisterRead(Read[Any]):
    """READ of one register as a number. Everything it takes is looked up once, because the same registers are read all the time.

    `linear` (scale, zero, direction, unit per step) turns the raw value into the servo's unit, `convert` into any other physical
    value; with neither, the value is the raw one.
    """

    __slots__ = ("_byte_order", "_convert", "_linear", "_sign_bit")

    def __init__(
        self,
        node: int,
        register: Register,
        byte_order: Literal["little", "big"],
        *,
        linear: tuple[float, float, int, float] | None = None,
        convert: Callable[[int], Any] | None = None,
    ) -> None:
        super().__init__(node, register.address, register.size, self._value)
        self._byte_order: Literal["little", "big"] = byte_order
        self._sign_bit = register.sign_bit
        self._linear = linear
        self._convert = convert

    def _value(self, data: bytes) -> Any:
        raw, sign_bit = int.from_bytes(data, self._byte_order), self._sign_bit
        if sign_bit is not None and raw >> sign_bit & 1:
            raw = -(raw & ((1 << sign_bit) - 1))
        if self._linear is not None:
            scale, zero, direction, unit_per_step = self._linear
            return direction * (raw * scale - zero) * unit_per_step + 0.0
        return raw if self._convert is None else self._convert(raw)


class Fence(Read[bytes]):
    """A READ that begins at the id register. Its first byte must be the servo's id, which other registers rarely hold."""

    idempotent = False  # a repeated one would look like the first: the next fence has another length

    def __init__(self, node: int, size: int) -> None:
        super().__init__(node, ID_ADDRESS, size, bytes)

    def answers(self, reply: Packet) -> bool:
        return reply.id == self.node and len(reply.params) == self.reply_key and reply.params[0] == self.node

    def whole_reply(self, data: bytes) -> None:
        """Leave it to `answers`, which checks one byte more."""


class Acknowledged(SmsRequest[int | None]):
    """An instruction whose reply, if one is due, has no parameters; its value is the health byte."""

    changes = True

    def parse(self, replies: Sequence[Packet]) -> int | None:
        return replies[0].code if replies else None


class Write(Acknowledged):
    """WRITE DATA (SMS 1.0, 1.3.3). There is no reply at response level 0, nor from the broadcast id."""

    def __init__(self, node: int, address: int, data: bytes, *, answered: bool = True) -> None:
        super().__init__(node, Instruction.WRITE, _payload(address, data), answered=answered and node != BROADCAST_ID)


class WriteOnce(Write):
    """A WRITE that is never repeated as it is, because what was right may be old by then: a goal := present."""

    idempotent = False


class RegWrite(Acknowledged):
    """REG WRITE (SMS 1.0, 1.3.4): the servo keeps the write until ACTION."""

    def __init__(self, node: int, address: int, data: bytes, *, answered: bool = True) -> None:
        super().__init__(node, Instruction.REG_WRITE, _payload(address, data), answered=answered and node != BROADCAST_ID)


class Action(Acknowledged):
    """ACTION (SMS 1.0, 1.3.5). One servo answers it, the broadcast id does not. Never repeated: the first may have worked."""

    idempotent = False

    def __init__(self, node: int = BROADCAST_ID, *, answered: bool = True) -> None:
        super().__init__(node, Instruction.ACTION, answered=answered and node != BROADCAST_ID)


class Reset(Acknowledged):
    """RESET (SMS 1.0, 1.4.6) to factory values. The reply may have id 1 already. Never sent to all servos, never repeated."""

    idempotent = False

    def __init__(self, node: int) -> None:
        if node == BROADCAST_ID:
            raise ValueError("RESET to the broadcast id would reset every servo of the line: name one")
        super().__init__(node, Instruction.RESET)

    def answers(self, reply: Packet) -> bool:
        return not reply.params and reply.id in (self.node, 1)


class SyncWrite(Acknowledged):
    """SYNC WRITE (SMS 1.0, 1.4.5): the same registers of several servos in one packet. There is no reply."""

    def __init__(self, address: int, data: Mapping[int, bytes]) -> None:
        sizes = {len(part) for part in data.values()}
        if len(sizes) != 1 or 0 in sizes:
            raise ValueError(f"SYNC WRITE needs the same number of bytes for each servo, found {sorted(sizes)}")
        size = sizes.pop()
        blocks = b"".join(bytes((node,)) + part for node, part in data.items())
        super().__init__(BROADCAST_ID, Instruction.SYNC_WRITE, bytes((address, size)) + blocks, answered=False)


class SyncRead(SmsRequest[R]):
    """SYNC READ (FEETECH, newer than SMS 1.0): one reply per servo, in the order asked. A missing reply spoils no other."""

    __slots__ = ("decode",)
    changes = False
    partial = True

    def __init__(self, address: int, size: int, nodes: Sequence[int], decode: Callable[[Mapping[int, bytes]], R]) -> None:
        super().__init__(BROADCAST_ID, Instruction.SYNC_READ, bytes((address, size, *nodes)), size=size)
        self.nodes = tuple(nodes)
        self.replies = len(self.nodes)
        self.decode = decode

    def answers(self, reply: Packet) -> bool:
        return reply.id in self.nodes and len(reply.params) == self.reply_key

    def parse(self, replies: Sequence[Packet]) -> R:
        return self.decode({reply.id: reply.params for reply in replies})


def sync_write_size(size: int, count: int) -> int:
    """Return the bytes of a SYNC WRITE frame that carries `size` bytes for each of `count` servos."""
    return OVERHEAD + 2 + (size + 1) * count


def _payload(address: int, data: bytes) -> bytes:
    if not data:
        raise ValueError("a write without data has no effect: give at least one byte")
    return bytes((address,)) + data
