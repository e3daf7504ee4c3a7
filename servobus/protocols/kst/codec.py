"""KST frames (KST RS422, 2): FE, version CA, address, command, eight data bytes, checksum, 0A. Always 14 bytes, in both
directions.

One codec serves master and simulated servo: a reply's code is the command's plus 0x40, or plus 0xC0 for a refusal. Header and
trailer may occur in the data. So a frame is accepted only if all of it is right and its unused data bytes are 0; otherwise the
search goes on one byte further.

Written from the document; not tried on hardware yet.
"""

from __future__ import annotations

from enum import IntEnum
from random import Random
from typing import NamedTuple

from servobus.protocols.kst import aborts
from servobus.protocols.stream import StreamCodec, decode_single

HEADER = 0xFE
VERSION = 0xCA
TRAILER = 0x0A
SIZE = 14
DATA_SIZE = 8
BROADCAST = 0x00
FACTORY_ID = 0x25
"""The id of every new servo."""
REPLY = 0x40
REFUSED = 0xC0
STEPS_PER_DEGREE = 10
SAVE_DATA = b"save"


class Command(IntEnum):
    """The commands, in the order of KST RS422, 3."""

    SET_BAUD = 0x06
    SET_ID = 0x08
    SAVE = 0x0F
    READ_ID = 0x18
    SET_POSITION = 0x09
    READ_POSITION = 0x19
    READ_STATUS = 0x10
    READ_VERSION = 0x1A


BAUD_TABLE: dict[int, int] = {0: 9600, 1: 19200, 2: 38400, 3: 57600, 4: 115200, 5: 256000, 6: 512000, 7: 921600}
"""Code of the baud rate command -> rate (KST RS422, 3.1)."""

SIZES: dict[int, tuple[int, int | None]] = {
    Command.SET_BAUD: (1, 1),
    Command.SET_ID: (1, 1),
    Command.SAVE: (4, None),
    Command.READ_ID: (0, 1),
    Command.SET_POSITION: (2, 2),
    Command.READ_POSITION: (0, 2),
    Command.READ_STATUS: (0, 2),
    Command.READ_VERSION: (0, 4),
}
"""Command -> data bytes that it and its reply use. The document defines no reply to SAVE."""
REQUEST_SIZES = {command: size for command, (size, _) in SIZES.items()}
REPLY_SIZES = {command: size for command, (_, size) in SIZES.items() if size is not None}
DATA_SIZES: dict[int, int] = {
    **REQUEST_SIZES,
    **{REPLY + command: size for command, size in REPLY_SIZES.items()},
    **dict.fromkeys(range(REFUSED, 0x100), aborts.CODE_SIZE),
}
"""Code of a frame, in either direction -> data bytes that it uses."""


class Frame(NamedTuple):
    """One frame in either direction."""

    address: int
    code: int
    data: bytes
    frame: bytes

    @property
    def node(self) -> int:
        return self.address

    @property
    def status(self) -> None:
        """None: no reply brings the servo's status, which has a command of its own."""
        return None

    @property
    def key(self) -> int:
        """The command that it answers, whether it refuses or not."""
        return self.code & 0x3F

    @property
    def refused(self) -> bool:
        return self.code >= REFUSED


def checksum(data: bytes) -> int:
    """Return the low byte of the sum; taken over the 11 bytes from version to data."""
    return sum(data) & 0xFF


def encode(address: int, code: int, data: bytes = b"", version: int = VERSION) -> bytes:
    """Return the frame's bytes, with the data padded by 0. Raises ValueError for what a frame cannot carry."""
    if not (0 <= address <= 0xFF and 0 <= code <= 0xFF):
        raise ValueError(f"address {address} and code {code} must each be 0 to 255")
    if len(data) > DATA_SIZE:
        raise ValueError(f"{len(data)} data bytes do not fit in a frame of {DATA_SIZE}")
    content = bytes((version, address, code)) + data.ljust(DATA_SIZE, b"\0")
    return bytes((HEADER,)) + content + bytes((checksum(content), TRAILER))


