"""Jobs for a scheduler, what became of them, and a flood of some classes."""

from __future__ import annotations

from typing import Any

from servobus.engine.job import Job, JobKind
from servobus.errors import EStopped, NotEnabled, ServobusError
from servobus.protocols.base import Plan, run_plan
from tests.engine.toy_protocol import READ, Bench, Sink, poll, read, ticket

Ended = list[tuple[str, Any]]


def job(node: int, *, expires: float = 10.0, **traits: Any) -> Job:
    return Job(Sink(), expires, request=read(node), **traits)


def results(of: Job) -> list[Any]:
    assert isinstance(of.sink, Sink)
    return of.sink.results


def stop_job() -> Job:
    def plan() -> Plan[str]:
        yield read(1)
        return "stopped"

    return Job(Sink(), 10.0, plan=plan(), node=1, kind=JobKind.ESTOP)


def kind(taken: Job | None) -> str:
    if taken is None:
        return "-"
    names = {JobKind.PROBE: "probe", JobKind.MOTION: "goal", JobKind.ESTOP: "estop"}
    if taken.plan is not None:
        return names[taken.kind]
    return "request" if isinstance(taken.sink, Sink) else "poll"


def finish(taken: Job | None) -> None:
    """Let its plan run to its end, as a line that answers would."""
    assert taken is not None
    assert taken.plan is not None
    taken.succeed(run_plan(taken.plan, lambda _: None))


def estopped(_: str) -> ServobusError:
    return EStopped("stop")


def disabled(servo: str) -> ServobusError:
    return NotEnabled("disabled", servo=servo)


class Flood:
    """A bench where each class named has always something to send."""

    def __init__(self, *classes: str) -> None:
        self.classes = classes
        self.bench = Bench(1, 2, 3)
        self.now = 0.0
        self._ended: Ended = []
        if "poll" in classes:
            self.bench.scheduler.set_polls([poll("feedback", 1000, 1, 2)], 0.0)
        if "probe" in classes:
            self.bench.nodes.missed(self.bench.node(3), READ, 0.0, 0.0)

    def turn(self) -> Job | None:
        self.now += 0.001
        if "goal" in self.classes:
            self.bench.coalescer.put(ticket(1, self._ended, expires=self.now + 1))
        if "request" in self.classes and len(self.bench.scheduler.requests) < 4:
            self.bench.scheduler.queue(job(2, expires=self.now + 1), self.now)
        return self.bench.scheduler.next_job(self.now)

    def kinds(self, count: int) -> list[str]:
        return [kind(self.turn()) for _ in range(count)]


def split_bench(ended: Ended, **traits: Any) -> tuple[Bench, Job]:
    """Three goals, a frame each; the first frame has been taken."""
    bench = Bench(1, 2, 3, goals_per_frame=1)
    for number in (1, 2, 3):
        bench.coalescer.put(ticket(number, ended, **traits))
    first = bench.scheduler.next_job(0.0)
    assert first is not None
    assert bench.scheduler.goals.split_groups == 1
    assert bench.scheduler.waiting() == 2
    return bench, first
