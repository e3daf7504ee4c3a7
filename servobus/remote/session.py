"""A connection that is opened again when it is lost, with greeting and subscriptions. No call is ever repeated."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import Any

import msgspec

from servobus.errors import LinkDown, NotSupported, ReplyTimeout, ServobusError
from servobus.remote.connection import DaemonConnection
from servobus.rig.verbs import DEADLINE
from servobus.rpc.methods import METHODS, PROTOCOL, Greeting

FIRST_DELAY, MAX_DELAY = 0.05, 2.0  # seconds between two attempts to connect again
GREETING_TIMEOUT = 5.0
SILENCE = 5.0  # seconds without a byte from a daemon that sends notices, after which it hangs or the network is cut

Opener = Callable[[Callable[[], DaemonConnection]], Awaitable[DaemonConnection]]  # opens a connection that the function makes
_notice = msgspec.json.Decoder(dict[str, Any]).decode


@dataclass(eq=False, slots=True)
class WantedSubscription:
    """A subscription that outlives connections. `sink` gets the parameters of each notice."""

    params: dict[str, Any]
    sink: Callable[[dict[str, Any]], object]
    numbers: set[int] = field(default_factory=set)  # the numbers that the present connection gave it


@dataclass(eq=False)
class Session:
    """Keeps one client connected.

    Attributes:
        address: The daemon's address, for messages.
        opener: Opens a connection.
        hello: Returns the parameters of the greeting.
        greeted: Called with the daemon's greeting.
        prepare: Awaited with a new connection before it is used.
        changed: Called with None when the connection is up, and with the error when it is lost.
        progress: Called with the parameters of each `progress` notice.
    """

    address: str
    opener: Opener
    hello: Callable[[], dict[str, Any]]
    greeted: Callable[[Greeting], None]
    prepare: Callable[[DaemonConnection], Awaitable[None]]
    changed: Callable[[LinkDown | None], None]
    progress: Callable[[dict[str, Any]], None]

    def __post_init__(self) -> None:
        self._connection: DaemonConnection | None = None
        self._down = LinkDown(f"{self.address}: not connected yet")
        self._subscriptions: dict[WantedSubscription, None] = {}  # in the order they were made
        self._reconnecting: asyncio.Task[None] | None = None
        self._watchdog: asyncio.TimerHandle | None = None
        self._closed = False

    async def connect(self) -> None:
        """The first time, or again. Raises LinkDown, AccessDenied, NotSupported, ConfigError."""
        hello = self.hello()
        connection = await self.opener(lambda: DaemonConnection(self.address, self._notice, self._lost))
        try:
            self.greeted(await self._greet(connection, hello))
            for subscription in tuple(self._subscriptions):
                await self._begin(connection, subscription)
            await self.prepare(connection)
            if connection.down is not None:
                raise LinkDown(connection.down.message)
        except BaseException:
            connection.fail("the greeting was not finished")
            raise
        self._connection = connection
        self.changed(None)
        self._watch()

    async def _greet(self, connection: DaemonConnection, hello: dict[str, Any]) -> Greeting:
        try:
            greeting: Greeting = await connection.call("hello", hello | {"protocol": PROTOCOL}, timeout=GREETING_TIMEOUT)
        except LinkDown as error:
            raise LinkDown(error.message.removesuffix("; hello was under way")) from None
        except ReplyTimeout:
            raise LinkDown(
                f"{self.address} does not say within {GREETING_TIMEOUT:g} s who it is: is it a servobus daemon?"
            ) from None
        except TypeError as error:
            raise NotSupported(f"{self.address}: the daemon is of another version ({error}): update the older of both") from None
        if greeting.protocol != PROTOCOL:
            raise NotSupported(
                f"{self.address}: servobus {greeting.version} there speaks protocol {greeting.protocol}, this client {PROTOCOL}: "
                "update the older of both"
            )
        return greeting

    # Calls

    async def call(
        self, method: str, params: dict[str, Any], *, timeout: float | None = None, then: Callable[[Any], Any] | None = None
    ) -> Any:
        """Raises LinkDown at once while there is no connection."""
        return await self._present().call(method, params, timeout=timeout or METHODS[method].deadline, then=then)

    def _present(self) -> DaemonConnection:
        if self._connection is None:
            raise LinkDown(f"{self._down.message}; nothing was sent" + ("" if self._closed else ", it is tried again by itself"))
        return self._connection

    def keep_subscribed(self, params: dict[str, Any], sink: Callable[[dict[str, Any]], object]) -> None:
        """Subscribe with every connection, the first too."""
        self._subscriptions[WantedSubscription(params, sink)] = None

    async def subscribe(self, params: dict[str, Any], sink: Callable[[dict[str, Any]], object]) -> WantedSubscription:
        """Subscribe now, and again with every new connection."""
        connection, subscription = self._present(), WantedSubscription(params, sink)
        self._subscriptions[subscription] = None
        begun = asyncio.ensure_future(self._begin(connection, subscription))
        try:
            await asyncio.shield(begun)
        except BaseException:
            self._subscriptions.pop(subscription, None)
            begun.add_done_callback(lambda _: self._abandoned(begun, subscription))
            raise
        return subscription

    def _abandoned(self, begun: asyncio.Future[None], subscription: WantedSubscription) -> None:
        """End the subscription of a caller that was cancelled meanwhile."""
        if not begun.cancelled() and begun.exception() is None:
            self.unsubscribe(subscription)

    @staticmethod
    async def _begin(connection: DaemonConnection, subscription: WantedSubscription) -> None:
        subscription.numbers.clear()
        await connection.call("subscribe", subscription.params, timeout=DEADLINE, then=subscription.numbers.add)

    def unsubscribe(self, subscription: WantedSubscription) -> None:
        self._subscriptions.pop(subscription, None)
        for number in subscription.numbers:
            if self._connection is not None:
                self._connection.notify("unsubscribe", {"subscription": number})

    def _notice(self, method: str, params: msgspec.Raw) -> None:
        notice = _notice(params)
        if method == "progress":
            if self._connection is not None:
                self._connection.extend("scan")
            self.progress(notice)
            return
        for subscription in tuple(self._subscriptions):
            if notice.get("subscription") in subscription.numbers:
                subscription.sink(notice)

    # The connection is lost and opened again

    def _lost(self, connection: DaemonConnection, error: LinkDown) -> None:
        if connection is not self._connection:
            return  # it was not in use yet
        self._connection, self._down = None, error
        if not self._closed:
            self.changed(error)
            self._reconnecting = asyncio.get_running_loop().create_task(self._reconnect())

    async def _reconnect(self) -> None:
        delay = FIRST_DELAY
        while True:
            await asyncio.sleep(delay)
            try:
                await self.connect()
                return
            except Exception as error:  # noqa: BLE001 - whatever is wrong with this daemon, the next one may be good
                self._down = LinkDown(error.message if isinstance(error, ServobusError) else f"{self.address}: {error}")
            delay = min(2 * delay, MAX_DELAY)

    def _watch(self) -> None:
        """Give a connection up on which the daemon has fallen silent."""
        if self._watchdog is not None:
            self._watchdog.cancel()
        loop, connection = asyncio.get_running_loop(), self._connection
        if connection is None or self._closed:
            return
        if loop.time() - connection.received_at > SILENCE:
            connection.fail(f"the daemon was silent for {SILENCE:g} s")
            return
        self._watchdog = loop.call_later(SILENCE / 4, self._watch)

    async def close(self, *, lost: bool) -> None:
        """`lost`: as if this process had been killed."""
        self._closed = True
        if self._reconnecting is not None:
            self._reconnecting.cancel()
        if self._watchdog is not None:
            self._watchdog.cancel()
        connection, self._connection, self._down = self._connection, None, LinkDown(f"{self.address}: this client has left")
        if connection is not None:
            connection.fail("this client has left") if lost else connection.close()
