"""Writes registers of FEETECH servos by name: what must not be written this way, and how EEPROM is written.

EEPROM is unlocked, written, locked again whatever happened, and read back (SMS 1.0, 1.3.3: without the unlock the value is lost
at power-off). It is written only while the torque is off.
"""

from __future__ import annotations

from typing import Any

from servobus.errors import DeviceError, LimitError, NotSupported, ServobusError
from servobus.protocols.base import Plan, ask
from servobus.protocols.model import Register
from servobus.protocols.sms.identity import learn
from servobus.protocols.sms.requests import Write
from servobus.protocols.sms.servo import UNKNOWN, HostServo

COMMISSIONING = frozenset({"id", "baud_rate", "response_status_level"})
"""Registers whose change makes the config untrue, so that the servo is lost."""


class SettingWriter:
    """The plans that write registers."""

    def write(self, servo: HostServo, name: str, value: Any, *, raw: bool, persist: bool) -> Plan[Any]:
        """Check everything, then return the plan. Raises LimitError, UnknownName, NotSupported before the first frame."""
        register = servo.model.writable(name)
        if not raw:
            register = servo.in_unit(register)
        _refuse(servo, register, persist)
        count = value if raw else servo.to_raw(register, value)
        if raw and (isinstance(value, bool) or not isinstance(value, int)):
            raise LimitError(f"register {register.name}: a raw value is an integer, found {value!r}", servo=servo.name)
        data = servo.encode(register, count)
        _refuse_sentinel_reset(servo, register, count)
        return self._plan(servo, register, data, count, raw=raw)

    def _plan(self, servo: HostServo, register: Register, data: bytes, count: int, *, raw: bool) -> Plan[Any]:
        if servo.fit.mode == UNKNOWN:
            raise NotSupported(f"register {register.name} is not written: {servo.fit.obstacle}", servo=servo.name)
        if register.memory == "eeprom":
            yield from self._write_eeprom(servo, register, data)
        else:
            yield from ask(self.request(servo, register, data))
        if register.memory == "eeprom" or not servo.answers_writes:
            reply = yield from ask(servo.read_raw(register))
            if reply != count:
                raise DeviceError(
                    f"register {register.name} reads {reply} after {count} was written: the servo did not take it",
                    servo=servo.name,
                )
        if register.name in servo.held:
            servo.hold({register.name: count})
            servo.own = {**servo.own, register.name: count}
        if register.name in servo.model.settings_at_start and servo.fit.identified:
            yield from learn(servo)
        return count if raw else servo.to_physical(register, count)

    def _write_eeprom(self, servo: HostServo, register: Register, data: bytes) -> Plan[None]:
        lock = servo.model.registers[servo.model.lock]
        if (yield from ask(servo.read_raw(servo.model.registers[servo.model.torque]))):
            raise NotSupported(
                "its torque is on, and EEPROM is written to servos at rest only: disable it first", servo=servo.name
            )
        try:
            yield from ask(self.request(servo, lock, b"\x00"))
            yield from ask(self.request(servo, register, data))
        except ServobusError:
            yield from ask(self.request(servo, lock, b"\x01"))
            raise
        yield from ask(self.request(servo, lock, b"\x01"))

    def request(self, servo: HostServo, register: Register, data: bytes) -> Write:
        """Return the WRITE of a register."""
        return Write(servo.node, register.address, data, answered=servo.answers_writes)


def _refuse(servo: HostServo, register: Register, persist: bool) -> None:
    """Refuse registers that other verbs own, and EEPROM without `persist`."""
    owners = {**dict.fromkeys(servo.model.goal, "use move"), servo.model.torque: "use enable or disable"}
    owners[servo.model.lock] = "an EEPROM write unlocks and locks by itself"
    if register.name in owners:
        raise NotSupported(f"register {register.name} is not written by hand: {owners[register.name]}", servo=servo.name)
    if register.name in COMMISSIONING:
        raise NotSupported(
            f"register {register.name} is not written while the bus runs: the config would no longer find the servo",
            servo=servo.name,
        )
    if register.memory == "eeprom" and not persist:
        raise NotSupported(f"register {register.name} is in EEPROM, which wears: add persist (--persist)", servo=servo.name)


def _refuse_sentinel_reset(servo: HostServo, register: Register, count: int) -> None:
    sentinel = servo.model.sentinel
    if register.name == sentinel.name and count == sentinel.reset:
        raise LimitError(
            f"register {register.name}: {count} is its value after a restart, and how a restart is noticed; write "
            f"{sentinel.value} instead",
            servo=servo.name,
        )
