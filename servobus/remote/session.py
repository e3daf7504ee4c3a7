"""A connection that comes back: greeting, subscriptions, and another try when it is lost. It repeats no call, ever."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import Any

import msgspec

from servobus.errors import LinkDown, NotSupported, ReplyTimeout, ServobusError
from servobus.remote.connection import Connection
from servobus.rpc.methods import PROTOCOL, Greeting

FIRST_DELAY, MAX_DELAY = 0.05, 2.0
"""Seconds between two tries to get the connection back."""
GREETING_TIMEOUT = 5.0
SILENCE = 5.0
"""Seconds without a byte from a daemon that we have subscribed to, after which it hangs or the network is cut."""
DEADLINES = {"scan": 30.0, "set_id": 30.0, "set_baudrate": 30.0, "reload": 60.0}
"""Seconds an answer may take, where that is more than DEADLINE; `scan` from one `progress` to the next."""
DEADLINE = 10.0

Dial = Callable[[Callable[[], Connection]], Awaitable[Connection]]
_notice = msgspec.json.Decoder(dict[str, Any]).decode


@dataclass(eq=False, slots=True)
class Subscription:
    """Wanted until it is given up, over all connections; `sink` gets the parameters of each notice."""

    params: dict[str, Any]
    sink: Callable[[dict[str, Any]], object]
    numbers: set[int] = field(default_factory=set)
    """As the present connection calls it."""


class Session:
    """`hello()` gives what to greet with; `greeted` is told what the daemon says to that, and `up(wire)` asks what else has to be
    known before the connection is used. `changed(reason)` hears that it is there (None), or why no more."""

    def __init__(
        self,
        place: str,
        dial: Dial,
        hello: Callable[[], dict[str, Any]],
        greeted: Callable[[Greeting], None],
        up: Callable[[Connection], Awaitable[None]],
        changed: Callable[[LinkDown | None], None],
        progress: Callable[[dict[str, Any]], None],
    ) -> None:
        self.place = place
        self._dial = dial
        self._hello = hello
        self._greeted = greeted
        self._up = up
        self._changed = changed
        self._progress = progress
        self._wire: Connection | None = None
        self._down = LinkDown(f"{place}: not connected yet")
        self._subscriptions: dict[Subscription, None] = {}
        """In the order they were made."""
        self._redialing: asyncio.Task[None] | None = None
        self._watchdog: asyncio.TimerHandle | None = None
        self._closed = False

    async def connect(self) -> None:
        """The first time, or again. Raises LinkDown, AccessDenied, NotSupported, ConfigError."""
        hello = self._hello()
        wire = await self._dial(lambda: Connection(self.place, self._notice, self._lost))
        try:
            self._greeted(await self._greet(wire, hello))
            for subscription in tuple(self._subscriptions):
                await self._begin(wire, subscription)
            await self._up(wire)
            if wire.down is not None:
                raise LinkDown(wire.down.message)
        except BaseException:
            wire.fail("the greeting was not finished")
            raise
        self._wire = wire
        self._changed(None)
        self._watch()

    async def _greet(self, wire: Connection, hello: dict[str, Any]) -> Greeting:
        try:
            greeting: Greeting = await wire.call("hello", hello | {"protocol": PROTOCOL}, timeout=GREETING_TIMEOUT)
        except LinkDown as error:
            raise LinkDown(error.message.removesuffix("; hello was under way and may have been applied")) from None
        except ReplyTimeout:
            raise LinkDown(
                f"{self.place} does not say within {GREETING_TIMEOUT:g} s who it is: is it a servobus daemon?"
            ) from None
        except TypeError as error:
            raise NotSupported(f"{self.place}: the daemon is of another version ({error}): update the older of both") from None
        if greeting.protocol != PROTOCOL:
            raise NotSupported(
                f"{self.place}: servobus {greeting.version} there speaks protocol {greeting.protocol}, this client {PROTOCOL}: "
                "update the older of both"
            )
        return greeting

    # Calls

    async def call(
        self, method: str, params: dict[str, Any], *, timeout: float | None = None, then: Callable[[Any], Any] | None = None
    ) -> Any:
        """Raises LinkDown at once while there is no connection."""
        return await self._present().call(method, params, timeout=timeout or DEADLINES.get(method, DEADLINE), then=then)

    def _present(self) -> Connection:
        if self._wire is None:
            raise LinkDown(f"{self._down.message}; nothing was sent" + ("" if self._closed else ", it is tried again by itself"))
        return self._wire

    def want(self, params: dict[str, Any], sink: Callable[[dict[str, Any]], object]) -> None:
        """A subscription that begins with every connection, the first too."""
        self._subscriptions[Subscription(params, sink)] = None

    async def subscribe(self, params: dict[str, Any], sink: Callable[[dict[str, Any]], object]) -> Subscription:
        """From now on, and again with every new connection."""
        wire, subscription = self._present(), Subscription(params, sink)
        self._subscriptions[subscription] = None
        begun = asyncio.ensure_future(self._begin(wire, subscription))
        try:
            await asyncio.shield(begun)
        except BaseException:
            self._subscriptions.pop(subscription, None)
            begun.add_done_callback(lambda _: self._abandoned(begun, subscription))
            raise
        return subscription

    def _abandoned(self, begun: asyncio.Future[None], subscription: Subscription) -> None:
        """A caller that left meanwhile leaves nothing behind at the daemon."""
        if not begun.cancelled() and begun.exception() is None:
            self.unsubscribe(subscription)

    @staticmethod
    async def _begin(wire: Connection, subscription: Subscription) -> None:
        subscription.numbers.clear()
        await wire.call("subscribe", subscription.params, timeout=DEADLINE, then=subscription.numbers.add)

    def unsubscribe(self, subscription: Subscription) -> None:
        self._subscriptions.pop(subscription, None)
        for number in subscription.numbers:
            if self._wire is not None:
                self._wire.tell("unsubscribe", {"subscription": number})

    def _notice(self, method: str, params: msgspec.Raw) -> None:
        told = _notice(params)
        if method == "progress":
            if self._wire is not None:
                self._wire.still("scan")
            self._progress(told)
            return
        for subscription in tuple(self._subscriptions):
            if told.get("subscription") in subscription.numbers:
                subscription.sink(told)

    # The connection goes and comes

    def _lost(self, wire: Connection, why: LinkDown) -> None:
        if wire is not self._wire:
            return  # it never was in use
        self._wire, self._down = None, why
        if not self._closed:
            self._changed(why)
            self._redialing = asyncio.get_running_loop().create_task(self._redial())

    async def _redial(self) -> None:
        delay = FIRST_DELAY
        while True:
            await asyncio.sleep(delay)
            try:
                await self.connect()
                return
            except Exception as error:  # noqa: BLE001 - whatever is wrong with this daemon, the next one may be right
                self._down = LinkDown(error.message if isinstance(error, ServobusError) else f"{self.place}: {error}")
            delay = min(2 * delay, MAX_DELAY)

    def _watch(self) -> None:
        """A daemon that has nothing to say any more is lost, whatever the network says."""
        if self._watchdog is not None:
            self._watchdog.cancel()
        loop, wire = asyncio.get_running_loop(), self._wire
        if wire is None or self._closed:
            return
        if loop.time() - wire.heard > SILENCE:
            wire.fail(f"the daemon was silent for {SILENCE:g} s")
            return
        self._watchdog = loop.call_later(SILENCE / 4, self._watch)

    async def close(self, *, lost: bool) -> None:
        """`lost`: as if this process had been killed."""
        self._closed = True
        if self._redialing is not None:
            self._redialing.cancel()
        if self._watchdog is not None:
            self._watchdog.cancel()
        wire, self._wire, self._down = self._wire, None, LinkDown(f"{self.place}: this client has left")
        if wire is not None:
            wire.fail("this client has left") if lost else wire.close()
