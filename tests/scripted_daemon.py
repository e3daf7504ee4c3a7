"""A daemon that answers as a test scripts it, on a real Unix socket: for answers that a real daemon never gives."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

NAMES = {"arm/s1": ["arm", "s1"], "arm/s2": ["arm", "s2"]}
GREETING = {
    "server": "servobus",
    "version": "0",
    "protocol": 1,
    "pid": 1,
    "role": "admin",
    "lease_ms": 300,
    "names": NAMES,
    "stopped": False,
}
STATE = {"position": 1.5, "enabled": True, "health": "online", "time": 5.0, "age": 0.25}

Answer = Callable[["Visitor", dict[str, Any]], Any]


class Visitor(asyncio.Protocol):
    """One connection, from the daemon's side."""

    def __init__(self, daemon: PuppetDaemon) -> None:
        self.daemon = daemon
        self.number = len(daemon.visitors)
        self.subscriptions: list[tuple[str, int]] = []
        self.gone = False
        self._rest = b""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self.transport = transport
        self.daemon.visitors.append(self)

    def connection_lost(self, _: Exception | None) -> None:
        self.gone = True

    def data_received(self, data: bytes) -> None:
        *lines, self._rest = (self._rest + data).split(b"\n")
        for line in lines:
            message = json.loads(line)
            self.daemon.received.append((message["method"], message["params"]))
            answer = self.daemon.answers.get(message["method"], UNKNOWN_METHOD)
            result = answer(self, message) if callable(answer) else answer
            if result is not None and "id" in message:
                self.say({"id": message["id"], **(result if "error" in result else {"result": result["result"]})})

    def say(self, message: dict[str, Any]) -> None:
        self.raw(json.dumps({"jsonrpc": "2.0", **message}).encode() + b"\n")

    def raw(self, data: bytes) -> None:
        self.transport.write(data)

    def notify(self, topic: str, **params: Any) -> None:
        """`topic` as in `subscribe`; the notice of `events` is called `event`."""
        method = "event" if topic == "events" else topic
        for number in [number for name, number in self.subscriptions if name == topic]:
            self.say({"method": method, "params": {"subscription": number, "missed": 0, **params}})


UNKNOWN_METHOD = {"error": {"code": -32601, "message": "method not found"}}


def failed(kind: str, message: str, **data: Any) -> dict[str, Any]:
    return {"error": {"code": -32000, "message": message, "data": {"type": kind, "message": message, **data}}}


def _subscribe(visitor: Visitor, message: dict[str, Any]) -> dict[str, Any]:
    visitor.daemon.subscribed += 1
    visitor.subscriptions.append((message["params"]["topic"], visitor.daemon.subscribed))
    return {"result": visitor.daemon.subscribed}


class PuppetDaemon:
    """`answers`: method -> {"result": ...} or {"error": ...}, or a callable (visitor, message) that gives one; None: silence."""

    loop: asyncio.AbstractEventLoop
    """Once it serves."""

    def __init__(self) -> None:
        self.received: list[tuple[str, dict[str, Any]]] = []
        self.visitors: list[Visitor] = []
        self.subscribed = 0
        self.answers: dict[str, Any] = {
            "hello": {"result": GREETING},
            "subscribe": _subscribe,
            "unsubscribe": {"result": None},
            "snapshot": {"result": dict.fromkeys(NAMES, STATE)},
            "stats": {"result": {"arm": {"up": True}}},
            "names": {"result": NAMES},
            "renew": {"result": {"names": [], "lease_ms": 300}},
            "acquire": lambda _, message: {"result": {"names": message["params"]["names"], "lease_ms": 300}},
            "release": {"result": None},
        }

    @property
    def visitor(self) -> Visitor:
        """Who came last."""
        return self.visitors[-1]

    def calls(self, method: str) -> list[dict[str, Any]]:
        """The parameters of each."""
        return [params for name, params in self.received if name == method]


@asynccontextmanager
async def puppet_daemon(path: Path, daemon: PuppetDaemon | None = None) -> AsyncIterator[PuppetDaemon]:
    daemon = daemon or PuppetDaemon()
    daemon.loop = asyncio.get_running_loop()
    server = await daemon.loop.create_unix_server(lambda: Visitor(daemon), str(path))
    try:
        yield daemon
    finally:
        server.close()
        for visitor in daemon.visitors:
            visitor.transport.abort()
        await asyncio.sleep(0)
