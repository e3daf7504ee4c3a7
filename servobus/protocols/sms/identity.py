"""Who a FEETECH servo reports to be, whether it may be moved, and which of its settings do not fit the config.

Addresses 0 to 4 have the same meaning in every FEETECH memory table, and so have torque (40) and the REG WRITE flag (64). Nothing
here writes.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import NamedTuple

from servobus.errors import DeviceError
from servobus.protocols.base import Plan, ask
from servobus.protocols.sms.armed import Armed
from servobus.protocols.sms.model import LIMITS, SmsModel, packaged_models
from servobus.protocols.sms.options import SmsBus
from servobus.protocols.sms.requests import Read
from servobus.protocols.sms.servo import UNKNOWN, Fit, HostServo
from servobus.values import Identity

VERSION_SIZE = 5
ARMED_NOTE = (
    "a REG WRITE of an earlier program waits in it: an ACTION would carry it out. Enable or disable it, which disarms it, or "
    "switch its power off and on"
)


class Version(NamedTuple):
    """Addresses 0 to 4."""

    firmware_major: int
    firmware_minor: int
    end: int
    major: int
    minor: int

    @property
    def model(self) -> SmsModel | None:
        """The packaged model whose family covers it."""
        models = packaged_models().values()
        return next((model for model in models if model.family.covers(self.end, self.major, self.minor)), None)

    @property
    def number(self) -> int:
        """The model number, in the servo's byte order."""
        return self.major << 8 | self.minor if self.end else self.minor << 8 | self.major

    def identity(self) -> Identity:
        """Return what these bytes tell."""
        model, number = self.model, self.number
        product = model.model_numbers.get(number) if model else None
        firmware = f"{self.firmware_major}.{self.firmware_minor}"
        return Identity(model=model.name if model else None, product=product or f"model number {number}", firmware=firmware)


def inspect(node: int, armed: Armed) -> Plan[Identity]:
    """Return the plan that asks any node for its version and its flag."""
    version = yield from ask(Read(node, 0, VERSION_SIZE, _version))
    armed.suspect(node)
    identity = version.identity()
    waits = yield from armed.flag(node)
    obstacle = _unknown_obstacle(version) if identity.model is None else ""
    notes = (*((obstacle,) if obstacle else ()), *((ARMED_NOTE,) if waits else ()))
    return replace(identity, obstacle=obstacle, notes=notes)


def identify(servo: HostServo, options: SmsBus, armed: Armed) -> Plan[Identity]:
    """Return the plan that compares the servo's own settings with the config's. It makes the servo's `Fit`."""
    version = yield from learn(servo)
    armed.suspect(servo.node)
    torque = yield from ask(servo.read_raw(servo.model.registers[servo.model.torque]))
    waits = yield from armed.flag(servo.node)
    fit = servo.fit
    notes = (fit.obstacle, *_level_notes(fit, options), *_limit_notes(servo), ARMED_NOTE if waits else "")
    return replace(
        version.identity(),
        mode=None if fit.mode == UNKNOWN else fit.mode,
        energised=bool(torque),
        limits=servo.limits,
        notes=tuple(note for note in notes if note),
        obstacle=fit.obstacle,
    )


def learn(servo: HostServo) -> Plan[Version]:
    """Return the plan that makes the servo's `Fit`. Two readings must agree, because everything else follows from it."""
    version, fit = yield from _read_fit(servo, 0)
    last = servo.fit
    for more in (1, 2, 3):
        if fit == last:
            servo.learn(fit)
            return version
        last = fit
        version, fit = yield from _read_fit(servo, more)
    raise DeviceError("its settings read differently each time: two servos with this id, or noise?", servo=servo.name)


def _read_fit(servo: HostServo, more: int) -> Plan[tuple[Version, Fit]]:
    """Read the settings once; `more` bytes give the reply another length."""
    settings = servo.read_registers(servo.model.settings_at_start)
    end = settings.address + settings.reply_key
    data = yield from ask(Read(servo.node, 0, end + more, bytes))
    version = _version(data)
    return version, _fit(servo, version, settings.decode(data[settings.address : end]))


def _version(data: bytes) -> Version:
    return Version(*data[:VERSION_SIZE])


def _fit(servo: HostServo, version: Version, registers: Mapping[str, int]) -> Fit:
    model, level = servo.model, registers["response_status_level"]
    if not model.family.covers(version.end, version.major, version.minor):
        return Fit(UNKNOWN, None, level, None, _family_obstacle(servo, version), True)
    low, high = (registers[name] for name in LIMITS)
    mode, scale = model.mode(registers), model.speed_scale(registers)
    obstacle = _mode_obstacle(model, mode, registers) or _value_obstacle(model, registers)
    packaged = version.model  # a user's model file with units of its own counts more than a product's
    units = model.product_units.get(version.number) if packaged and packaged.units == model.units else None
    if (low, high) == (0, 0):  # more than one turn
        return Fit(mode, None, level, scale, obstacle, True, units)
    if low >= high:
        obstacle = (
            obstacle or f"its stored limits are in the wrong order ({LIMITS[0]} {low}, {LIMITS[1]} {high}): write them anew"
        )
    return Fit(mode, (low, high), level, scale, obstacle, True, units)


# Why it must not be moved


def _family_obstacle(servo: HostServo, version: Version) -> str:
    identity, configured = version.identity(), servo.options.model
    if identity.model is None:
        return _unknown_obstacle(version)
    return f"it reports {identity.product} (model {identity.model}), the config says {configured}: set model: {identity.model}"


def _unknown_obstacle(version: Version) -> str:
    return (
        f"no model knows it: it reports END {version.end} and version {version.major}/{version.minor} (addresses 2 to 4). "
        f"Give it a model file of its own, with its memory table and its family"
    )


def _mode_obstacle(model: SmsModel, mode: str, registers: Mapping[str, int]) -> str:
    if mode in model.kinds:
        return ""
    values = ", ".join(f"{name} reads {registers[name]}" for name in model.mode_registers)
    return f"it is in {mode} mode, which takes no position or velocity goals ({values}): change that while it is disabled"


def _value_obstacle(model: SmsModel, registers: Mapping[str, int]) -> str:
    for name, values in model.supported.items():
        if registers[name] not in values:
            supported = " or ".join(map(str, values))
            return (
                f"{name} reads {registers[name]}, and model {model.name} is true for {supported} only: write {values[-1]} to it"
            )
    return ""


# What does not fit the config


def _level_notes(fit: Fit, options: SmsBus) -> Iterator[str]:
    if fit.response_level == 0 and options.writes_answered:
        yield "its response level is 0, so it answers no write, whatever the config says: set status_return: read_only"
    if fit.response_level != 0 and not options.writes_answered:
        yield (f"it answers writes (response level {fit.response_level}), the config says status_return: {options.status_return}")


def _limit_notes(servo: HostServo) -> Iterator[str]:
    limits, own = servo.options.limits, servo.limits
    if limits and own and servo.takes == "position" and (own[0] > limits[0] or own[1] < limits[1]):
        yield (
            f"its own stored limits {own[0]:.1f} to {own[1]:.1f} are tighter than the config's {limits[0]:g} to "
            f"{limits[1]:g}: goals between them are refused"
        )
