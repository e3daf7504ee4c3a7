"""Who a servo says it is (addresses 0 to 4 are the same in every memory table), and what of it does not fit the config."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

from servobus.errors import NotSupported
from servobus.protocols.base import Plan, ask
from servobus.protocols.sms.model import SmsModel
from servobus.protocols.sms.model_loading import packaged_models
from servobus.protocols.sms.options import SmsBus
from servobus.protocols.sms.requests import Read
from servobus.protocols.sms.servo import FittedServo
from servobus.values import GoalKind, Identity

BIG_ENDIAN = 1
"""Address 2, END: 0 little, 1 big."""


def inspect(node: int) -> Plan[Identity]:
    """Firmware, model number, and the packaged model whose map fits."""
    major, minor, end, low, high = yield from ask(Read(node, 0, 5, bytes))
    number = low << 8 | high if end == BIG_ENDIAN else high << 8 | low
    model = next((model for model in packaged_models().values() if _family(model) == low), None)
    product = model.model_numbers.get(number) if model else None
    return Identity(model=model.name if model else None, product=product or f"model number {number}", firmware=f"{major}.{minor}")


def learn_mode(servo: FittedServo) -> Plan[None]:
    """What the servo would do with a goal, asked before it is energised. Raises NotSupported for modes that are neither position
    nor wheel."""
    words: dict[str, int] = {}
    for name in servo.model.wheel.registers if servo.model.wheel else ():
        register = servo.model.register(name)
        data = yield from ask(Read(servo.node, register.address, register.size, bytes))
        words[name] = servo.decode(register, data)
    servo.mode = _mode_of(servo, words)
    if servo.mode == "position" and words.get("mode", 0):
        raise NotSupported(
            f"its mode register reads {words['mode']}, which is neither position nor wheel: set it to 0 or 1", servo=servo.name
        )


def _mode_of(servo: FittedServo, words: Mapping[str, int]) -> GoalKind:
    wheel = servo.model.wheel.registers if servo.model.wheel else {}
    return "velocity" if wheel and all(words[name] == value for name, value in wheel.items()) else "position"


def identify(servo: FittedServo, options: SmsBus) -> Plan[Identity]:
    """The servo's own settings beside the config's; learns its mode. Writes nothing."""
    model = servo.model
    seen = yield from inspect(servo.node)
    words: dict[str, int] = {}
    wheel = model.wheel.registers if model.wheel else {}
    for name in dict.fromkeys((model.torque, "response_status_level", "min_angle_limit", "max_angle_limit", *wheel)):
        register = model.register(name)
        data = yield from ask(Read(servo.node, register.address, register.size, bytes))
        words[name] = servo.decode(register, data)
    servo.mode = _mode_of(servo, words)
    limits = _stored_limits(servo, words)
    notes = tuple(_notes(servo, options, seen, words, limits))
    return replace(seen, mode=servo.mode, energised=bool(words[model.torque]), limits=limits, notes=notes)


def _stored_limits(servo: FittedServo, words: Mapping[str, int]) -> tuple[float, float] | None:
    """The servo's own limits in its unit; both 0 mean none (multi-turn, wheel)."""
    ends = words["min_angle_limit"], words["max_angle_limit"]
    if ends == (0, 0):
        return None
    low, high = sorted(servo.calibration.to_unit(end) for end in ends)
    return low, high


def _notes(
    servo: FittedServo, options: SmsBus, seen: Identity, words: Mapping[str, int], limits: tuple[float, float] | None
) -> Iterator[str]:
    if seen.model != servo.options.model and seen.model is not None and servo.options.model in packaged_models():
        yield f"it says {seen.product} (model {seen.model}), the config says {servo.options.model}: check the model"
    level = words["response_status_level"]
    if level == 0 and options.status_return == "all":
        yield "its response level is 0, so it answers no write: set status_return: read_only, or every goal to it alone times out"
    if level != 0 and options.status_return != "all":
        yield f"it answers writes (response level {level}), the config says status_return: {options.status_return}"
    wanted = servo.options.limits
    if wanted and limits and servo.mode == "position" and (limits[0] > wanted[0] or limits[1] < wanted[1]):
        yield (
            f"its own stored limits {limits[0]:.1f} to {limits[1]:.1f} are tighter than the config's {wanted[0]:g} to "
            f"{wanted[1]:g}: goals between them end at the stored limit"
        )


def _family(model: SmsModel) -> int:
    """The byte at address 3 of this family's servos."""
    return model.model_number >> 8 if model.byte_order == "big" else model.model_number & 0xFF
