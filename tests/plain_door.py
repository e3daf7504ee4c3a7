"""The least door a client can be tried against: every method, leases, subscriptions, on a real Unix socket; no defences."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import msgspec

from servobus.errors import ServobusError
from servobus.leases import Leases
from servobus.local import LocalRig
from servobus.rig import Found
from servobus.rpc.errors import INTERNAL, INVALID_PARAMS, encoded
from servobus.rpc.methods import METHODS, PROTOCOL, Greeting, Lease

TTL = 0.5


class PlainDoor:
    """Serves one rig to all who come."""

    def __init__(self, rig: LocalRig) -> None:
        self.rig = rig
        self.leases = Leases(TTL)
        self.guests: set[Guest] = set()
        self.tasks: set[asyncio.Task[Any]] = set()

    def start(self, work: Any) -> None:
        task = asyncio.ensure_future(work)
        self.tasks.add(task)
        task.add_done_callback(self.tasks.discard)

    async def expire(self) -> None:
        while True:
            await asyncio.sleep(TTL / 10)
            for lost in self.leases.expire(asyncio.get_running_loop().time()).values():
                self.start(self.rig.abandon(lost))


class Guest(asyncio.Protocol):
    """One connection."""

    def __init__(self, door: PlainDoor) -> None:
        self.door = door
        self.rig = door.rig
        self.subscriptions: dict[int, Callable[[], object]] = {}
        self._rest = b""
        self._clock = asyncio.get_running_loop().time

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self.transport = transport
        self.door.guests.add(self)

    def connection_lost(self, _: Exception | None) -> None:
        self.door.guests.discard(self)
        for end in self.subscriptions.values():
            end()
        if lost := self.door.leases.gone(self):
            self.door.start(self.rig.abandon(lost))

    def data_received(self, data: bytes) -> None:
        *lines, self._rest = (self._rest + data).split(b"\n")
        for line in lines:
            self.door.start(self._answer(json.loads(line)))

    def say(self, **message: Any) -> None:
        self.transport.write(msgspec.json.encode({"jsonrpc": "2.0", **message}) + b"\n")

    async def _answer(self, message: dict[str, Any]) -> None:
        answer: dict[str, Any]
        try:
            params = msgspec.convert(message["params"], METHODS[message["method"]].params)
            answer = {"result": await self._do(message["method"], params)}
        except ServobusError as error:
            answer = {"error": encoded(error)}
        except msgspec.ValidationError as error:
            answer = {"error": {"code": INVALID_PARAMS, "message": str(error)}}
        except Exception as error:  # noqa: BLE001 - the client shall be told of a mistake in here
            answer = {"error": {"code": INTERNAL, "message": repr(error)}}
        if "id" in message:
            self.say(id=message["id"], **answer)

    async def _do(self, method: str, params: Any) -> Any:
        own = getattr(self, f"do_{method}", None)
        if own is not None:
            result = own(params)
            return await result if asyncio.iscoroutine(result) else result
        given = msgspec.structs.asdict(params)
        return await getattr(self.rig, method)(*given.pop("names", ()), **given)

    def do_hello(self, _: Any) -> Greeting:
        rig = self.rig
        return Greeting("servobus", "0", PROTOCOL, 1, "admin", int(1000 * TTL), dict(rig.names), rig.stopped)

    def do_names(self, _: Any) -> Any:
        return dict(self.rig.names)

    def do_snapshot(self, _: Any) -> Any:
        return self.rig.snapshot()

    def do_stats(self, _: Any) -> Any:
        return self.rig.stats()

    def do_send_all(self, params: Any) -> Any:
        self.door.leases.take(self, "client", self.rig.full_names(params.goals), self._clock())
        return self.rig.send_all(params.goals, together=params.together, confirm=params.confirm)

    def do_acquire(self, params: Any) -> Lease:
        names = self.rig.full_names(params.names)
        self.door.leases.acquire(self, "client", names, self._clock())
        return Lease(tuple(names), int(1000 * TTL))

    def do_renew(self, _: Any) -> Lease:
        return Lease(tuple(self.door.leases.renew(self, self._clock())), int(1000 * TTL))

    def do_release(self, params: Any) -> None:
        self.door.leases.release(self, self.rig.full_names(params.names))

    def do_scan(self, params: Any) -> Any:
        def progress(asked: int, count: int, found: Found | None) -> None:
            self.say(method="progress", params={"bus": params.bus, "asked": asked, "count": count, "found": found})

        return self.rig.scan(params.bus, baudrates=params.baudrates, ids=params.ids, progress=progress)

    def do_subscribe(self, params: Any) -> int:
        number = len(self.subscriptions) + 1

        def tell(method: str, **told: Any) -> None:
            self.say(method=method, params={"subscription": number, "missed": 0, **told})

        async def report() -> None:
            while True:
                await asyncio.sleep(1 / params.hz)
                if params.topic == "state":
                    tell("state", stopped=self.rig.stopped, states=self.rig.snapshot())
                else:
                    tell("stats", stats=self.rig.stats())

        if params.topic == "events":
            self.subscriptions[number] = self.rig.announcer.listen(
                lambda event: tell("event", name=event.name, time=event.time, fields=event.fields)
            )
        else:
            self.subscriptions[number] = asyncio.ensure_future(report()).cancel
        return number

    def do_unsubscribe(self, params: Any) -> None:
        self.subscriptions[params.subscription]()


@asynccontextmanager
async def open_plain_door(rig: LocalRig, path: Path) -> AsyncIterator[PlainDoor]:
    door = PlainDoor(rig)
    door.start(door.expire())
    server = await asyncio.get_running_loop().create_unix_server(lambda: Guest(door), str(path))
    try:
        yield door
    finally:
        server.close()
        for guest in door.guests:
            guest.transport.abort()
        await asyncio.sleep(0)
        for task in door.tasks:
            task.cancel()
        await asyncio.gather(*door.tasks, return_exceptions=True)
