"""FEETECH SMS 1.0 and its relatives (STS, SCS): instruction packets on RS485 or TTL."""

from servobus.protocols.definition import ProtocolDefinition
from servobus.protocols.sms.codec import MAX_ID, SmsCodec, node_of, rename
from servobus.protocols.sms.driver import SmsDriver
from servobus.protocols.sms.model import load_models
from servobus.protocols.sms.options import SmsBus
from servobus.protocols.sms.simulated.device import devices


def codec(options: SmsBus | None) -> SmsCodec:
    """Return a codec; it is the same for every bus and for both ends."""
    return SmsCodec()


DEFINITION = ProtocolDefinition(
    options=SmsBus,
    models=load_models,
    codec=codec,
    driver=SmsDriver,
    device_codec=codec,
    devices=devices,
    rename=rename,
    node_of=node_of,
    # The rates that the families are shipped with come first.
    baudrates=(1_000_000, 115_200, 500_000, 250_000, 128_000, 76_800, 57_600, 38_400, 19_200, 14_400, 9_600, 4_800),
    scan_ids=range(MAX_ID + 1),
)
