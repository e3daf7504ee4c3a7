"""NativeDoor: what the connections of one daemon share, who may connect, and how it opens and closes."""

from __future__ import annotations

import asyncio
import socket
from collections import Counter
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from functools import partial
from pathlib import Path

from servobus.config.access import Role
from servobus.daemon.connection import ClientConnection
from servobus.daemon.fairness import FairShare
from servobus.daemon.lease_watch import LeaseWatch
from servobus.daemon.methods import Services
from servobus.daemon.sockets import BACKLOG, Tokens, claim, inode, peer_credentials, remove, tls_context
from servobus.daemon.standstill import StandStill
from servobus.daemon.subscriptions import Subscriptions
from servobus.errors import ConfigError, Overloaded, ServobusError
from servobus.rig.local import LocalRig
from servobus.rig.logs import EventLogger

HANDSHAKE = 5.0  # seconds
CLOSING = 1.0  # seconds that connections get to close at the end

log = EventLogger("servobus.daemon")


class NativeDoor:
    """One rig for many clients.

    Args:
        rig: The rig.
        owner: User id of the daemon's owner.
        handshake: Seconds for a TCP client to show its token, and before that for TLS.
    """

    def __init__(self, rig: LocalRig, owner: int, *, handshake: float = HANDSHAKE) -> None:
        self.rig: LocalRig = rig
        self.options = rig.config.door
        self.owner = owner
        self.handshake = handshake
        self.loop = asyncio.get_running_loop()
        self.now = self.loop.time
        self.share = FairShare(self.loop)
        self.stand_still = StandStill(self.loop)
        self.leases = LeaseWatch(rig, self.options.lease_ms)
        self.subscriptions = Subscriptions(rig)
        self.services = Services(rig, self.leases, self.subscriptions)
        self.addresses: list[str] = []  # where it listens, for people
        self.connections: dict[ClientConnection, str] = {}  # client -> whose it counts as
        self._count: Counter[str] = Counter()
        self._tokens: Tokens | None = None
        self._servers: list[asyncio.Server] = []
        self._empty = asyncio.Event()  # after closing: no connection is left

    # Who may connect

    def enter(self, client: ClientConnection, sock: socket.socket, *, tcp: bool) -> ServobusError | None:
        """Count a new connection, and give it the role of its credentials. Returns the error that refuses it, or None."""
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

    def admit(self, client: ClientConnection, token: str | None) -> Role:
        """Return the role of a client that showed the right token. Raises AccessDenied, Overloaded."""
        assert self._tokens is not None
        assert self.options.tcp is not None
        try:
            self._tokens.check(self.connections[client], token, self.now())
        except ServobusError as error:
            log.warning("access_denied", client=client.who, reason=error.message)
            self.loop.call_soon(client.close)
            raise
        return Role[self.options.tcp.role.upper()]

    def leave(self, client: ClientConnection) -> None:
        owner = self.connections.pop(client, None)
        if owner is not None:
            self._count[owner] -= 1
            if not self._count[owner]:
                del self._count[owner]
        self.subscriptions.gone(client)
        self.leases.gone(client)
        if not self.connections:
            self._empty.set()

    def _late(self, client: ClientConnection) -> None:
        if client in self.connections and client.role is Role.NOBODY:
            client.abort()

    # Open and closed

    async def listen(self, listener: socket.socket, path: Path) -> None:
        """Listen on the claimed socket, and on TCP where the config says so. Raises ConfigError."""
        self._servers.append(await self.loop.create_unix_server(partial(ClientConnection, self), sock=listener, backlog=BACKLOG))
        self.addresses.append(str(path))
        tcp = self.options.tcp
        if tcp is None:
            return
        self._tokens, context = Tokens(tcp), tls_context(tcp)
        try:
            build = partial(ClientConnection, self, tcp=True)
            limit = None if context is None else self.handshake
            server = await self.loop.create_server(
                build, tcp.host, tcp.port, ssl=context, backlog=BACKLOG, ssl_handshake_timeout=limit
            )
        except OSError as error:
            raise ConfigError(f"door.tcp: {tcp.host}:{tcp.port} cannot be listened at ({error.strerror})") from None
        self._servers.append(server)
        for sock in server.sockets:
            host, port = sock.getsockname()[:2]
            self.addresses.append(f"tcp://{host}:{port}")

    async def close(self) -> None:
        """Accept nobody any more, and close every connection."""
        self.stand_still.close()
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
        await self.leases.close()


@asynccontextmanager
async def open_door(
    rig: LocalRig, path: Path, *, owner: int, listener: socket.socket | None = None, handshake: float = HANDSHAKE
) -> AsyncIterator[NativeDoor]:
    """Serve `rig` at the socket `path` until the context ends. `listener`: that socket, where it is claimed already; `owner` and
    `handshake` as in NativeDoor. Raises ConfigError, PortBusy."""
    listener = claim(path) if listener is None else listener
    own = inode(path)
    door = NativeDoor(rig, owner, handshake=handshake)
    try:
        await door.listen(listener, path)
        yield door
    finally:
        await door.close()
        remove(path, own)
