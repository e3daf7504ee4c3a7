"""Full duplex on four wires: the next request travels while the last reply comes. Pure.

The replies of two servos share one pair of wires, so they must not meet there. A request may follow another one that is
still under way when all of this holds:

1. Every turn under way, and the next one, is a plain request to one node that is online, each to another node.
2. The line is not waiting for silence, and no reply was missing in the last second (`HALF_AGAIN`).
3. The pauses before two servos' replies differ by at most `spread` seconds, so the request leaves that much later than
   the last one, plus the time of its reply. Where all servos pause alike, the UART keeps the frames apart.
"""

from __future__ import annotations

from typing import Any

from servobus.engine.engine import IDLE, Action, Engine, WaitUntil
from servobus.engine.job import Job
from servobus.engine.line import Line
from servobus.engine.scheduler import Scheduler
from servobus.engine.stats import BusStats
from servobus.engine.turn import Turn, Window, judge
from servobus.protocols.base import Codec, Reply, Request

HALF_AGAIN = 1.0
"""Seconds of half duplex after a missing reply."""


class DuplexEngine(Engine):
    """An engine with several turns under way, one for each of several nodes."""

    def __init__(self, bus: str, codec: Codec, scheduler: Scheduler, line: Line, stats: BusStats, *, spread: float) -> None:
        super().__init__(bus, codec, scheduler, line, stats)
        self._spread = spread
        self.half_until = 0.0
        """Until then it is half duplex, because a reply was missing."""
        self._behind: list[Turn] = []
        """The turns behind the oldest one."""

    @property
    def in_flight(self) -> int:
        return super().in_flight + len(self._behind)

    @property
    def idle(self) -> bool:
        return self.runner.job is None

    @property
    def takes_frames(self) -> bool:
        return True

    def follow_at(self, now: float) -> float | None:
        """Return when a frame may be handed over behind the last turn. None: not before its reply is here."""
        line = self.line
        last = self._behind[-1] if self._behind else self._turn
        if last is None or now < self.half_until or line.waiting_for_silence:
            return None
        apart = last.request.reply_size * line.byte_time + self._spread if self._spread else 0.0
        return max(line.quiet_until, line.last_start + apart)

    def next_action(self, now: float) -> Action:
        if self._turn is None or self._unanswered is not None or not self.up:
            return super().next_action(now)
        at = self.follow_at(now) if self._released() else None
        if at is not None and at <= now:
            request = self._following_request(now)
            if request is not None:
                return self._transmit(request, now)
            # A job that was taken waits for the end of the turns under way, and everything else for that job.
            at = self.scheduler.rest(now) if self.runner.job is None else None
        self.deliver()
        return IDLE if at is None else WaitUntil(at)

    def _released(self) -> bool:
        """Return whether the last turn lets others follow: it is all that its job needs."""
        last = self._behind[-1] if self._behind else self._turn
        return last is not None and self.runner.job is not last.job

    def _following_request(self, now: float) -> Request[Any] | None:
        job = self.runner.current_job(now)
        if job is None or not _single(job) or self.runner.doubtful_node(job.request) is not None:
            return None
        assert self._turn is not None
        if any(turn.request.node == job.request.node for turn in (self._turn, *self._behind)):
            return None
        return job.request

    def _begin_turn(self, turn: Turn) -> None:
        if self._turn is None:
            super()._begin_turn(turn)
        else:
            self._behind.append(turn)
        if _single(turn.job):
            self.runner.job = None

    def _end_turn(self, turn: Turn) -> None:
        self._turn = self._behind.pop(0) if self._behind else None

    def _drop_turns(self) -> list[Job]:
        behind, self._behind = self._behind, []
        return [*super()._drop_turns(), *(turn.job for turn in behind)]

    def _judge(self, turn: Turn) -> tuple[Window, tuple[Reply, ...]]:
        return judge(self._codec, turn, self._behind)

    def _answered(self, turn: Turn, now: float) -> None:
        super()._answered(turn, now)
        self._end_complete(now)

    def _missed(self, turn: Turn, now: float) -> None:
        self.half_until = now + HALF_AGAIN
        super()._missed(turn, now)
        self._end_complete(now)

    def _end_complete(self, now: float) -> None:
        """End the oldest turn if its replies came while an earlier one was waited for."""
        if self._turn is not None and self._turn.complete():
            self._answered(self._turn, now)


def _single(job: Job) -> bool:
    """Return whether the job is one request that one node answers, without a fence."""
    return job.plain and not job.fencing and len(job.request.nodes) == job.request.replies == 1
