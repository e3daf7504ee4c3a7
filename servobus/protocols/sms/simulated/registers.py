"""The memory table of a simulated FEETECH servo: 256 addresses, of which the model file names some.

EEPROM exists twice: what the servo works with, and what a restart brings back. A write while the lock is on changes only the
first (feetech.md, section 9). Addresses without a register, and registers that can only be read, ignore writes.
"""

from __future__ import annotations

from servobus.protocols.model import Register
from servobus.protocols.sms.model import SmsModel

SIZE = 256
FIRMWARE = (3, 10)
RAM, EEPROM = 1, 2
BASICS = {
    "id": Register(name="id", address=5, memory="eeprom", default=1),
    "baud_rate": Register(name="baud_rate", address=6, memory="eeprom"),
    "response_status_level": Register(name="response_status_level", address=8, memory="eeprom", default=1),
    "async_write_flag": Register(name="async_write_flag", address=64, access="r"),
}
"""The same in every table; a model file that leaves one out has it still."""


class RegisterTable:
    """Bytes by address, words by register. What may be written from the wire is `write`; `put` is the servo's own hand."""

    __slots__ = ("_lock", "_number", "_order", "_stored", "_writable", "data", "registers")

    def __init__(self, model: SmsModel) -> None:
        self.registers = {**BASICS, **model.registers}
        self._order = model.byte_order
        self._number = model.model_number
        self._lock = model.registers[model.lock]
        self._writable = bytearray(SIZE)
        for register in self.registers.values():
            if register.access != "r":
                kind = EEPROM if register.memory == "eeprom" else RAM
                self._writable[register.address : register.end] = bytes((kind,)) * register.size
        self._stored = self._factory()
        self.data = bytearray(self._stored)
        self.restart()

    def get(self, register: Register) -> int:
        return register.decode(bytes(self.data[register.address : register.end]), self._order)

    def put(self, register: Register, raw: int) -> None:
        """Change what the servo works with; what is out of range ends at the end of the range."""
        self.data[register.address : register.end] = self._word(register, raw)

    def store(self, register: Register, raw: int) -> None:
        """Change it for good, whatever the lock says."""
        self.put(register, raw)
        self._stored[register.address : register.end] = self.data[register.address : register.end]

    def read(self, address: int, size: int) -> bytes:
        """Past the last address there is nothing to answer with, so the answer is shorter."""
        return bytes(self.data[address : address + size])

    def write(self, address: int, data: bytes) -> None:
        """Byte by byte, as the wire brings it: no register is checked for its range."""
        locked = self.get(self._lock) != 0
        for at, byte in enumerate(data[: SIZE - address], address):
            if self._writable[at]:
                self.data[at] = byte
                if self._writable[at] == EEPROM and not locked:
                    self._stored[at] = byte

    def restart(self) -> None:
        """What power-on does: RAM to its defaults, EEPROM as it was stored."""
        self.data[:] = self._stored
        for register in self.registers.values():
            if register.memory == "ram":
                self.put(register, register.default or 0)

    def reset(self, keep: Register) -> None:
        """EEPROM to factory values, for good, all but one register. RAM stays."""
        kept = self.get(keep)
        factory = self._factory()
        for register in self.registers.values():
            if register.memory == "eeprom":
                self.data[register.address : register.end] = factory[register.address : register.end]
        self._stored = factory
        self.store(keep, kept)

    def _factory(self) -> bytearray:
        """Defaults of the model file; addresses 0 to 4 say who it is, in every table."""
        data = bytearray(SIZE)
        for register in self.registers.values():
            if register.memory == "eeprom":
                data[register.address : register.end] = self._word(register, register.default or 0)
        big = self._order == "big"
        data[:5] = bytes((*FIRMWARE, big)) + self._number.to_bytes(2, self._order)
        return data

    def _word(self, register: Register, raw: int) -> bytes:
        """Not `Register.encode`: a device holds what the documents call out of range, too. Unsigned shows the magnitude."""
        bits = 8 * register.size if register.sign_bit is None else register.sign_bit
        word = min(abs(raw), (1 << bits) - 1)
        if raw < 0 and register.sign_bit is not None:
            word |= 1 << register.sign_bit
        return word.to_bytes(register.size, self._order)
