"""Carries jobs through their requests: fences before doubt, retries where allowed, e-stop between frames. Pure: no
I/O, `now` is given.

The master asks `next_request` when the line is free, and reports how the turn ended: `sent`, `answered`, `missed` or
`lost`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from servobus.bus.health import Condition, Health
from servobus.bus.scheduler import Scheduler
from servobus.bus.stats import BusStats
from servobus.bus.turn import Finished, Run, Turn
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

    # What is said next

    def next_request(self, now: float) -> Request[Any] | None:
        """What shall be said now: the next frame of the plan under way, or of the next job. None: nothing is due."""
        while (run := self._current(now)) is not None:
            request = run.request
            if not request.replies or run.recovering:
                return request
            doubtful = self._doubtful(request)
            if doubtful is None:
                return request
            # Its answer could be taken for one that is still under way: a fence goes before it.
            self.stats.counts["fences"] += 1
            recovery = self.scheduler.recovery(doubtful)
            if self._step(run, lambda run=run, recovery=recovery: run.detour(recovery)):  # type: ignore[misc]
                return run.request
        return None

    def _doubtful(self, request: Request[Any]) -> Any:
        for node_id in request.nodes:
            node = self.health.node(node_id)
            if node.condition is not Condition.ONLINE:
                return node
        return None

    def _current(self, now: float) -> Run | None:
        """The run that has the line, begun if need be."""
        if self.scheduler.estop and self._suspended is None:
            self._make_way()
        if self._run is None and self._suspended is not None and not self.scheduler.estop:
            self._run, self._suspended = self._suspended, None
        while self._run is None:
            job = self.scheduler.next_turn(now)
            if job is None:
                return None
            run = Run(job)
            self._run = run
            self.stats.counts["fences"] += job.recovery
            self._step(run, run.begin)
        return self._run

    def _make_way(self) -> None:
        """For an e-stop: what moves ends here, anything else goes on afterwards."""
        run, self._run = self._run, None
        if run is not None and run.job.motion:
            run.job.fail(self.estopped(""))
        else:
            self._suspended = run

    # How a turn ended

    def sent(self, request: Request[Any]) -> None:
        """It left, and no answer is due."""
        self._resolve(request.parse(()))

    def answered(self, turn: Turn, now: float, latency: float) -> None:
        """All answers are here."""
        self._learn(turn, now, latency)
        try:
            value = turn.request.parse(turn.replies)
        except ServobusError as error:
            self._fail(error)
        else:
            self._resolve(value)

    def missed(self, turn: Turn, now: float, latency: float) -> None:
        """An answer is missing, or the window cannot be believed. The silent nodes become doubtful; the request is said again
        if it may be."""
        request = turn.request
        rejected = turn.complete()
        for node_id in request.nodes if rejected else turn.missing():
            self.health.missed(self.health.node(node_id), request.reply_key, turn.sent_at, now)
        if request.partial and turn.replies and not rejected:
            self._learn(turn, now, latency)
            self._resolve(request.parse(turn.replies))
        else:
            self._again(turn)

    def strays(self, replies: list[Reply], turn: Turn | None, now: float) -> None:
        """Valid frames that answer nothing: each node may have said the same once more, or says now what was given up."""
        for reply in replies:
            self.stats.counts["strays"] += 1
            node = self.health.node(reply.node)
            node.late(reply.key, now)
            if node.configured or (turn is not None and reply.node in turn.request.nodes):
                self.health.doubt(node, reply.key, node.outstanding.get(reply.key, now))

    def lost(self, cause: str) -> None:
        """The line is gone: everything ends."""
        run, suspended, self._run, self._suspended = self._run, self._suspended, None, None
        for begun in (run, suspended):
            if begun is not None:
                message = f"the line went down while this was under way ({cause}): it may have been applied"
                begun.job.fail(LinkDown(message, bus=self.bus))
        self.scheduler.drop(
            lambda _: LinkDown(f"the line went down ({cause}): nothing was sent", bus=self.bus), motion_only=False
        )

    def estopped(self, servo: str) -> ServobusError:
        return EStopped("the e-stop came first: nothing more was sent", bus=self.bus, servo=servo or None)

    def _learn(self, turn: Turn, now: float, latency: float) -> None:
        for reply in turn.replies:
            node = self.health.node(reply.node)
            node.answered(reply.status, now)
            node.learn(latency)

    def _again(self, turn: Turn) -> None:
        """Say it once more, or give it up."""
        run, request = self._run, turn.request
        assert run is not None
        run.attempts += 1
        offline = any(self.health.node(node).condition is Condition.OFFLINE for node in request.nodes)
        if not request.idempotent or run.attempts >= run.job.tries or offline:
            self._fail(self._timeout(run.attempts, request))
            return
        self.stats.counts["retries"] += 1
        run.request = (request.plain() if turn.echoes else None) or request
        if run.job.plan is None and not run.recovering:
            # It stays the first of its node, and the other nodes have their turns before it.
            self._run = None
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

    def _resolve(self, value: Any) -> None:
        run = self._run
        assert run is not None
        if run.simple:
            self._run = None
            run.job.succeed(value)
            return
        self._step(run, lambda: self._advance(run, value))

    def _fail(self, error: ServobusError) -> None:
        run = self._run
        assert run is not None
        self._step(run, lambda: run.fail(error))

    @staticmethod
    def _advance(run: Run, value: Any) -> None:
        if run.succeed(value) is False and run.job.motion:
            raise NotEnabled("the servo has restarted and is disabled: nothing was sent; enable it again")

    def _step(self, run: Run, step: Callable[[], object]) -> bool:
        """Move the run on; False: that ended its job."""
        try:
            step()
            return True
        except Finished as end:
            run.job.succeed(end.value)
        except ServobusError as error:
            run.job.fail(error.at(bus=self.bus))
        self._run = None
        return False
