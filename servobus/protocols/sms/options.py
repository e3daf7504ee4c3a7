"""The YAML keys of a FEETECH bus and of its servos."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from servobus.protocols.options import BusOptions, Name, ServoOptions


class SmsServo(ServoOptions):
    id: Annotated[int, Field(ge=0, le=253)]
    """0 to 253 (SMS 1.0, 1.1); 254 addresses all servos."""
    model: str = "sms"
    """sms, sms_cl, sts, scs, or the path of a model file of your own (*.yaml, relative to the config)."""


class SmsBus(BusOptions):
    protocol: Literal["sms"]
    sync_max_bytes: Annotated[int, Field(ge=16, le=259)] = 128
    """Longest SYNC WRITE frame, in bytes: the length byte allows 259, and the servos' buffers are not documented."""
    status_return: Literal["all", "read_only"] = "all"
    """Which instructions the servos answer (response level of the memory table): all, or only PING and READ."""
    on_partial: Literal["abort", "go"] = "abort"
    """When a servo does not acknowledge its REG WRITE: withhold ACTION, or send it for the servos that are armed."""
    servos: dict[Name, SmsServo] = {}
    """The servos by name; without any, the line can be scanned."""

    @property
    def writes_answered(self) -> bool:
        """Whether the servos acknowledge writes."""
        return self.status_return == "all"
