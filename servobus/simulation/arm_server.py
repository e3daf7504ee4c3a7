"""A simulated RealMan arm on a TCP port, with the simulated hands of a bus behind it."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from random import Random
from urllib.parse import parse_qs, urlsplit

from servobus.protocols.device import Device
from servobus.protocols.modbus.codec import ModbusCodec
from servobus.protocols.model import ServoModel
from servobus.protocols.options import BusOptions
from servobus.protocols.realman.codec import JsonLines, Message, encode
from servobus.protocols.realman.simulated.arm import SimulatedArm
from servobus.protocols.registry import PROTOCOLS
from servobus.timers import clock_of

SCHEME = "realman"
LATENCY = 0.002
"""Seconds the arm takes for one command, in addition to the hand's time."""
CHATTER: Message = {
    "state": "current_trajectory_state",
    "trajectory_state": True,
    "device": 0,
    "trajectory_connect": 1,
}
"""A line that an arm sends unsolicited."""


@dataclass(frozen=True, slots=True)
class ArmFaults:
    """The share of replies, 0 to 1, that each fault hits.

    A reply is sent twice (duplicate), `late_s` seconds too late while those after it wait (late), in two pieces (split), without
    its end (cut), or after an unsolicited line (chatter). With drop the connection ends instead.
    """

    duplicate: float = 0.0
    late: float = 0.0
    late_s: float = 0.0
    split: float = 0.0
    cut: float = 0.0
    chatter: float = 0.0
    drop: float = 0.0
    seed: int = 0


class ArmServer:
    """`async with ArmServer(...) as server: server.port`."""

    def __init__(self, devices: list[Device], generation: int = 3, faults: ArmFaults | None = None) -> None:
        self.devices = devices
        self.faults = faults or ArmFaults()
        self.arm = SimulatedArm(self._exchange, generation)
        self.port = 0
        self._rng = Random(self.faults.seed)
        self._delay = 0.0
        self._server: asyncio.Server | None = None
        self._clients: set[asyncio.Task[None]] = set()

    async def __aenter__(self) -> ArmServer:
        self._now = clock_of(asyncio.get_running_loop())
        self._server = await asyncio.start_server(self._accept, "127.0.0.1", self.port)
        self.port = self._server.sockets[0].getsockname()[1]
        return self

    async def __aexit__(self, *_: object) -> None:
        assert self._server is not None
        self._server.close()
        clients = list(self._clients)
        self.hang_up()
        await asyncio.gather(*clients, return_exceptions=True)

    def hang_up(self) -> None:
        """End every connection."""
        for client in self._clients:
            client.cancel()

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._clients.add(task)
        try:
            await self._serve(reader, writer)
        except (OSError, asyncio.CancelledError):
            pass  # the client or the server has gone
        finally:
            self._clients.discard(task)
            writer.close()
            with suppress(OSError):
                await writer.wait_closed()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        lines = JsonLines()
        while data := await reader.read(4096):
            for message in lines.feed(data):
                self._delay = LATENCY
                reply = self.arm.handle(message)
                await asyncio.sleep(self._delay)
                if reply is not None and not await self._send(writer, encode(reply)):
                    return

    async def _send(self, writer: asyncio.StreamWriter, line: bytes) -> bool:
        """Send a line with its faults. Returns False when the connection is to end."""
        hits = self._hits
        if hits(self.faults.drop):
            return False
        if hits(self.faults.late):
            await asyncio.sleep(self.faults.late_s)
        if hits(self.faults.chatter):
            line = encode(CHATTER) + line
        if hits(self.faults.cut):
            line = line[: -self._rng.randrange(1, len(line))]
        if hits(self.faults.duplicate):
            line += line
        if hits(self.faults.split):
            middle = self._rng.randrange(1, len(line))
            writer.write(line[:middle])
            await writer.drain()
            await asyncio.sleep(0.001)
            line = line[middle:]
        writer.write(line)
        await writer.drain()
        return True

    def _hits(self, share: float) -> bool:
        return share > 0 and self._rng.random() < share

    def _exchange(self, request: bytes) -> bytes | None:
        codec = ModbusCodec("device")
        codec.receive_data(request)
        frame = codec.next_reply()
        replies = [reply for device in self.devices for reply in device.handle(frame, self._now())] if frame else []
        if len(replies) != 1:
            return None  # no unit answers, or two answer at once
        self._delay += replies[0].delay + replies[0].late
        return replies[0].data


def is_arm(port: str) -> bool:
    """Return whether a config's `port` is the address of an arm."""
    return port.startswith(f"{SCHEME}:")


def arm_server(options: BusOptions, models: Mapping[str, ServoModel]) -> ArmServer:
    """Return the hands of a bus behind an arm. Its generation is that of the bus's `port`, or 3."""
    keys = parse_qs(urlsplit(options.port).query)
    generation = int(keys.get("generation", ["3"])[0])
    devices = list(PROTOCOLS[options.protocol].devices(options, models))
    return ArmServer(devices, generation)


def address(options: BusOptions, server: ArmServer) -> str:
    """Return the `port` with which a config reaches the server."""
    return urlsplit(options.port)._replace(netloc=f"127.0.0.1:{server.port}").geturl()
