"""A master of one simulated FEETECH servo; it owns the time."""

from __future__ import annotations

from servobus.protocols.sms.codec import Instruction, Packet, SmsCodec, encode
from servobus.protocols.sms.model import SmsModel, packaged_models
from servobus.protocols.sms.simulated.device import SmsDevice

FAMILIES = ("sms", "sms_cl", "sts", "scs")
AT_THE_GOAL = 100.0
"""Seconds after which every motion is over."""


def packet_of(frame: bytes) -> Packet:
    codec = SmsCodec()
    codec.receive_data(frame)
    packet = codec.next_reply()
    assert packet is not None
    return packet


class Master:
    """Sends packets to one device, and owns the time."""

    def __init__(self, device: SmsDevice) -> None:
        self.device = device
        self.model = device.model
        self.now = 0.0

    def send(self, code: int, params: bytes = b"", *, to: int | None = None) -> Packet | None:
        """Send a packet and return the reply; None: there is none."""
        frame = encode(self.device.node if to is None else to, code, params)
        replies = self.device.handle(packet_of(frame), self.now)
        assert len(replies) <= 1
        return packet_of(replies[0].data) if replies else None

    def bytes_of(self, name: str, raw: int) -> bytes:
        return self.model.registers[name].encode(raw, self.model.byte_order)

    def write(self, name: str, raw: int) -> Packet | None:
        return self.send(Instruction.WRITE, bytes((self.model.registers[name].address,)) + self.bytes_of(name, raw))

    def read(self, name: str) -> int:
        register = self.model.registers[name]
        reply = self.send(Instruction.READ, bytes((register.address, register.size)))
        assert reply is not None
        return register.decode(reply.params, self.model.byte_order)

    def go(self, position: int, *, time: int = 0, speed: int = 0) -> None:
        values = zip(self.model.goal, (position, time, speed), strict=True)
        data = b"".join(self.bytes_of(name, raw) for name, raw in values)
        assert self.send(Instruction.WRITE, bytes((self.model.registers[self.model.goal[0]].address,)) + data) is not None

    def after(self, seconds: float) -> Master:
        self.now += seconds
        return self


def model_of(name: str) -> SmsModel:
    return packaged_models()[name]


def master_of(name: str = "sts", servo_id: int = 1, **options: int) -> Master:
    settings = {"baudrate": 1_000_000, **options}
    return Master(SmsDevice(model_of(name), servo_id, **settings))


def changed(name: str, **registers: dict[str, object] | None) -> SmsModel:
    """A model with some registers changed, added, or (None) taken out."""
    data = model_of(name).model_dump()
    for register, keys in registers.items():
        if keys is None:
            del data["registers"][register]
        else:
            data["registers"][register] = {**data["registers"].get(register, {}), **keys}
    return SmsModel.model_validate(data)
