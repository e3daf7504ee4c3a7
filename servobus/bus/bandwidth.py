"""What the rates of a config ask of its line, before it is opened. Pure.

Counted is the time a turn holds the line: its bytes, and for each answer the pause before it. The driver says what
the frames are, so nothing here knows a protocol.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from servobus.engine.health import FIRST_ALLOWANCE
from servobus.engine.line import QUIET
from servobus.protocols.base import Driver, LineTraits, Request
from servobus.protocols.options import BusOptions, ServoOptions
from servobus.values import Goal, ServoGoal, StopTarget

TURNAROUND = 0.0005
"""Seconds assumed between a question and its answer: what FEETECH servos are shipped with (return delay 250 of 2 us)."""


@dataclass(frozen=True, slots=True)
class Bandwidth:
    """Of one bus. Shares in percent of the line's time, latencies in seconds from the call to the last byte of its frame."""

    shares: dict[str, float]
    """goals, and each poll by name."""
    goal_latency: float
    """Worst case while every servo answers: the longest turn is under way, and one of a lower class is owed."""
    estop_latency: float
    """Worst case while every servo answers: the longest turn is under way."""
    silent_latency: float
    """What a servo that does not answer adds to either, once."""

    @property
    def total(self) -> float:
        return sum(self.shares.values())


def line_bandwidth(options: BusOptions, driver: Driver, traits: LineTraits) -> Bandwidth:
    """Goals of all servos at the bus's `goal_rate`, polls at theirs."""
    driver.use_traits(traits)
    goals = driver.preview_goals([_any_goal(name, servo, driver) for name, servo in options.servos.items()])
    stop = driver.preview_stop([StopTarget(name, "hold", enabled=True, position=0.0) for name in driver.nodes])
    shares = {"goals": 100 * options.rate_of_goals * _seconds(goals, traits)}
    longest = max((_seconds([request], traits) for request in goals), default=0.0)
    polls = driver.polls(options.poll.rates())
    for poll in polls:
        request = poll.request(poll.nodes)
        if request is not None:
            seconds = _seconds([request], traits)
            shares[poll.name] = shares.get(poll.name, 0.0) + 100 * poll.hz * seconds
            longest = max(longest, seconds)
    silent = min(FIRST_ALLOWANCE, (options.timeout_ms or 1000) / 1000) + QUIET
    return Bandwidth(
        shares,
        goal_latency=2 * longest + _seconds(goals, traits) + traits.latency,
        estop_latency=longest + _seconds(stop, traits) + traits.latency,
        silent_latency=silent,
    )


def _seconds(requests: Sequence[Request[Any]], traits: LineTraits) -> float:
    """The time these hold the line."""
    return sum(
        traits.gap
        + traits.turn
        + (len(request.frame) + request.replies * request.reply_size) * traits.byte_time
        + request.replies * TURNAROUND
        + request.quiet_after
        for request in requests
    )


def _any_goal(name: str, servo: ServoOptions, driver: Driver) -> ServoGoal:
    """A goal inside the servo's limits; one setpoint of it where the host keeps the speed."""
    goal = ServoGoal(name, Goal("position", sum(servo.limits) / 2 if servo.limits else 0.0), 0.0)
    return replace(goal, lead=driver.host_speed(goal))
