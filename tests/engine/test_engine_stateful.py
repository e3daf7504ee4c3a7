"""The engine against a simple model of the line, over all orders of events that hypothesis thinks of.

What the model checks at every frame: one frame is on the line at a time, a doubtful node is asked nothing but a fence, a write
is not repeated, and the e-stop is next. What the machine checks after every event: each value is the one that its node produced
for the newest request of that caller, nothing moves after a stop, queues are bounded, and health changes as it may.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from servobus.engine.engine import WaitUntil
from servobus.engine.job import Job, JobKind
from servobus.engine.stats import Counter
from servobus.engine.turn import Transmit
from servobus.errors import LinkDown, Overloaded, ServobusError
from servobus.protocols.base import Plan, Request
from servobus.values import Health, Outcome
from tests.engine.driven_engine import Rig
from tests.engine.modelled_line import POISON, STOP_WORD, ModelledLine
from tests.engine.toy_protocol import ALL, READ, Sink, ToyRequest, poll, read, reply, shout, ticket, write

NODES = (1, 2, 3)
LIMIT = 6
GOALS = 3
STEPS_AT_ONE_TIME = 200
ONLINE, DOUBTFUL, OFFLINE = Health.ONLINE, Health.DOUBTFUL, Health.OFFLINE
LEGAL = {(ONLINE, DOUBTFUL), (DOUBTFUL, ONLINE), (DOUBTFUL, OFFLINE), (OFFLINE, ONLINE)}
POLL_REGISTER = 0

nodes = st.sampled_from(NODES)


class Call:
    """What a caller asked for, and the registers whose values it must get."""

    def __init__(self, registers: tuple[tuple[int, int], ...], *, group: bool = False) -> None:
        self.sink = Sink()
        self.registers = registers
        self.group = group
        self.is_stop = group and not registers
        self.checked = False

    @property
    def ended(self) -> bool:
        return self.sink.done()


class EngineMachine(RuleBasedStateMachine):
    def __init__(self) -> None:
        super().__init__()
        self.rig = Rig(*NODES, limit=LIMIT)
        self.engine = self.rig.engine
        self.line = ModelledLine(NODES)
        self.calls: list[Call] = []
        self.ended: list[tuple[str, Any]] = []
        """How goals ended."""
        self.goals = 0
        self.stopped = 0
        """Goals that ended, or were put, before the newest e-stop."""
        self.health = dict.fromkeys(NODES, ONLINE)
        self.serial = 0
        self.lost_turns = 0
        self.advance(0.1)

    # The shell

    def advance(self, seconds: float) -> None:
        """Let time pass as the bus master does: at each deadline and each wake the engine is asked."""
        end = self.line.now + seconds
        self.pump()
        for _ in range(STEPS_AT_ONE_TIME):
            when = min((time for time in (self.engine.deadline, self.wake) if time is not None), default=end)
            self.line.now = min(end, max(when, self.line.now))
            self.line.deadline_passed()
            self.engine.timed_out(self.line.now)
            self.pump()
            if self.line.now >= end:
                return
        raise AssertionError("the engine asks to be woken without end")

    def pump(self) -> None:
        for _ in range(STEPS_AT_ONE_TIME):
            action = self.engine.next_action(self.line.now)
            if not isinstance(action, Transmit):
                self.wake = action.when if isinstance(action, WaitUntil) else None
                return
            self.line.transmitted(action)
        raise AssertionError("the engine sends without end")

    def receive(self, data: bytes) -> None:
        self.line.now += 0.0001
        self.engine.receive(data, self.line.now)
        self.pump()

    def number(self) -> int:
        """The next register or value, of which no two calls under way have the same."""
        self.serial = self.serial % 200 + 1
        return self.serial

    def submit(self, call: Call, request: Request[Any] | None = None, plan: Plan[Any] | None = None, **traits: Any) -> None:
        job = Job(call.sink, self.line.now + 2.0, request=request, plan=plan, **traits)
        try:
            self.engine.submit(job, self.line.now)
        except Overloaded:
            assert self.engine.scheduler.waiting() >= LIMIT
            return
        except LinkDown:
            assert not self.engine.up
            return
        self.calls.append(call)
        self.pump()

    # Callers

    @rule(node=nodes, even=st.booleans())
    def asks(self, node: int, even: bool) -> None:
        register = self.number()
        self.submit(Call(((node, register),)), read(node, register), even_if_offline=even)

    @rule(node=nodes)
    def asks_too_often(self, node: int) -> None:
        for _ in range(2 * LIMIT):
            self.asks(node, even=False)

    @rule(node=nodes)
    def writes(self, node: int) -> None:
        self.submit(Call(()), write(node, self.number(), idempotent=False))

    @rule(group=st.sets(nodes, min_size=2).map(sorted))
    def asks_several(self, group: list[int]) -> None:
        register = self.number()
        request = ToyRequest(ALL, READ, register, nodes=tuple(group), partial=True)
        self.submit(Call(tuple((node, register) for node in group), group=True), request)

    @rule(node=nodes, kind=st.sampled_from([JobKind.ORDINARY, JobKind.MOTION]))
    def runs_a_plan(self, node: int, kind: JobKind) -> None:
        first, second = self.number(), self.number()

        def plan() -> Plan[list[int]]:
            value = yield read(node, first)
            yield shout(first)
            return [value, (yield read(node, second))]

        self.submit(Call(((node, first), (node, second))), plan=plan(), node=node, kind=kind)

    @rule(node=nodes)
    def moves(self, node: int) -> None:
        self.goals += 1
        goal = ticket(node, self.ended, expires=self.line.now + 0.3)
        goal.done = partial(self.goal_ended, self.goals, goal.expires, goal.done)
        self.engine.scheduler.put_goal(goal, self.line.now)
        self.pump()

    def goal_ended(self, number: int, expires: float, done: Callable[[Any], None], result: Outcome | Exception) -> None:
        if result is Outcome.SENT:
            assert self.line.now <= expires, "a goal left after its time"
            assert number > self.stopped, "a goal left after the e-stop"
        done(result)

    @rule(which=st.integers(0, 100))
    def leaves(self, which: int) -> None:
        waiting = [call for call in self.calls if not call.ended and not call.is_stop]
        if waiting:
            waiting[which % len(waiting)].sink.cancelled = True
            self.pump()

    @precondition(lambda self: self.engine.up)
    @rule()
    def stops(self) -> None:
        register = self.number()
        others = [call for call in self.calls if call.is_stop and not call.ended]

        def plan() -> Plan[str]:
            yield shout(STOP_WORD)
            try:
                yield read(1, register)
            except ServobusError:
                return "not confirmed"
            return "confirmed"

        call = Call((), group=True)
        self.calls.append(call)
        self.engine.submit_stop(Job(call.sink, self.line.now + 2.0, plan=plan(), node=1, kind=JobKind.ESTOP))
        self.line.stop_due = not others
        self.stopped = self.goals
        self.pump()

    @rule(hz=st.sampled_from([0, 5, 50]))
    def polls(self, hz: int) -> None:
        wanted = [poll("feedback", hz, *NODES)] if hz else []
        self.engine.scheduler.set_polls(wanted, self.line.now)
        self.pump()

    # The line

    @precondition(lambda self: self.line.under_way())
    @rule(which=st.integers(0, 100), twice=st.booleans())
    def replies(self, which: int, twice: bool) -> None:
        waiting = self.line.under_way()
        frame = self.line.deliver(waiting[which % len(waiting)])
        self.receive(2 * frame if twice else frame)

    @precondition(lambda self: self.line.under_way())
    @rule(rounds=st.integers(1, 6))
    def all_reply(self, rounds: int) -> None:
        for _ in range(rounds):
            for node in self.line.under_way():
                self.receive(self.line.deliver(node))
            self.advance(0.003)

    @precondition(lambda self: self.line.under_way())
    @rule(which=st.integers(0, 100), at=st.sampled_from([1, 3, 4, -1]), bit=st.integers(0, 7))
    def reply_is_garbled(self, which: int, at: int, bit: int) -> None:
        waiting = self.line.under_way()
        frame = bytearray(self.line.lose(waiting[which % len(waiting)]))
        frame[at] ^= 1 << bit
        self.receive(bytes(frame))

    @precondition(lambda self: self.line.under_way())
    @rule(which=st.integers(0, 100), size=st.integers(0, 4))
    def reply_is_cut(self, which: int, size: int) -> None:
        waiting = self.line.under_way()
        frame = self.line.lose(waiting[which % len(waiting)])
        if size:
            self.receive(frame[:size])

    @rule(node=st.sampled_from([*NODES, 9]))
    def foreign_reply(self, node: int) -> None:
        if self.line.asked is None or node not in self.line.asked.waiting:
            self.receive(reply(node, READ, POISON).frame)

    @rule(data=st.binary(min_size=1, max_size=6))
    def noise(self, data: bytes) -> None:
        self.receive(data.replace(b"\xa5", b"\x5a"))

    @rule(seconds=st.sampled_from([0.0005, 0.003, 0.025, 0.3]))
    def waits(self, seconds: float) -> None:
        self.advance(seconds)

    @rule()
    def deadline_passes(self) -> None:
        if self.engine.deadline is not None:
            self.advance(self.engine.deadline - self.line.now)

    @precondition(lambda self: self.engine.up)
    @rule(cause=st.sampled_from([None, LinkDown("unplugged")]))
    def line_is_lost(self, cause: LinkDown | None) -> None:
        self.lost_turns += self.engine.in_flight
        self.engine.lost(cause)
        self.line.silent()
        self.line.stop_due = False
        assert all(call.ended for call in self.calls), "a call outlived its line"
        assert len(self.ended) == self.goals
        self.pump()

    @precondition(lambda self: not self.engine.up)
    @rule()
    def line_is_back(self) -> None:
        self.engine.opened(self.line.now)
        self.pump()

    # What always holds

    @invariant()
    def values_are_those_of_the_caller(self) -> None:
        for call in self.calls:
            if call.sink.results and not call.checked:
                call.checked = True
                assert len(call.sink.results) == 1
                self.check(call, call.sink.results[0])
        for update in self.rig.updates:
            if isinstance(update, dict):
                assert all(value in self.line.newest[node, POLL_REGISTER] for node, value in update.items())
        self.rig.updates.clear()

    def check(self, call: Call, result: Any) -> None:
        if isinstance(result, Exception):
            assert isinstance(result, ServobusError), result
        elif call.group:
            truth = {node: self.line.values[node, register] for node, register in call.registers}
            assert result in ("confirmed", "not confirmed") if not truth else result.items() <= truth.items()
        elif call.registers:
            values = [self.line.values[each] for each in call.registers]
            assert result == (values if len(values) > 1 else values[0])

    @invariant()
    def queues_are_bounded(self) -> None:
        waiting = self.engine.scheduler.waiting()
        stops = sum(call.is_stop and not call.ended for call in self.calls)
        assert waiting <= 2 * LIMIT + len(NODES) + 2 + stops, "as many run, wait, are parked; goals one a servo"
        assert self.engine.in_flight <= 1

    @invariant()
    def health_changes_as_it_may(self) -> None:
        for node, before, after in self.rig.changes:
            if node not in NODES:
                continue
            assert self.health[node] is before
            assert (before, after) in LEGAL
            self.health[node] = after
        self.rig.changes.clear()

    @invariant()
    def goals_end_once(self) -> None:
        assert len(self.ended) <= self.goals
        assert all(isinstance(result, Outcome | ServobusError) for _, result in self.ended)

    def teardown(self) -> None:
        """With a line that works again every call and every goal ends, and the counters add up."""
        if not self.engine.up:
            self.engine.opened(self.line.now)
        self.engine.scheduler.set_polls([], self.line.now)
        for _ in range(400):
            self.advance(0.01)
            while waiting := self.line.under_way():
                self.receive(self.line.deliver(waiting[0]))
        self.values_are_those_of_the_caller()
        assert all(call.ended for call in self.calls)
        assert (len(self.ended), self.engine.scheduler.waiting(), self.engine.in_flight) == (self.goals, 0, 0)
        assert all(node.health is ONLINE for node in self.rig.nodes.by_id.values() if node.configured)
        counts = self.rig.stats.counts
        assert counts[Counter.FRAMES] == self.line.frames
        assert counts[Counter.TURNS] + counts[Counter.TIMEOUTS] + self.lost_turns + len(self.line.broadcasts) == self.line.frames


TestEngine = EngineMachine.TestCase
TestEngine.settings = settings(max_examples=100, stateful_step_count=40, deadline=None, derandomize=True)
