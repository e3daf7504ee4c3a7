"""KST frames (seed, section 2): FE, version CA, address, command, eight data bytes, sum, 0A. Always 14 bytes, both ways.

One codec serves master and simulated servo: a reply differs from a command by its code, which is the command's plus 0x40, or plus
0xC0 when it was refused. Header and trailer may occur in the data, so a frame counts only when all of it is right, with the
data bytes that its code does not use being 0; where one of these fails, the search goes on one byte further.

Written from the specification, never seen on hardware.
"""

from __future__ import annotations

from enum import IntEnum
from random import Random
from typing import NamedTuple

from servobus.protocols.kst import aborts

HEADER = 0xFE
VERSION = 0xCA
TRAILER = 0x0A
SIZE = 14
DATA_SIZE = 8
BROADCAST = 0x00
FACTORY_ID = 0x25
"""What every new servo answers to."""
REPLY = 0x40
REFUSED = 0xC0
STEPS_PER_DEGREE = 10
SAVE_WORD = b"save"


class Command(IntEnum):
    """Seed, section 3, in its order."""

    SET_BAUD = 0x06
    SET_ID = 0x08
    SAVE = 0x0F
    READ_ID = 0x18
    SET_POSITION = 0x09
    READ_POSITION = 0x19
    READ_STATUS = 0x10
    READ_VERSION = 0x1A


BAUD_TABLE: dict[int, int] = {0: 9600, 1: 19200, 2: 38400, 3: 57600, 4: 115200, 5: 256000, 6: 512000, 7: 921600}
"""Code of the baud rate command -> rate (seed, section 3.1)."""

ASKS: dict[int, int] = {
    Command.SET_BAUD: 1,
    Command.SET_ID: 1,
    Command.SAVE: 4,
    Command.READ_ID: 0,
    Command.SET_POSITION: 2,
    Command.READ_POSITION: 0,
    Command.READ_STATUS: 0,
    Command.READ_VERSION: 0,
}
"""Command -> data bytes it uses."""
ANSWERS: dict[int, int] = {
    Command.SET_BAUD: 1,
    Command.SET_ID: 1,
    Command.READ_ID: 1,
    Command.SET_POSITION: 2,
    Command.READ_POSITION: 2,
    Command.READ_STATUS: 2,
    Command.READ_VERSION: 4,
}
"""Command -> data bytes its reply uses. SAVE is not here: the seed knows no reply to it, so nothing is known of its data."""
USED: dict[int, int] = {
    **ASKS,
    **{REPLY + command: size for command, size in ANSWERS.items()},
    **dict.fromkeys(range(REFUSED, 0x100), aborts.CODE_SIZE),
}


class Frame(NamedTuple):
    """One frame, either way."""

    address: int
    code: int
    data: bytes
    frame: bytes

    @property
    def node(self) -> int:
        return self.address

    @property
    def status(self) -> None:
        """No reply brings the servo's health; it has a command of its own."""
        return None

    @property
    def key(self) -> int:
        """Replies of one servo differ by the command they answer, refused or not."""
        return self.code & 0x3F

    @property
    def refused(self) -> bool:
        return self.code >= REFUSED


def checksum(body: bytes) -> int:
    """Of the 11 bytes from version to data: the low byte of their sum."""
    return sum(body) & 0xFF


def encode(address: int, code: int, data: bytes = b"", version: int = VERSION) -> bytes:
    """The frame's bytes, data padded with 0. Raises ValueError for what the frame cannot carry."""
    if not (0 <= address <= 0xFF and 0 <= code <= 0xFF):
        raise ValueError(f"address {address} and code {code} must each be 0 to 255")
    if len(data) > DATA_SIZE:
        raise ValueError(f"{len(data)} data bytes do not fit in a frame of {DATA_SIZE}")
    body = bytes((version, address, code)) + data.ljust(DATA_SIZE, b"\0")
    return bytes((HEADER,)) + body + bytes((checksum(body), TRAILER))


def encode_position(steps: int) -> bytes:
    """Steps of 0.1 degree as two's complement, low byte first (seed, section 3.5). Raises OverflowError beyond 16 bits."""
    return steps.to_bytes(2, "little", signed=True)


def decode_position(data: bytes) -> int:
    return int.from_bytes(data[:2], "little", signed=True)


