"""KST servos on RS422, with fixed frames of 14 bytes. Written from the KST RS422 document, not tried on hardware yet."""

from __future__ import annotations

from servobus.protocols.definition import ProtocolDefinition
from servobus.protocols.kst.codec import KstCodec, node_of, rename
from servobus.protocols.kst.driver import KstDriver
from servobus.protocols.kst.model import load_models
from servobus.protocols.kst.options import KstBus
from servobus.protocols.kst.simulated.device import devices


def codec(options: KstBus | None = None) -> KstCodec:
    """Return a codec for either end of the line; without options, one as the document has it."""
    if options is None:
        return KstCodec()
    return KstCodec(options.version_byte, strict=options.pad_check == "strict")


DEFINITION = ProtocolDefinition(
    options=KstBus,
    models=load_models,
    codec=codec,
    driver=KstDriver,
    device_codec=codec,
    devices=devices,
    rename=rename,
    node_of=node_of,
    # The factory's rate first, then what RS422 is commonly set to.
    baudrates=(512_000, 115_200, 921_600, 256_000, 57_600, 38_400, 19_200, 9_600),
    scan_ids=range(1, 0xFF),
)
