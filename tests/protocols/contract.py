"""What every protocol must hold to: its codec, its requests, its driver and its simulated devices, joined without a line.

`test_contract.py` runs these checks for every protocol of the registry, and `test_writing_a_driver.py` for the one that the page
builds.
"""

from __future__ import annotations

import operator
import random
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import pytest

from servobus.errors import ReplyTimeout, ServobusError
from servobus.protocols.base import Codec, LineTraits, Plan, Reply, Request, run_plan
from servobus.protocols.definition import ProtocolDefinition
from servobus.values import Goal, Outcome, ServoGoal, StopReport, StopTarget

R = TypeVar("R")

BUSES: dict[str, Mapping[str, Any]] = {
    "sms": {"a": {"id": 1, "model": "sts"}, "b": {"id": 2, "model": "sms"}},
    "kst": {"a": {"id": 1}, "b": {"id": 2}},
    "roh": {"a": {"id": 2, "channel": "index"}, "b": {"id": 2, "channel": "middle"}, "c": {"id": 3, "channel": "thumb_bend"}},
}
"""Protocol -> servos of a bus with at least two nodes or two servos of a node."""
MAX_PENDING = 300
"""More undecided bytes than any codec may keep."""


class Joined:
    """A driver and the simulated devices of its bus; each request is answered at once, by the bytes alone."""

    def __init__(self, definition: ProtocolDefinition, name: str, servos: Mapping[str, Any]) -> None:
        keys = {"protocol": name, "port": "sim:", "baudrate": definition.baudrates[0], "servos": servos}
        self.definition = definition
        self.options = definition.options.model_validate(keys)
        models = definition.models(self.options, Path())
        self.driver = definition.driver(self.options, models)
        self.driver.use_traits(LineTraits(self.options.baudrate))
        self.devices = definition.devices(self.options, models)
        self.lost: Callable[[int], bool] = lambda number: False
        """Whether the replies to the request with this number are lost."""
        self.now = 0.0
        self.requests: list[bytes] = []
        self.replies: list[bytes] = []

    def exchange(self, request: Request[Any]) -> Any:
        """Return the request's value. Checks that every reply is as the request announces it."""
        (packet,) = decode(self.definition.device_codec(self.options), [request.frame])
        self.requests.append(request.frame)
        self.now += 0.01
        replies = [reply for device in self.devices for reply in device.handle(packet, self.now)]
        frames = [reply.data for reply in sorted(replies, key=lambda reply: reply.slot)]
        self.replies += frames
        answers = [reply for reply in decode(self.definition.codec(self.options), frames) if request.answers(reply)]
        if self.lost(len(self.requests)) or len(answers) < request.replies:
            if request.replies:
                raise ReplyTimeout("the reply is lost", request=request)
            answers = []
        for reply in answers:
            assert reply.key == request.reply_key
            assert not request.reply_size or len(reply.frame) <= max(request.reply_size, len(request.frame))
            assert not request.nodes or reply.node in request.nodes
        return request.parse(answers[: request.replies])

    def run(self, plan: Plan[R]) -> R:
        return run_plan(plan, self.exchange)

    def enable_all(self) -> dict[str, float]:
        """Identify, read and enable every servo; the positions."""
        positions = {}
        for servo in self.driver.nodes:
            self.run(self.driver.identify(servo))
            present = self.run(self.driver.enable(servo))
            assert present is not None
            positions[servo] = present
        return positions

    def targets(self) -> list[StopTarget]:
        return [StopTarget(servo, "hold", enabled=True) for servo in self.driver.nodes]

    def goals(self, positions: Mapping[str, float]) -> list[ServoGoal]:
        return [ServoGoal(servo, Goal("position", position + 1.0), position) for servo, position in positions.items()]

    def send(self, goals: Sequence[ServoGoal], *, together: bool = False) -> dict[str, Outcome | Exception]:
        results: dict[str, Outcome | Exception] = {}
        for turn in self.driver.plan_goals(goals, together=together, confirm=False):
            results.update(self.run(turn.plan))
        return results

    def position(self, servo: str) -> float:
        value = self.exchange(self.driver.read_state(servo))[servo]["position"]
        assert isinstance(value, float)
        return value


def decode(codec: Codec, pieces: Sequence[bytes]) -> list[Reply]:
    """Return every frame that the codec finds in these pieces."""
    frames = []
    for piece in pieces:
        codec.receive_data(piece)
        while (reply := codec.next_reply()) is not None:
            frames.append(reply)
        assert codec.pending < MAX_PENDING
    return frames


def conversation(joined: Joined) -> None:
    """Use every role of the driver once."""
    goals = joined.goals(joined.enable_all())
    for goal in goals:
        joined.driver.check_goal(goal)
    joined.send(goals)
    joined.run(joined.driver.stop(joined.targets()))
    for servo, node in joined.driver.nodes.items():
        joined.exchange(joined.driver.ping(node))
        joined.run(joined.driver.inspect(node))
        joined.run(joined.driver.disable(servo))


