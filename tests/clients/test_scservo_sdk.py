"""The vendor's Python SDK (feetech-servo-sdk) against `servobus sim`: ping, read, write, sync write, sync read."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
import scservo_sdk

from tests.clients.bus_process import served

pytestmark = pytest.mark.slow

GOAL_POSITION, PRESENT_POSITION, LOCK, ID, MOVING, TORQUE = 42, 56, 55, 5, 66, 40
STS3215 = 777
STANDING = {1: 2048, 2: 1000, 3: 3000}
READS = 2000
"""A servo arrives within so many reads."""


class PatientPort(scservo_sdk.PortHandler):  # type: ignore[misc]
    """A port that waits longer than the 34 ms of the SDK, because a test machine may be busy."""

    def setPacketTimeout(self, packet_length: int) -> None:
        self.setPacketTimeoutMillis(10_000)


class Client:
    """Port and packet handler of the SDK; anything but success fails."""

    def __init__(self, port: Any) -> None:
        self.port = port
        self.packets = scservo_sdk.PacketHandler(0)

    def read(self, node: int, address: int, size: int = 1) -> int:
        ask = self.packets.read2ByteTxRx if size == 2 else self.packets.read1ByteTxRx
        value, result, error = ask(self.port, node, address)
        assert (result, error) == (scservo_sdk.COMM_SUCCESS, 0), self.packets.getTxRxResult(result)
        return int(value)

    def write(self, node: int, address: int, value: int, size: int = 1) -> None:
        tell = self.packets.write2ByteTxRx if size == 2 else self.packets.write1ByteTxRx
        assert tell(self.port, node, address, value) == (scservo_sdk.COMM_SUCCESS, 0)

    def arrives(self, node: int, position: int) -> bool:
        return any(self.read(node, PRESENT_POSITION, 2) == position for _ in range(READS))


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with served(tmp_path_factory.mktemp("sim")) as path:
        yield path


@pytest.fixture
def client(path: str) -> Iterator[Client]:
    port = PatientPort(path)
    assert port.openPort()
    yield Client(port)
    port.closePort()


def sync_read(client: Client, nodes: list[int]) -> dict[int, int]:
    group = scservo_sdk.GroupSyncRead(client.port, client.packets, PRESENT_POSITION, 2)
    for node in nodes:
        assert group.addParam(node)
    assert group.txRxPacket() == scservo_sdk.COMM_SUCCESS
    assert all(group.isAvailable(node, PRESENT_POSITION, 2) for node in nodes)
    return {node: group.getData(node, PRESENT_POSITION, 2) for node in nodes}


def test_ping_tells_the_model(client: Client) -> None:
    """Each configured servo answers with its model."""
    for node in STANDING:
        assert client.packets.ping(client.port, node) == (STS3215, scservo_sdk.COMM_SUCCESS, 0)


def test_another_id_is_silent(path: str) -> None:
    """The SDK ends with its own timeout."""
    port = scservo_sdk.PortHandler(path)
    assert port.openPort()
    assert scservo_sdk.PacketHandler(0).ping(port, 9)[1] == scservo_sdk.COMM_RX_TIMEOUT
    port.closePort()


def test_read_and_sync_read_have_every_position(client: Client) -> None:
    """SYNC READ keeps the order of the request."""
    assert {node: client.read(node, PRESENT_POSITION, 2) for node in STANDING} == STANDING
    assert sync_read(client, [3, 1, 2]) == STANDING


def test_a_written_goal_is_reached(client: Client) -> None:
    """Writing a goal switches torque on."""
    client.write(1, GOAL_POSITION, 2100, 2)
    assert client.read(1, GOAL_POSITION, 2) == 2100
    assert client.read(1, TORQUE) == 1
    assert client.arrives(1, 2100)
    assert client.read(1, MOVING) == 0
    client.write(1, GOAL_POSITION, STANDING[1], 2)
    assert client.arrives(1, STANDING[1])


def test_sync_write_moves_several(client: Client) -> None:
    """Two servos move by one frame; the third stays."""
    goals = {2: 1040, 3: 2960}
    for targets in (goals, STANDING):
        group = scservo_sdk.GroupSyncWrite(client.port, client.packets, GOAL_POSITION, 2)
        for node in goals:
            low, high = scservo_sdk.SCS_LOBYTE(targets[node]), scservo_sdk.SCS_HIBYTE(targets[node])
            assert group.addParam(node, [low, high])
        assert group.txPacket() == scservo_sdk.COMM_SUCCESS
        assert all(client.arrives(node, targets[node]) for node in goals)
        assert sync_read(client, [1, 2, 3]) == {**STANDING, **{node: targets[node] for node in goals}}


def test_reg_write_waits_for_action(client: Client) -> None:
    """A servo moves at ACTION, not at REG WRITE."""
    assert client.packets.regWriteTxRx(client.port, 1, GOAL_POSITION, 2, [0x40, 0x08]) == (scservo_sdk.COMM_SUCCESS, 0)
    before = client.read(1, PRESENT_POSITION, 2)
    assert client.packets.action(client.port, scservo_sdk.BROADCAST_ID) == scservo_sdk.COMM_SUCCESS
    assert before == STANDING[1]
    assert client.arrives(1, 0x840)
    client.write(1, GOAL_POSITION, STANDING[1], 2)
    assert client.arrives(1, STANDING[1])


def test_an_id_can_be_set_and_set_back(client: Client) -> None:
    """The lock is written under the new id. The reply to the id write may have either id, so the SDK does not wait for it."""
    for old, new in ((3, 13), (13, 3)):
        client.write(old, LOCK, 0)
        assert client.packets.write1ByteTxOnly(client.port, old, ID, new) == scservo_sdk.COMM_SUCCESS
        port_is_clear(client)
        client.write(new, LOCK, 1)
        assert client.read(new, ID) == new


def port_is_clear(client: Client) -> None:
    """Read the six bytes of a reply that was not awaited."""
    client.port.setPacketTimeout(6)
    reply, result = client.packets.rxPacket(client.port)
    assert (result, len(reply)) == (scservo_sdk.COMM_SUCCESS, 6)
