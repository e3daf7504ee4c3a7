"""NativeDoor: what the connections share, and how it is opened and closed."""

from __future__ import annotations

import asyncio
import socket
from collections import Counter
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from functools import partial
from pathlib import Path

from servobus.config.access import Role
from servobus.daemon.connection import Connection
from servobus.daemon.fairness import FairShare
from servobus.daemon.lease_watch import LeaseWatch
from servobus.daemon.sockets import BACKLOG, Tokens, claim, inode, peer_credentials, remove, tls_context
from servobus.daemon.subscriptions import Subscriptions
from servobus.errors import ConfigError, Overloaded, ServobusError
from servobus.rig.local import LocalRig
from servobus.rig.logs import EventLogger

HANDSHAKE = 5.0
"""Seconds."""
CLOSING = 1.0
"""Seconds that clients get to leave at the end."""

log = EventLogger("servobus.daemon")


class NativeDoor:
    """One rig, many clients. `owner`: the user whose daemon it is. `handshake`: seconds for a TCP client to show its token, and
    before that for TLS."""

    def __init__(self, rig: LocalRig, owner: int, *, handshake: float = HANDSHAKE) -> None:
        self.rig: LocalRig = rig
        self.options = rig.config.door
        self.owner = owner
        self.handshake = handshake
        self.loop = asyncio.get_running_loop()
        self.now = self.loop.time
        self.work = FairShare(self.loop)
        self.leasing: LeaseWatch = LeaseWatch(rig, self.options.lease_ms / 1000)
        self.subscriptions: Subscriptions = Subscriptions(rig)
        self.addresses: list[str] = []
        """Where it listens, for people."""
        self.connections: dict[Connection, str] = {}
        """Client -> whose it counts as."""
        self._count: Counter[str] = Counter()
        self._tokens: Tokens | None = None
        self._servers: list[asyncio.Server] = []
        self._empty = asyncio.Event()
        """After closing: everybody has left."""

    # Who comes in

    def enter(self, client: Connection, sock: socket.socket, *, tcp: bool) -> ServobusError | None:
        """What keeps it out; None: it is in, with the role that its credentials give."""
        if tcp:
            address = str(sock.getpeername()[0])
            owner, client.who = f"tcp {address}", address
        else:
            pid, uid, gid = peer_credentials(sock)
            owner, client.who = f"uid {uid}", f"pid {pid}, uid {uid}"
            client.role = self.rig.config.access.role_of(uid, gid, owner=self.owner)
        self.connections[client] = owner
        self._count[owner] += 1
        if len(self.connections) > self.options.clients:
            return Overloaded(f"{self.options.clients} clients are connected already (door.clients): try later")
        if self._count[owner] > self.options.clients_per_user:
            limit = self.options.clients_per_user
            return Overloaded(f"{limit} connections are yours already (door.clients_per_user): close one")
        if tcp:
            self.loop.call_later(self.handshake, self._late, client)
        return None

    def admit(self, client: Connection, token: str | None) -> Role:
        """The role that comes with the right token. Raises AccessDenied, Overloaded."""
        assert self._tokens is not None
        assert self.options.tcp is not None
        try:
            self._tokens.check(self.connections[client], token, self.now())
        except ServobusError as error:
            log.warning("access_denied", client=client.who, reason=error.message)
            self.loop.call_soon(client.close)
            raise
        return Role[self.options.tcp.role.upper()]

    def leave(self, client: Connection) -> None:
        owner = self.connections.pop(client, None)
        if owner is not None:
            self._count[owner] -= 1
            if not self._count[owner]:
                del self._count[owner]
        self.subscriptions.gone(client)
        self.leasing.gone(client)
        if not self.connections:
            self._empty.set()

    def _late(self, client: Connection) -> None:
        if client in self.connections and client.role is Role.NOBODY:
            client.abort()

    # Open and closed

    async def listen(self, listener: socket.socket, path: Path) -> None:
        """On the claimed socket, and on TCP where the config has it. Raises ConfigError."""
        self._servers.append(await self.loop.create_unix_server(partial(Connection, self), sock=listener, backlog=BACKLOG))
        self.addresses.append(str(path))
        tcp = self.options.tcp
        if tcp is None:
            return
        self._tokens, context = Tokens(tcp), tls_context(tcp)
        try:
            build = partial(Connection, self, tcp=True)
            patience = None if context is None else self.handshake
            server = await self.loop.create_server(
                build, tcp.host, tcp.port, ssl=context, backlog=BACKLOG, ssl_handshake_timeout=patience
            )
        except OSError as error:
            raise ConfigError(f"door.tcp: {tcp.host}:{tcp.port} cannot be listened at ({error.strerror})") from None
        self._servers.append(server)
        for sock in server.sockets:
            host, port = sock.getsockname()[:2]
            self.addresses.append(f"tcp://{host}:{port}")

    async def close(self) -> None:
        """Nobody comes in any more; whoever is in is told by the end of the connection."""
        for server in self._servers:
            server.close()
        self.subscriptions.close()
        for client in list(self.connections):
            client.close()
        await asyncio.sleep(0)
        for client in list(self.connections):
            client.abort()
        if self.connections:
            with suppress(TimeoutError):
                async with asyncio.timeout(CLOSING):
                    await self._empty.wait()
        await self.leasing.close()


@asynccontextmanager
async def open_door(
    rig: LocalRig, path: Path, *, owner: int, listener: socket.socket | None = None, handshake: float = HANDSHAKE
) -> AsyncIterator[NativeDoor]:
    """The door of `rig` at `path`, until the context ends. `listener`: that socket, where it was claimed already. `handshake`: as
    NativeDoor has it. Raises ConfigError, PortBusy."""
    listener = claim(path) if listener is None else listener
    own = inode(path)
    door = NativeDoor(rig, owner, handshake=handshake)
    try:
        await door.listen(listener, path)
        yield door
    finally:
        await door.close()
        remove(path, own)
