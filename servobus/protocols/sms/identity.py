"""Who a FEETECH servo reports to be, and which of its settings do not fit the config.

Addresses 0 to 4 have the same meaning in every FEETECH memory table. Nothing here writes.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

from servobus.errors import NotSupported
from servobus.protocols.base import Plan, ask
from servobus.protocols.sms.model import SETTINGS_AT_START, SmsModel, packaged_models
from servobus.protocols.sms.options import SmsBus
from servobus.protocols.sms.requests import Read
from servobus.protocols.sms.servo import Fit, HostServo
from servobus.values import GoalKind, Identity

BIG_ENDIAN = 1
"""Address 2 (END): 0 is low byte first, 1 is high byte first."""


def inspect(node: int) -> Plan[Identity]:
    """Return the plan that asks for firmware, model number, and the packaged model whose map fits."""
    major, minor, end, low, high = yield from ask(Read(node, 0, 5, bytes))
    number = low << 8 | high if end == BIG_ENDIAN else high << 8 | low
    model = next((model for model in packaged_models().values() if _family(model) == low), None)
    product = model.model_numbers.get(number) if model else None
    return Identity(model=model.name if model else None, product=product or f"model number {number}", firmware=f"{major}.{minor}")


def learn_mode(servo: HostServo) -> Plan[None]:
    """Return the plan that asks for the servo's mode. It raises NotSupported for a mode that is neither position nor wheel."""
    registers = yield from _read_raw(servo, _wheel(servo))
    mode = _mode(servo, registers)
    servo.learn(replace(servo.fit, mode=mode))
    if mode == "position" and registers.get("mode", 0):
        raise NotSupported(
            f"its mode register reads {registers['mode']}, which is neither position nor wheel: set it to 0 or 1",
            servo=servo.name,
        )


def identify(servo: HostServo, options: SmsBus) -> Plan[Identity]:
    """Return the plan that compares the servo's own settings with the config's. It makes the servo's `Fit`."""
    identity = yield from inspect(servo.node)
    torque = servo.model.torque
    registers = yield from _read_raw(servo, dict.fromkeys((torque, *SETTINGS_AT_START, *_wheel(servo))))
    fit = Fit(_mode(servo, registers), _stored_limits(servo, registers), registers["response_status_level"])
    servo.learn(fit)
    notes = (*_model_notes(servo, identity), *_level_notes(fit, options), *_limit_notes(servo, fit))
    return replace(identity, mode=fit.mode, energised=bool(registers[torque]), limits=fit.limits, notes=notes)


def _read_raw(servo: HostServo, names: Iterable[str]) -> Plan[dict[str, int]]:
    registers: dict[str, int] = {}
    for name in names:
        registers[name] = yield from ask(servo.read_raw(servo.model.register(name)))
    return registers


def _wheel(servo: HostServo) -> Mapping[str, int]:
    """The registers that decide about wheel mode, and their values there."""
    return servo.model.wheel.registers if servo.model.wheel else {}


def _mode(servo: HostServo, registers: Mapping[str, int]) -> GoalKind:
    wheel = _wheel(servo)
    return "velocity" if wheel and all(registers[name] == raw for name, raw in wheel.items()) else "position"


def _stored_limits(servo: HostServo, registers: Mapping[str, int]) -> tuple[float, float] | None:
    """The servo's own limits in its unit; both 0 mean that it has none (multi-turn, wheel)."""
    ends = registers["min_angle_limit"], registers["max_angle_limit"]
    if ends == (0, 0):
        return None
    low, high = sorted(servo.calibration.to_unit(end) for end in ends)
    return low, high


def _model_notes(servo: HostServo, identity: Identity) -> Iterator[str]:
    model = servo.options.model
    if identity.model not in (model, None) and model in packaged_models():
        yield f"it reports {identity.product} (model {identity.model}), the config says {model}: check the model"


def _level_notes(fit: Fit, options: SmsBus) -> Iterator[str]:
    if fit.response_level == 0 and options.writes_answered:
        yield "its response level is 0, so it answers no write: set status_return: read_only, or every goal to it alone times out"
    if fit.response_level != 0 and not options.writes_answered:
        yield (f"it answers writes (response level {fit.response_level}), the config says status_return: {options.status_return}")


def _limit_notes(servo: HostServo, fit: Fit) -> Iterator[str]:
    limits = servo.options.limits
    if limits and fit.limits and fit.mode == "position" and (fit.limits[0] > limits[0] or fit.limits[1] < limits[1]):
        yield (
            f"its own stored limits {fit.limits[0]:.1f} to {fit.limits[1]:.1f} are tighter than the config's {limits[0]:g} to "
            f"{limits[1]:g}: goals between them end at the stored limit"
        )


def _family(model: SmsModel) -> int:
    """The byte at address 3 of this family's servos."""
    return model.model_number >> 8 if model.byte_order == "big" else model.model_number & 0xFF
