"""The regime of every benchmark, and how its figures are taken.

A spinner keeps one core busy; the client and the responder share the other. Without the spinner, waking a halted core costs more
than anything that is measured. The clients take turns, round by round, and a figure is the median of its rounds: absolute
figures belong to the machine, ratios of one run can be compared.
"""

from __future__ import annotations

import mmap
import os
import statistics
import subprocess
import sys
import tempfile
import tty
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter, process_time

from tests.benchmarks import native, responder

WARM_UP_S = 0.1
"""A client works this long before it is measured: deadlines are learned, caches are warm."""


@dataclass(frozen=True, slots=True)
class Sample:
    """One round of one client."""

    turns: int
    seconds: float
    cpu_s: float
    """CPU of the client's own process."""


@dataclass(frozen=True, slots=True)
class Figure:
    """Medians over the rounds."""

    turns_per_s: float
    cpu_us: float
    """CPU time of the client for one turn."""


@dataclass(frozen=True, slots=True)
class Line:
    """A PTY with the responder behind it."""

    port: str
    counters: mmap.mmap
    loop: Path | None
    """The C loop; None where no compiler was found."""

    def synced(self) -> tuple[int, int]:
        """SYNC WRITE frames that the responder received, and the servos in them."""
        frames, servos = responder.COUNTERS.unpack_from(self.counters)
        return frames, servos


Client = Callable[[Line, float], Sample]
"""Works for so many seconds on the line."""


class Meter:
    """Wall clock and CPU from here on."""

    def __init__(self, seconds: float) -> None:
        self._began, self._cpu = perf_counter(), process_time()
        self.end = self._began + seconds

    def sample(self, turns: int) -> Sample:
        return Sample(turns, perf_counter() - self._began, process_time() - self._cpu)


def repeated(turn: Callable[[], object], seconds: float) -> Sample:
    """A blocking client that takes one turn after another."""
    warm = Meter(WARM_UP_S)
    while perf_counter() < warm.end:
        turn()
    meter, turns = Meter(seconds), 0
    while perf_counter() < meter.end:
        turn()
        turns += 1
    return meter.sample(turns)


def c_loop(frame: bytes, reply_size: int) -> Client:
    """The blocking loop in C: the floor of the machine."""

    def client(line: Line, seconds: float) -> Sample:
        assert line.loop is not None
        command = [str(line.loop), line.port, str(seconds), str(reply_size), frame.hex()]
        turns, elapsed, cpu_s = subprocess.run(command, check=True, capture_output=True, text=True, timeout=60).stdout.split()
        return Sample(int(turns), float(elapsed), float(cpu_s))

    return client


@contextmanager
def one_busy_core() -> Iterator[None]:
    """Keep this process, and those started from here, beside a core that never sleeps."""
    cores = os.sched_getaffinity(0)
    with ExitStack() as stack:
        if len(cores) > 1:
            os.sched_setaffinity(0, {max(cores)})
            _process(stack, [sys.executable, "-c", "while True: pass"])
        os.sched_setaffinity(0, {min(cores)})
        stack.callback(os.sched_setaffinity, 0, cores)
        yield


@contextmanager
def sms_line() -> Iterator[Line]:
    """A PTY with simulated SMS servos of every id, in the regime of this file."""
    with ExitStack() as stack:
        stack.enter_context(one_busy_core())
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        master, slave = os.openpty()
        stack.callback(os.close, slave)
        tty.setraw(slave)
        counters = folder / "counters"
        counters.write_bytes(bytes(responder.COUNTERS.size))
        source = native.RESPONDER.replace("IMAGE", responder.image_in_c())
        program = native.compiled(source, folder, "responder")
        command = [str(program)] if program else [sys.executable, "-m", "tests.benchmarks.responder"]
        _process(stack, [*command, str(master), str(counters)], master)
        os.close(master)
        with counters.open("r+b") as file, mmap.mmap(file.fileno(), responder.COUNTERS.size) as shared:
            yield Line(os.ttyname(slave), shared, native.compiled(native.LOOP, folder, "loop"))


def _process(stack: ExitStack, command: list[str], *descriptors: int) -> None:
    process = subprocess.Popen(command, pass_fds=descriptors)
    stack.callback(process.wait)
    stack.callback(process.kill)


def measured(clients: Mapping[str, Client], line: Line, seconds: float, rounds: int) -> dict[str, Figure]:
    """Each client in turn, `rounds` times; clients that need the C loop are left out where there is none."""
    samples: dict[str, list[Sample]] = {name: [] for name in clients}
    for _ in range(rounds):
        for name, client in clients.items():
            samples[name].append(client(line, seconds))
    return {name: figure(each) for name, each in samples.items()}


def figure(samples: list[Sample]) -> Figure:
    return Figure(
        statistics.median(sample.turns / sample.seconds for sample in samples),
        statistics.median(1e6 * sample.cpu_s / sample.turns for sample in samples),
    )