def encode_position(steps: int) -> bytes:
    """Return steps of 0.1 degree as two's complement, low byte first (KST RS422, 3.5). Raises OverflowError beyond 16 bits."""
    return steps.to_bytes(2, "little", signed=True)


def decode_position(data: bytes) -> int:
    return int.from_bytes(data[:2], "little", signed=True)


def version_text(data: bytes) -> str:
    """Return the firmware version: text without trailing zero bytes if it is printable, else hexadecimal."""
    text = data[: REPLY_SIZES[Command.READ_VERSION]].rstrip(b"\0")
    return text.decode("ascii") if text and all(0x20 <= byte < 0x7F for byte in text) else data[:4].hex(" ")


class KstCodec(StreamCodec[Frame]):
    """Finds frames in a stream. Keeps at most 13 undecided bytes."""

    __slots__ = ("_header", "_strict")

    def __init__(self, version: int = VERSION, *, strict: bool = True) -> None:
        """`strict`: unused data bytes must be 0."""
        super().__init__()
        self._header = bytes((HEADER, version))
        self._strict = strict

    def next_reply(self) -> Frame | None:
        """Return the next frame that is right in every part; skips and counts bytes that cannot begin one."""
        buffer = self.buffer
        start = 0
        while (at := buffer.find(self._header, start)) >= 0:
            end = at + SIZE
            if len(buffer) < end:
                self.skip(at)
                return None
            if self._is_right(buffer[at:end]):
                frame = self.cut(at, end)
                return Frame(frame[2], frame[3], frame[4:12], frame)
            start = at + 1
        self.skip_to_header(self._header, start)
        return None

    def describe(self, frame: bytes, *, sent: bool) -> str:
        """Return one line about a frame; its code tells its direction."""
        reply = decode_single(KstCodec(self._header[1], strict=self._strict), frame)
        return f"not a KST frame: {frame.hex(' ')}" if reply is None else describe(reply)

    def _is_right(self, frame: bytes) -> bool:
        if frame[-1] != TRAILER or sum(frame[1:12]) & 0xFF != frame[12]:
            return False
        return not self._strict or not any(frame[4 + DATA_SIZES.get(frame[3], DATA_SIZE) : 12])


def rename(frame: bytes, rng: Random) -> bytes:
    """Return the same frame with another servo's id, never the broadcast id."""
    address = (frame[2] - 1 + rng.randint(1, 254)) % 255 + 1
    return encode(address, frame[3], frame[4:12], frame[1])


def node_of(frame: bytes) -> int:
    """Return the address of a complete frame."""
    return frame[2]


def name_of(command: int) -> str:
    """Return `set position`, or the number of a command that the document does not have."""
    try:
        return Command(command).name.lower().replace("_", " ")
    except ValueError:
        return f"command 0x{command:02X}"


def describe(frame: Frame) -> str:
    """Return one line about a frame, for `decode` and `--trace`."""
    who = "all" if frame.address == BROADCAST else f"id {frame.address}"
    what = name_of(frame.key)
    if frame.refused:
        code, _ = aborts.decode(frame.data[: aborts.CODE_SIZE], None)
        return f"{who} {what} refused: {aborts.abort_text(code, frame.data[: aborts.CODE_SIZE])}"
    if frame.code >= 2 * REPLY:
        return f"{who} code 0x{frame.code:02X}, which the protocol does not use: {frame.data.hex(' ')}"
    if frame.code < REPLY:
        return f"{who} {what}{_describe_data(frame.key, frame.data, REQUEST_SIZES)}"
    return f"{who} {what} ok{_describe_data(frame.key, frame.data, REPLY_SIZES)}"


def _describe_data(command: int, data: bytes, sizes: dict[int, int]) -> str:
    size = sizes.get(command, DATA_SIZE)
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