def version_text(data: bytes) -> str:
    """The firmware version: text without its zero bytes at the end if all of it can be printed, else hexadecimal."""
    text = data[: ANSWERS[Command.READ_VERSION]].rstrip(b"\0")
    return text.decode("ascii") if text and all(0x20 <= byte < 0x7F for byte in text) else data[:4].hex(" ")


class KstCodec:
    """Finds frames in a stream. Between two calls no more than 13 undecided bytes are kept."""

    __slots__ = ("_buffer", "_header", "_strict", "skipped")

    def __init__(self, version: int = VERSION, *, strict: bool = True) -> None:
        """`strict`: unused data bytes must be 0."""
        self._header = bytes((HEADER, version))
        self._strict = strict
        self._buffer = b""
        self.skipped = 0

    @property
    def pending(self) -> int:
        return len(self._buffer)

    def receive_data(self, data: bytes) -> None:
        self._buffer = self._buffer + data if self._buffer else bytes(data)

    def reset(self) -> None:
        self._buffer = b""

    def next_reply(self) -> Frame | None:
        """The next frame that is right in every part; what cannot begin one is skipped and counted."""
        buffer = self._buffer
        start = 0
        while True:
            found = buffer.find(self._header, start)
            if found < 0:
                # A last FE may be half a header.
                keep = 1 if len(buffer) > start and buffer[-1] == HEADER else 0
                self._drop(len(buffer) - keep)
                return None
            end = found + SIZE
            if len(buffer) < end:
                self._drop(found)
                return None
            if self._is_right(buffer[found:end]):
                self.skipped += found
                self._buffer = buffer[end:]
                return Frame(buffer[found + 2], buffer[found + 3], buffer[found + 4 : end - 2], buffer[found:end])
            start = found + 1

    def describe(self, frame: bytes, *, sent: bool) -> str:
        """One line of words; a frame says itself which way it goes."""
        fresh = KstCodec(self._header[1], strict=self._strict)
        fresh.receive_data(frame)
        found = fresh.next_reply()
        return describe(found) if found is not None and found.frame == frame else f"no KST frame: {frame.hex(' ')}"

    def _is_right(self, frame: bytes) -> bool:
        if frame[-1] != TRAILER or sum(frame[1:12]) & 0xFF != frame[12]:
            return False
        return not self._strict or not any(frame[4 + USED.get(frame[3], DATA_SIZE) : 12])

    def _drop(self, count: int) -> None:
        self.skipped += count
        self._buffer = self._buffer[count:]


def rename(frame: bytes, rng: Random) -> bytes:
    """The same frame in the name of another servo (never in that of the broadcast)."""
    address = (frame[2] - 1 + rng.randint(1, 254)) % 255 + 1
    return encode(address, frame[3], frame[4:12], frame[1])


def node_of(frame: bytes) -> int:
    """The address of a whole frame."""
    return frame[2]


def name_of(command: int) -> str:
    """`set position`, or the number of a command that the seed does not know."""
    try:
        return Command(command).name.lower().replace("_", " ")
    except ValueError:
        return f"command 0x{command:02X}"


def describe(frame: Frame) -> str:
    """A frame in words: what `decode` and `--trace` print."""
    who = "all" if frame.address == BROADCAST else f"id {frame.address}"
    what = name_of(frame.key)
    if frame.refused:
        code, _ = aborts.decode(frame.data[: aborts.CODE_SIZE], None)
        return f"{who} {what} refused: {aborts.words(code, frame.data[: aborts.CODE_SIZE])}"
    if frame.code >= 2 * REPLY:
        return f"{who} code 0x{frame.code:02X}, which the protocol does not use: {frame.data.hex(' ')}"
    if frame.code < REPLY:
        return f"{who} {what}{_describe_data(frame.key, frame.data, ASKS)}"
    return f"{who} {what} ok{_describe_data(frame.key, frame.data, ANSWERS)}"


def _describe_data(command: int, data: bytes, used: dict[int, int]) -> str:
    size = used.get(command, DATA_SIZE)
    if not size:
        return ""
    match command:
        case Command.SET_POSITION | Command.READ_POSITION:
            return f" {decode_position(data) / STEPS_PER_DEGREE:.1f} deg"
        case Command.SET_BAUD:
            return f" {data[0]} ({BAUD_TABLE.get(data[0], 'no known rate')})"
        case Command.SET_ID | Command.READ_ID:
            return f" {data[0]}"
        case Command.READ_VERSION:
            return f" {version_text(data)}"
        case _:
            return f" {data[:size].hex(' ')}"
