"""A bench with simulated hands, a driver, and a plain function between them that owns the time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

from servobus.errors import ReplyTimeout
from servobus.protocols.base import Plan, Request, run_plan
from servobus.protocols.modbus.codec import Frame, ModbusCodec, encode, pack, unpack
from servobus.protocols.modbus.requests import ReadHolding
from servobus.protocols.roh.driver import RohDriver
from servobus.protocols.roh.model import load_models, packaged_models
from servobus.protocols.roh.options import CHANNELS, RohBus
from servobus.protocols.roh.simulated.device import RohDevice, devices
from servobus.values import Goal, Outcome, ServoGoal

R = TypeVar("R")
TRIES = 3
GAP = 0.01
"""Seconds: shorter silences after a request take no time here."""
HAND: dict[str, dict[str, Any]] = {channel: {"id": 2, "channel": channel} for channel in CHANNELS}
"""All fingers of unit 2."""
THREE: dict[str, dict[str, Any]] = {
    f"{name}_{channel}": {"id": unit, "channel": channel}
    for unit, name in enumerate(("legacy", "v1", "v2"), 2)
    for channel in CHANNELS
}
"""All fingers of three hands."""


def question(data: bytes) -> Frame:
    codec = ModbusCodec("device")
    codec.receive_data(data)
    frame = codec.next_reply()
    assert frame is not None
    assert frame.frame == data
    return frame


def answer(data: bytes) -> Frame:
    codec = ModbusCodec()
    codec.receive_data(data)
    frame = codec.next_reply()
    assert frame is not None
    assert frame.frame == data
    return frame


def bus_options(servos: dict[str, dict[str, Any]] | None = None, **keys: Any) -> RohBus:
    servos = HAND if servos is None else servos
    return RohBus.model_validate({"protocol": "roh", "port": "sim:", "servos": servos, **keys})


class Bench:
    """A driver and its hands on a line that takes no time. `loses` decides which replies are lost."""

    def __init__(
        self, servos: dict[str, dict[str, Any]] | None = None, *, maps: dict[int, str] | None = None, **keys: Any
    ) -> None:
        """`maps`: what each hand has, when that is not what the config pins."""
        self.options = bus_options(servos, **keys)
        self.models = load_models(self.options, Path())
        self.driver = RohDriver(self.options, self.models)
        self.devices = [
            RohDevice(self.models[maps[hand.node]], hand.node) if maps and hand.node in maps else hand
            for hand in devices(self.options, self.models)
        ]
        self.now = 0.0
        self.sent: list[Request[Any]] = []
        """The requests sent, including repetitions."""
        self.loses: Callable[[Request[Any]], bool] = lambda request: False
        self.altered: list[tuple[int, int]] = []
        """Addresses, and the words that the next reads of them bring instead of the right ones."""

    @property
    def hand(self) -> RohDevice:
        return self.devices[0]

    def exchange(self, request: Request[Any]) -> Any:
        """As the engine does it: three tries for what may be repeated."""
        for _ in range(TRIES if request.idempotent else 1):
            self.sent.append(request)
            received = self._replies(request)
            self.now += request.service_time + (request.quiet_after if request.quiet_after > GAP else 0.0)
            if not request.replies:
                return request.parse(())
            if received:
                return request.parse(received)
        raise ReplyTimeout("no answer", request=request)

    def _replies(self, request: Request[Any]) -> list[Frame]:
        sent = [reply.data for hand in self.devices for reply in hand.handle(question(request.frame), self.now)]
        if not sent or self.loses(request):
            return []
        assert len(sent) == 1
        reply = answer(self._alter(request, sent[0]))
        return [reply] if request.answers(reply) else []

    def _alter(self, request: Request[Any], frame: bytes) -> bytes:
        """Return the reply with another value, whose checksum is right."""
        if not self.altered or not isinstance(request, ReadHolding):
            return frame
        (address, word), registers = self.altered[0], unpack(frame[3:-2])
        if not request.address <= address < request.address + request.count:
            return frame
        del self.altered[0]
        registers[address - request.address] = word
        return encode(frame[0], frame[1], frame[2:3] + pack(registers))

    def run(self, plan: Plan[R]) -> R:
        return run_plan(plan, self.exchange)

    def frames(self) -> list[str]:
        """Return a description of each frame sent since the last call."""
        sent, self.sent = self.sent, []
        return [ModbusCodec().describe(request.frame, sent=True) for request in sent]

    def after(self, seconds: float) -> Bench:
        self.now += seconds
        for hand in self.devices:
            hand.advance(self.now)
        return self

    def enable(self, *servos: str) -> Bench:
        for servo in servos or self.driver.nodes:
            self.run(self.driver.enable(servo))
        self.frames()
        for hand in self.devices:
            hand.written.clear()
        return self

    def move(self, *goals: ServoGoal, together: bool = False) -> dict[str, Outcome | Exception]:
        results: dict[str, Outcome | Exception] = {}
        for turn in self.driver.plan_goals(goals, together=together, confirm=False):
            results |= self.run(turn.plan)
        return results

    def read(self, servo: str, register: str, *, raw: bool = False) -> Any:
        return self.exchange(self.driver.read_register(servo, register, raw=raw))

    def write(self, servo: str, register: str, value: Any, **how: bool) -> Any:
        return self.run(self.driver.write_register(servo, register, value, **how))


def bench_of(name: str, **keys: Any) -> Bench:
    """One hand with this map, which the config does not name."""
    return Bench(maps={2: name}, **keys)


def goal(servo: str, value: float, *, start: float | None = None, **fields: Any) -> ServoGoal:
    return ServoGoal(servo, Goal(fields.pop("kind", "position"), value, **fields), start)


def hand_of(name: str = "v2", unit: int = 2) -> RohDevice:
    return RohDevice(packaged_models()[name], unit)


def ask_device(hand: RohDevice, function: int, data: bytes, *, to: int | None = None, now: float = 0.0) -> Frame | None:
    """What the hand answers, if it does."""
    replies = hand.handle(question(encode(hand.node if to is None else to, function, data)), now)
    assert len(replies) <= 1
    return answer(replies[0].data) if replies else None


def read_registers(hand: RohDevice, address: int, count: int = 1, *, now: float = 0.0) -> list[int]:
    """What is read there; an exception is an empty list."""
    reply = ask_device(hand, 3, pack((address, count)), now=now)
    assert reply is not None
    return unpack(reply.data[1:])


def write_registers(
    hand: RohDevice, address: int, values: Sequence[int] | int, *, now: float = 0.0, to: int | None = None
) -> int | None:
    """0: taken; else the exception; None: no answer."""
    some = [values] if isinstance(values, int) else list(values)
    data = pack((address, len(some))) + bytes((2 * len(some),)) + pack(some)
    reply = ask_device(hand, 0x10, data, now=now, to=to)
    if reply is None:
        return None
    return reply.data[0] if reply.function & 0x80 else 0


def three_hands(**keys: Any) -> Bench:
    return Bench(THREE, maps={2: "legacy", 3: "v1", 4: "v2"}, **keys)


def all_fingers(value: float, **fields: Any) -> list[ServoGoal]:
    return [goal(channel, value, **fields) for channel in CHANNELS]
