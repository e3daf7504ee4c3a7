"""The YAML keys of a FEETECH bus."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from servobus.protocols.options import BusOptions, Name, ServoOptions


class SmsServo(ServoOptions):
    id: Annotated[int, Field(ge=0, le=253)]
    """0 to 253 (seed 1.1); 254 is everybody."""
    model: str = "sms"
    """sms, sms_cl, sts, scs, or the path of an own model file (*.yaml, relative to the config)."""


class SmsBus(BusOptions):
    protocol: Literal["sms"]
    sync_max_bytes: Annotated[int, Field(ge=16, le=259)] = 128
    """Greatest SYNC WRITE frame; the length byte allows 259 bytes, the servos' buffers are not documented."""
    status_return: Literal["all", "read_only"] = "all"
    """Which instructions are answered (response level of the memory table): with read_only no write is."""
    on_partial: Literal["abort", "go"] = "abort"
    """When a REG WRITE stays unacknowledged: withhold ACTION, or send it for those that are armed."""
    servos: dict[Name, SmsServo] = {}
    """Empty: a line to scan."""
