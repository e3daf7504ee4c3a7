"""The memory table of a simulated FEETECH servo: 256 addresses, of which the model file names some.

EEPROM exists twice: the values that the servo works with, and the stored ones that a restart brings back. A write while the lock
is on changes only the first (SMS 1.0, 1.3.3). Addresses without a register, and registers that can only be read, ignore writes.
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
"""These are the same in every table, so a servo has them also where its model file leaves them out."""


class RegisterTable:
    """Bytes by address, values by register. `write` is a write from the wire; `put` and `store` are the servo's own changes."""

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
        """Return the raw value that the servo works with."""
        return register.decode(bytes(self.data[register.address : register.end]), self._order)

    def put(self, register: Register, raw: int) -> None:
        """Change the value that the servo works with; a value out of range is replaced by the end of the range."""
        self.data[register.address : register.end] = self._word(register, raw)

    def store(self, register: Register, raw: int) -> None:
        """Change the stored value too, whether it is locked or not."""
        self.put(register, raw)
        self._stored[register.address : register.end] = self.data[register.address : register.end]

    def identify(self, identity: bytes) -> None:
        """Report these bytes at addresses 2 to 4, also after a restart."""
        self.data[2:5] = self._stored[2:5] = identity

    def read(self, address: int, size: int) -> bytes:
        """Return these bytes; fewer where the table ends."""
        return bytes(self.data[address : address + size])

    def write(self, address: int, data: bytes) -> None:
        """Write bytes from the wire, without a check of any register's range."""
        locked = self.get(self._lock) != 0
        for at, byte in enumerate(data[: SIZE - address], address):
            if self._writable[at]:
                self.data[at] = byte
                if self._writable[at] == EEPROM and not locked:
                    self._stored[at] = byte

    def restart(self) -> None:
        """Do what power-on does: RAM gets its defaults, EEPROM its stored values."""
        self.data[:] = self._stored
        for register in self.registers.values():
            if register.memory == "ram":
                self.put(register, register.default or 0)

    def reset(self, keep: Register) -> None:
        """Store the factory values in EEPROM, except one register. RAM does not change."""
        kept = self.get(keep)
        factory = self._factory()
        for register in self.registers.values():
            if register.memory == "eeprom":
                self.data[register.address : register.end] = factory[register.address : register.end]
        self._stored = factory
        self.store(keep, kept)

    def _factory(self) -> bytearray:
        """Return the defaults of the model file; addresses 0 to 4 are the identity in every table."""
        data = bytearray(SIZE)
        for register in self.registers.values():
            if register.memory == "eeprom":
                data[register.address : register.end] = self._word(register, register.default or 0)
        big = self._order == "big"
        data[:5] = bytes((*FIRMWARE, big)) + self._number.to_bytes(2, self._order)
        return data

    def _word(self, register: Register, raw: int) -> bytes:
        """Encode without a check: a servo can hold values outside the documented range; an unsigned one keeps the magnitude."""
        bits = 8 * register.size if register.sign_bit is None else register.sign_bit
        word = min(abs(raw), (1 << bits) - 1)
        if raw < 0 and register.sign_bit is not None:
            word |= 1 << register.sign_bit
        return word.to_bytes(register.size, self._order)