# The checks


def check_codec(joined: Joined) -> None:
    """Frames are found in any pieces, garbage between them is skipped and counted, and little is kept of endless garbage."""
    conversation(joined)
    rng = random.Random(1)
    for codec_of, frames in ((joined.definition.codec, joined.replies), (joined.definition.device_codec, joined.requests)):
        stream = b"".join(frames)
        cuts = sorted(rng.sample(range(1, len(stream)), 40))
        pieces = [stream[start:end] for start, end in zip([0, *cuts], [*cuts, len(stream)], strict=True)]
        for delivery in ([stream], pieces, [bytes((byte,)) for byte in stream]):
            codec = codec_of(joined.options)
            assert [reply.frame for reply in decode(codec, delivery)] == frames
            assert (codec.pending, codec.skipped) == (0, 0)
        codec = codec_of(joined.options)
        garbage = b"\x00" * 3
        noisy = [piece for frame in frames for piece in (garbage, frame)]
        assert [reply.frame for reply in decode(codec, noisy)] == frames
        assert codec.skipped == len(garbage) * len(frames)
        assert decode(codec, [b"\x00" * 100] * 20) == []
        codec.reset()
        codec.receive_data(frames[0][:-1])
        codec.reset()
        assert [reply.frame for reply in decode(codec, [frames[0]])] == frames[:1]
        assert all(len(codec.describe(frame, sent=frames is joined.requests)) > 1 for frame in frames)


def check_fence(joined: Joined) -> None:
    """A fence has a key that is not under way, and the next one has another; a fence of a healthy node returns True."""
    joined.enable_all()
    for servo, node in joined.driver.nodes.items():
        avoid: list[Any] = [joined.driver.read_state(servo).reply_key]
        for _ in range(4):
            keys: list[Any] = []

            def exchange(request: Request[Any], keys: list[Any] = keys) -> Any:
                keys.append(request.reply_key)
                return joined.exchange(request)

            assert run_plan(joined.driver.fence(node, avoid[:3], [servo]), exchange) is True
            assert keys[0] not in avoid[:3]
            avoid = [*avoid[1:], keys[0]]


def check_closed_plans(joined: Joined) -> None:
    """Every plan may be closed at any frame: it yields no more, and the joint stays where it is."""
    positions = joined.enable_all()
    driver = joined.driver
    plans: list[Callable[[], Plan[Any]]] = [partial(driver.stop, joined.targets())]
    for servo, node in driver.nodes.items():
        plans += [partial(verb, servo) for verb in (driver.enable, driver.identify, driver.disable)]
        plans.append(partial(driver.fence, node, [], [servo]))
    for make in plans:
        frames = 0
        while close_at(joined, make(), frames):
            frames += 1
        for servo, position in positions.items():
            assert joined.position(servo) == pytest.approx(position)


def close_at(joined: Joined, plan: Plan[Any], frames: int) -> bool:
    """Run a plan and close it after so many frames; whether it was still running."""
    try:
        request = next(plan)
        for _ in range(frames):
            request = plan.send(joined.exchange(request))
    except StopIteration:
        return False
    plan.close()
    return True


def check_lost_replies(joined: Joined) -> None:
    """Whichever reply is lost, a stop reports every servo and goals end with an outcome or an error for every servo."""
    positions = joined.enable_all()
    servos = set(joined.driver.nodes)
    for lost in range(1, 12):
        for together in (False, True):
            joined.lost = partial(operator.eq, len(joined.requests) + lost)
            results = joined.send(joined.goals(positions), together=together)
            assert set(results) == servos
            assert all(isinstance(result, Outcome | ServobusError) for result in results.values())
        joined.lost = partial(operator.eq, len(joined.requests) + lost)
        reports = joined.run(joined.driver.stop(joined.targets()))
        assert set(reports) == servos
        assert all(isinstance(report, StopReport) for report in reports.values())
    joined.lost = lambda number: True
    reports = joined.run(joined.driver.stop(joined.targets()))
    assert set(reports) == servos
    assert not any(report.confirmed for report in reports.values())


def check_previews(joined: Joined) -> None:
    """Previews ask nothing and change nothing, and have the size of what is really sent once the servos hold their settings."""
    positions = dict.fromkeys(joined.driver.nodes, 0.0)
    goals = joined.goals(positions)
    preview, again = ([request.frame for request in joined.driver.preview_goals(goals)] for _ in range(2))
    assert preview == again
    assert preview
    stop = [request.frame for request in joined.driver.preview_stop(joined.targets())]
    assert stop
    assert joined.driver.preview_goals([]) == joined.driver.preview_stop([]) == []
    joined.enable_all()
    joined.send(goals)
    joined.requests.clear()
    joined.send(goals)
    assert [len(frame) for frame in joined.requests] == [len(frame) for frame in preview]


CHECKS = [check_codec, check_fence, check_closed_plans, check_lost_replies, check_previews]
