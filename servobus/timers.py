"""Timers finer than the millisecond that epoll waits in.

An event loop rounds its waits up to whole milliseconds, which is ten byte times at 115200 baud. A timerfd is a descriptor that
becomes readable at a moment given in nanoseconds, so the loop wakes by it as for any other input. Python 3.13 has it in `os`; for
older ones it is called through ctypes. A loop whose clock is not the system's (a simulated one) waits by its own `call_at`.
"""

from __future__ import annotations

import asyncio
import ctypes
import math
import os
import time
from collections.abc import Callable

CLOCK_MONOTONIC = 1
TFD_NONBLOCK, TFD_CLOEXEC, TFD_TIMER_ABSTIME = os.O_NONBLOCK, os.O_CLOEXEC, 1
VIRTUAL = "virtual_time"  # a loop with this attribute set keeps a time of its own


class _Spec(ctypes.Structure):
    """struct itimerspec: interval, then first expiry, each in seconds and nanoseconds."""

    _fields_ = [(name, ctypes.c_long) for name in ("interval_s", "interval_ns", "value_s", "value_ns")]


_libc = ctypes.CDLL(None, use_errno=True)


def clock_of(loop: asyncio.AbstractEventLoop) -> Callable[[], float]:
    """Seconds now, in the time that `FineTimer.arm` takes. The system's monotonic clock: uvloop's own is only as fine as its last
    pass."""
    return loop.time if getattr(loop, VIRTUAL, False) else time.monotonic


class FineTimer:
    """Calls back once, at the moment it was last armed for."""

    def __init__(self, loop: asyncio.AbstractEventLoop, callback: Callable[[], None]) -> None:
        self._loop = loop
        self._callback = callback
        self._handle: asyncio.TimerHandle | None = None
        self._at: float | None = None
        self._descriptor = -1
        if not getattr(loop, VIRTUAL, False) and hasattr(_libc, "timerfd_create"):
            self._descriptor = _libc.timerfd_create(CLOCK_MONOTONIC, TFD_NONBLOCK | TFD_CLOEXEC)
        if self._descriptor >= 0:
            loop.add_reader(self._descriptor, self._on_descriptor)

    def arm(self, when: float) -> None:
        """At `when` (seconds of `clock_of`), instead of any earlier time; at once when that has passed."""
        self._at = when
        if self._descriptor >= 0:
            self._set(max(1, round(when * 1e9)))
            return
        self.cancel()
        self._handle = self._loop.call_at(when, self._fire)
        self._at = when

    def by(self, when: float | None) -> None:
        """At `when` at the latest: waking early costs little, moving a timer again and again does not. None: no need."""
        if when is not None and (self._at is None or when < self._at):
            self.arm(when)

    def cancel(self) -> None:
        """Not at all."""
        self._at = None
        if self._handle is not None:
            self._handle.cancel()
            self._handle = None
        if self._descriptor >= 0:
            self._set(0)

    def close(self) -> None:
        """For good; may be said twice."""
        self.cancel()
        if self._descriptor >= 0:
            self._loop.remove_reader(self._descriptor)
            os.close(self._descriptor)
            self._descriptor = -1

    def _set(self, nanoseconds: int) -> None:
        spec = _Spec(0, 0, *divmod(nanoseconds, 1_000_000_000))
        _libc.timerfd_settime(self._descriptor, TFD_TIMER_ABSTIME, ctypes.byref(spec), None)

    def _on_descriptor(self) -> None:
        try:
            os.read(self._descriptor, 8)
        except BlockingIOError:
            return  # armed anew between the wake and now
        self._fire()

    def _fire(self) -> None:
        self._at = None
        self._callback()


class CoarseTimer:
    """The same by the loop's own timers, whole milliseconds at best: for moments that hardly ever come, like deadlines. It is
    never moved to a later one, so whoever is called too early asks again."""

    def __init__(self, loop: asyncio.AbstractEventLoop, callback: Callable[[], None]) -> None:
        self._loop = loop
        self._clock = clock_of(loop)
        self._callback = callback
        self._handle: asyncio.TimerHandle | None = None
        self.at = math.inf  # when it calls back; infinite: it is not set

    def by(self, when: float) -> None:
        """At `when` (seconds of `clock_of`) at the latest."""
        if self.at <= when:
            return
        self.cancel()
        self.at = when
        self._handle = self._loop.call_later(max(0.0, when - self._clock()), self._fire)

    def cancel(self) -> None:
        """Not at all."""
        self.at = math.inf
        if self._handle is not None:
            self._handle.cancel()

    def _fire(self) -> None:
        self._handle = None
        self.at = math.inf
        self._callback()
