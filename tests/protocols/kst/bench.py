"""A bench with simulated KST servos, a driver, and a plain function between them that owns the time."""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from typing import Any, TypeVar

from hypothesis import settings

from servobus.errors import ReplyTimeout
from servobus.protocols.base import Plan, Request, run_plan
from servobus.protocols.kst.codec import Command, Frame, KstCodec, encode, encode_position
from servobus.protocols.kst.driver import KstDriver
from servobus.protocols.kst.model import KstModel, packaged_model
from servobus.protocols.kst.options import KstBus
from servobus.protocols.kst.simulated.device import KstDevice, devices
from servobus.simulation.line import blend
from servobus.values import Goal, ServoGoal

R = TypeVar("R")
TRIES = 3
steady = settings(deadline=None, derandomize=True)
"""For property tests: the same examples in each run, without a time limit."""


def frame_of(data: bytes) -> Frame:
    codec = KstCodec(data[1], strict=False)
    codec.receive_data(data)
    frame = codec.next_reply()
    assert frame is not None
    return frame


def bus_options(servos: dict[str, dict[str, Any]] | None = None, **keys: Any) -> KstBus:
    servos = {"pan": {"id": 1}, "tilt": {"id": 2}} if servos is None else servos
    return KstBus.model_validate({"protocol": "kst", "port": "sim:", "servos": servos, **keys})


def changed_model(**parts: Any) -> KstModel:
    return KstModel.model_validate({**packaged_model().model_dump(), **parts})


class Bench:
    """A driver and its servos on a line that takes no time but the silences after requests. `loses` decides which replies are
    lost."""

    def __init__(self, servos: dict[str, dict[str, Any]] | None = None, *, model: KstModel | None = None, **keys: Any) -> None:
        self.options = bus_options(servos, **keys)
        models = dict.fromkeys((servo.model for servo in self.options.servos.values()), model or packaged_model())
        self.driver = KstDriver(self.options, models)
        self.devices = devices(self.options, models)
        self.now = 0.0
        self.baudrate = self.options.baudrate
        self.sent: list[Request[Any]] = []
        """The requests sent, including repetitions."""
        self.loses: Callable[[Request[Any]], bool] = lambda request: False
        self.altered: list[int] = []
        """Positions (steps) that the next reads bring instead of the right ones."""

    def exchange(self, request: Request[Any]) -> Any:
        """As the engine does it: three tries for what may be repeated."""
        for _ in range(TRIES if request.idempotent else 1):
            self.sent.append(request)
            replies = self._replies(request)
            self.now += request.quiet_after
            if not request.replies:
                return request.parse(())
            if replies:
                return request.parse(replies)
        raise ReplyTimeout("no answer", request=request)

    def run(self, plan: Plan[R]) -> R:
        return run_plan(plan, self.exchange)

    def frames(self) -> list[bytes]:
        """Return the frames sent since the last call."""
        sent, self.sent = self.sent, []
        return [request.frame for request in sent]

    def after(self, seconds: float) -> Bench:
        self.now += seconds
        return self

    def _replies(self, request: Request[Any]) -> list[Frame]:
        """Answers that are whole and belong to the question; those that come at once collide."""
        packet = frame_of(request.frame)
        if packet.code == Command.READ_POSITION and self.altered:
            return [frame_of(encode(packet.address, 0x40 + packet.code, encode_position(self.altered.pop(0))))]
        sent = [
            reply.data for device in self.devices if device.baudrate == self.baudrate for reply in device.handle(packet, self.now)
        ]
        if not sent or self.loses(request):
            return []
        codec = KstCodec(self.options.version_byte, strict=self.options.pad_check == "strict")
        codec.receive_data(reduce(lambda one, other: blend(one, other, 0), sent))
        reply = codec.next_reply()
        return [reply] if reply is not None and request.answers(reply) else []


def device_of(**settings: Any) -> KstDevice:
    return KstDevice(packaged_model(), **settings)


def ask_device(device: KstDevice, command: int, data: bytes = b"", *, to: int | None = None, now: float = 0.0) -> Frame | None:
    """What the device answers, if it does."""
    replies = device.handle(frame_of(encode(device.node if to is None else to, command, data, device.version)), now)
    assert len(replies) <= 1
    return frame_of(replies[0].data) if replies else None


def goal(servo: str, value: float, *, lead: float | None = None, **fields: Any) -> ServoGoal:
    return ServoGoal(servo, Goal("position", value, **fields), start=0.0, lead=lead)
