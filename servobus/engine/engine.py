"""Carries jobs through their requests: fences before doubt, retries where allowed, e-stop between frames. Pure: no
I/O, `now` is given.

The master asks `next_request` when the line is free, and reports how the turn ended: `sent`, `answered`, `missed` or
`lost`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from functools import partial
from typing import Any

from servobus.engine.health import Condition, Health
from servobus.engine.scheduler import Scheduler
from servobus.engine.stats import BusStats
from servobus.engine.turn import Finished, Run, Turn
from servobus.errors import EStopped, LinkDown, NotEnabled, ReplyTimeout, ServobusError
from servobus.protocols.base import Reply, Request


class Runner:
    """One job at a time has the line; a plan keeps it from its first frame to its last."""

    def __init__(self, bus: str, scheduler: Scheduler, health: Health, stats: BusStats) -> None:
        self.bus = bus
        self.scheduler = scheduler
        self.health = health
        self.stats = stats
        self._run: Run | None = None
        self._suspended: Run | None = None

    @property
    def idle(self) -> bool:
        """No plan is under way, so nothing needs to be waited for."""
        return self._run is None

    @property
    def urgent(self) -> bool:
        """An e-stop waits, or is under way: it is said even on a line that never falls quiet."""
        return bool(self.scheduler.estop) or (self._run is not None and self._run.estop)

    # What is said next

    def next_request(self, now: float, busy: Collection[int] = ()) -> Request[Any] | None:
        """What shall be said now: the next frame of the plan under way, or of the next job. None: nothing is due, or (while
        answers of `busy` nodes are due) nothing that could be said before they are here."""
        while (run := self._current(now)) is not None:
            request = run.request
            if busy and not (run.single and request.node not in busy and self._doubtful(request) is None):
                return None
            if not request.replies or run.recovering:
                return request
            doubtful = self._doubtful(request)
            if doubtful is None:
                return request
            # Its answer could be taken for one that is still under way: a fence goes before it.
            self.stats.counts["fences"] += 1
            recovery = self.scheduler.recovery(doubtful)
            self._step(run, partial(run.detour, recovery))
        return None

    def release(self, turn: Turn) -> None:
        """Others may follow before this turn ends, if it is all that its job needs."""
        if self._run is not None and self._run.single:
            turn.run, self._run = self._run, None

    def _doubtful(self, request: Request[Any]) -> Any:
        for node_id in request.nodes:
            node = self.health.node(node_id)
            if node.condition is not Condition.ONLINE:
                return node
        return None

    def _current(self, now: float) -> Run | None:
        """The run that has the line, begun if need be."""
        if self.scheduler.estop and self._run is not None and not self._run.estop:
            self._make_way(self._run)
        while self._run is None:
            estop = bool(self.scheduler.estop)
            if self._suspended is not None and not estop:
                self._run, self._suspended = self._suspended, None
                return self._run
            job = self.scheduler.next_job(now)
            if job is None:
                return None
            run = Run(job, estop=estop)
            self._run = run
            self.stats.counts["fences"] += job.recovery
            self._step(run, run.begin)
        return self._run

    def _make_way(self, run: Run) -> None:
        """For an e-stop: what moves ends here, anything else goes on afterwards. Never for a second e-stop: a hold that goes on
        after a limp would switch the torque on again."""
        self._run = None
        if run.job.motion:
            run.job.fail(self.estopped(""))
        else:
            self._suspended = run

    # How a turn ended

    def sent(self, request: Request[Any]) -> None:
        """It left, and no answer is due."""
        assert self._run is not None
        self._resolve(self._run, request.parse(()))

    def answered(self, turn: Turn, latency: float) -> None:
        """All answers are here."""
        for reply in turn.replies:
            node = self.health.node(reply.node)
            node.answered(reply.status)
            node.learn(latency)
        self._conclude(turn)

    def missed(self, turn: Turn, now: float, latency: float) -> None:
        """An answer is missing, or the window cannot be believed. The silent nodes become doubtful; the request is said again
        if it may be."""
        request = turn.request
        rejected = turn.complete()
        for node_id in request.nodes if rejected else turn.missing():
            self.health.missed(self.health.node(node_id), request.reply_key, turn.sent_at, now)
        if request.partial and turn.replies and not rejected:
            for reply in turn.replies:  # how soon they came is not known: the deadline ended this turn
                self.health.node(reply.node).answered(reply.status)
            self._conclude(turn)
        else:
            self._again(turn, now)

    def babbled(self) -> None:
        """The line never falls quiet: the plan under way ends, and only an e-stop is still said."""
        if self._run is not None and not self._run.estop:
            run, self._run = self._run, None
            run.job.fail(ReplyTimeout("the line never falls quiet: who talks on it without a pause?", bus=self.bus))

    def strays(self, replies: list[Reply], turn: Turn | None, now: float) -> None:
        """Valid frames that answer nothing: each node may have said the same once more, or says now what was given up."""
        for reply in replies:
            self.stats.counts["strays"] += 1
            node = self.health.node(reply.node)
            node.late(reply.key, now)
            if node.configured or (turn is not None and reply.node in turn.request.nodes):
                self.health.doubt(node, reply.key, node.outstanding.get(reply.key, now))

    def lost(self, cause: str, flight: Sequence[Turn] = ()) -> None:
        """The line is gone: everything ends."""
        run, suspended, self._run, self._suspended = self._run, self._suspended, None, None
        for begun in (run, suspended, *(turn.run for turn in flight)):
            if begun is not None:
                message = f"the line went down while this was under way ({cause}): it may have been applied"
                begun.job.fail(LinkDown(message, bus=self.bus))
        self.scheduler.drop(
            lambda _: LinkDown(f"the line went down ({cause}): nothing was sent", bus=self.bus), motion_only=False
        )

    def estopped(self, servo: str) -> ServobusError:
        return EStopped("the e-stop came first: nothing more was sent", bus=self.bus, servo=servo or None)

    def _conclude(self, turn: Turn) -> None:
        try:
            value = turn.request.parse(turn.replies)
        except Exception as error:  # noqa: BLE001 - whatever it is, its caller is told
            self._fail(self._run_of(turn), error)
        else:
            self._resolve(self._run_of(turn), value)

    def _run_of(self, turn: Turn) -> Run:
        run = turn.run or self._run
        assert run is not None
        return run

    def _again(self, turn: Turn, now: float) -> None:
        """Say it once more, or give it up."""
        run, request = self._run_of(turn), turn.request
        run.attempts += 1
        offline = any(self.health.node(node).condition is Condition.OFFLINE for node in request.nodes)
        # A recovery is never repeated in the middle: what it asked may still be answered, and must be fenced again.
        stale = run.job.motion and now >= run.job.expires  # a goal is not said again after its time
        if not request.idempotent or run.recovering or stale or run.attempts >= run.job.tries or offline:
            self._fail(run, self._timeout(run.attempts, request), offline=offline)
            return
        self.stats.counts["retries"] += 1
        run.request = (request.plain() if turn.echoes else None) or request
        if run.job.plan is None:
            # It stays the first of its node, and the other nodes have their turns before it.
            self._let_go(run)
            run.job.attempts, run.job.request = run.attempts, run.request
            self.scheduler.retry(run.job)

    def _timeout(self, attempts: int, request: Request[Any]) -> ReplyTimeout:
        tries = "1 try" if attempts == 1 else f"{attempts} tries"
        return ReplyTimeout(
            f"no answer after {tries}: is it powered, are id and baud rate right? What was asked may have been applied",
            bus=self.bus,
            request=request,
            raw=request.frame,
        )

    # The run

    def _resolve(self, run: Run, value: Any) -> None:
        if run.simple:
            self._let_go(run)
            run.job.succeed(value)
            return
        self._step(run, partial(run.succeed, value))

    def _let_go(self, run: Run) -> None:
        """It has the line no longer, if it had it."""
        if self._run is run:
            self._run = None

    def _fail(self, run: Run, error: Exception, *, offline: bool = False) -> None:
        self._step(run, partial(run.fail, error, offline=offline))

    def _step(self, run: Run, step: Callable[[], bool | None]) -> None:
        """Move the run on, or end its job."""
        try:
            kept = step()
            if kept is not False or not run.job.motion:
                return
            error: Exception = NotEnabled("the servo has restarted and is disabled: nothing was sent; enable it again")
        except Finished as end:
            self._let_go(run)
            run.job.succeed(end.value)
            return
        except Exception as raised:  # noqa: BLE001 - a mistake in a driver ends its job, never the bus
            error = raised
        self._let_go(run)
        run.job.fail(error.at(bus=self.bus) if isinstance(error, ServobusError) else error)
