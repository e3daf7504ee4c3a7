"""OHand ROH hands: holding registers by Modbus-RTU (ROH Modbus), on a line of their own or behind a RealMan arm."""

from typing import Any

from servobus.protocols.definition import ProtocolDefinition
from servobus.protocols.modbus.codec import MAX_UNIT, ModbusCodec, node_of, rename
from servobus.protocols.roh.driver import RohDriver
from servobus.protocols.roh.model import load_models
from servobus.protocols.roh.options import CHANNELS, RohBus
from servobus.protocols.roh.simulated.device import devices


def codec(options: RohBus | None) -> ModbusCodec:
    """Return a codec for the master's end; Modbus-RTU has no variants."""
    return ModbusCodec("master")


def device_codec(options: RohBus | None) -> ModbusCodec:
    return ModbusCodec("device")


def fingers(unit: int, model: str) -> dict[str, dict[str, Any]]:
    """Return the six servos of a hand. Its map is asked for again, so it is not written into the config."""
    return {f"{channel}_{unit}": {"id": unit, "channel": channel} for channel in CHANNELS}


DEFINITION = ProtocolDefinition(
    options=RohBus,
    models=load_models,
    codec=codec,
    driver=RohDriver,
    device_codec=device_codec,
    devices=devices,
    rename=rename,
    node_of=node_of,
    # All hands are shipped with the first; those of the second generation detect the line's rate, within these.
    baudrates=(115_200, 460_800, 230_400, 57_600, 38_400, 19_200, 9_600),
    scan_ids=range(1, MAX_UNIT + 1),
    starter=fingers,
)
