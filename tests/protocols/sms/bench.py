"""A driver and simulated servos, joined without line, loop or clock: each request is received, answered and parsed at once."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from servobus.errors import ReplyTimeout
from servobus.protocols.base import Plan, Request, run_plan
from servobus.protocols.sms.codec import Instruction, Packet
from servobus.protocols.sms.driver import SmsDriver
from servobus.protocols.sms.model import SmsModel, packaged_models
from servobus.protocols.sms.options import SmsBus
from servobus.protocols.sms.simulated.device import SmsDevice, devices
from servobus.values import Goal, Outcome, ServoGoal
from tests.protocols.sms.single_servo import packet_of

R = TypeVar("R")
Results = dict[str, Outcome | Exception]
TWO = {"a": {"id": 1, "model": "sts"}, "b": {"id": 2, "model": "sts"}}


class Bench:
    """`sent` are the frames in order; `is_lost` may name requests that get lost on the way."""

    def __init__(self, servos: Mapping[str, Mapping[str, Any]] = TWO, *, sts: SmsModel | None = None, **keys: Any) -> None:
        data = {"protocol": "sms", "port": "sim:", "baudrate": 1_000_000, "servos": servos, **keys}
        self.options = SmsBus.model_validate(data)
        models = {**packaged_models(), "sts": sts or packaged_models()["sts"]}
        self.driver = SmsDriver(self.options, models)
        self.devices: dict[int, SmsDevice] = {device.node: device for device in devices(self.options, models)}
        self.sent: list[Packet] = []
        self.is_lost: Callable[[Packet], bool] = lambda packet: False
        self.is_unanswered: Callable[[Packet], bool] = lambda packet: False
        """Heard and obeyed, but the answer gets lost."""
        self.now = 0.0

    def exchange(self, request: Request[Any]) -> Any:
        packet = packet_of(request.frame)
        self.sent.append(packet)
        received = []
        if not self.is_lost(packet):
            replies = [reply for device in self.devices.values() for reply in device.handle(packet, self.now)]
            received = [packet_of(reply.data) for reply in sorted(replies, key=lambda reply: reply.slot)]
        answers = [] if self.is_unanswered(packet) else [reply for reply in received if request.answers(reply)]
        if len(answers) < request.replies and not (request.partial and answers):
            raise ReplyTimeout("no answer", request=request)
        return request.parse(answers[: request.replies])

    def run(self, plan: Plan[R]) -> R:
        return run_plan(plan, self.exchange)

    def ask(self, request: Request[R]) -> R:
        value: R = self.exchange(request)
        return value

    def enable(self, *servos: str) -> None:
        for servo in servos or self.driver.nodes:
            self.run(self.driver.enable(servo))
        self.sent.clear()

    def move(self, goals: Mapping[str, float | Goal], *, together: bool = False, confirm: bool = False) -> Results:
        """Plan and run; the results of all turns."""
        asked = [ServoGoal(name, goal if isinstance(goal, Goal) else Goal("position", goal), 0.0) for name, goal in goals.items()]
        results: Results = {}
        for turn in self.driver.plan_goals(asked, together=together, confirm=confirm):
            results.update(self.run(turn.plan))
        return results

    def instructions(self) -> list[str]:
        return [Instruction(packet.code).name for packet in self.sent]

    def register(self, node: int, name: str) -> int:
        return self.devices[node].get(name)


def meddle(device: SmsDevice, torque: int) -> Callable[[Packet], bool]:
    """Somebody else writes the torque after every frame; no answer gets lost."""

    def mute(packet: Packet) -> bool:
        device.memory.put(device.memory.registers["torque_enable"], torque)
        return False

    return mute
