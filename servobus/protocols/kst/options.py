"""The YAML keys of a KST bus. What the specification leaves open is a key here; the defaults are the safe choice for each."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, field_validator, model_validator

from servobus.protocols.kst.codec import BAUD_TABLE, VERSION, Command
from servobus.protocols.model import Pair
from servobus.protocols.options import BusOptions, Finite, Name, ServoOptions

Byte = Annotated[int, Field(ge=0, le=0xFF)]

ALWAYS_HOLDS = "a KST servo has no torque command, so nothing can make it limp: it always holds. Use hold, or park"


class KstServo(ServoOptions):
    id: Annotated[int, Field(ge=1, le=255)]
    """1 to 254; 255 only where the bus's id_range has it. 0 is everybody."""
    model: str = "kst"
    """kst, or the path of an own model file (*.yaml, relative to the config)."""
    range_deg: Pair[Finite] | None = None
    """Degrees, as the servo counts them, that it may be sent to; None: the model's -90 to +90. What is outside is refused
    before the timing, whatever `on_limit` says: that clamps to `limits`."""

    @field_validator("on_estop", "on_exit", "on_lost_client")
    @classmethod
    def _never_limp(cls, kind: str) -> str:
        if kind == "limp":
            raise ValueError(ALWAYS_HOLDS)
        return kind

    @field_validator("acceleration", "torque_limit")
    @classmethod
    def _has_no_command(cls, value: float | None) -> float | None:
        if value is not None:
            raise ValueError("a KST servo has no command for it: take it out")
        return value

    @model_validator(mode="after")
    def _range_ascends(self) -> Self:
        if self.range_deg and self.range_deg[0] >= self.range_deg[1]:
            raise ValueError(f"range_deg: the first must be below the second, found {list(self.range_deg)}")
        return self


class KstBus(BusOptions):
    protocol: Literal["kst"]
    baudrate: Annotated[int, Field(ge=300, le=10_000_000)] = 512_000
    duplex: Literal["half", "full"] = "half"
    """full: RS422 is four wires, so the next request may travel while the previous reply still comes."""
    reply_delay_ms: Pair[Annotated[float, Field(ge=0, le=100)]] = (0.0, 0.5)
    """The pause before a servo's reply, least and greatest of all servos. Full duplex is timed by their difference: where it is
    greater than this says, two replies may meet."""
    sdo_order: Literal["auto", "be", "le"] = "auto"
    """Order of the four bytes of an abort code; auto learns it from the first known one."""
    broadcast_allow: list[Byte] = [int(Command.SET_POSITION)]
    """Commands that may be said to all. Any other than set position (0x09) needs `broadcast_reply: expect_one`."""
    broadcast_reply: Literal["ignore", "expect_one"] = "ignore"
    """expect_one: a servo answers broadcasts, and at most one is on the line."""
    save_reply: Literal["none", "optional", "required"] = "none"
    """Whether the answer to save is waited for, and whether it must come. The seed says it need not."""
    save_settle_ms: Annotated[float, Field(ge=0, le=10_000)] = 200.0
    """Silence, or patience, while the servo writes its flash."""
    id_effective: Literal["after_reboot", "immediate"] = "after_reboot"
    """When a servo obeys a new id or baud rate."""
    version_byte: Byte = VERSION
    """Second byte of each frame; others are no frames."""
    min_gap_us: Annotated[float, Field(ge=0, le=1_000_000)] = 0.0
    """Silence after each reply, before the next request."""
    status_bits: dict[Annotated[int, Field(ge=0, le=15)], str] = {}
    """Names for bits of the two status bytes (the second one's are 8 to 15). Only what has a name is reported."""
    echo_check: Literal["strict", "off"] = "strict"
    """strict: the reply to a set must bring back what was sent."""
    pad_check: Literal["strict", "ignore"] = "strict"
    """strict: unused data bytes must be 0; ten times fewer garbled frames pass."""
    id_range: Pair[Annotated[int, Field(ge=1, le=255)]] = (1, 254)
    """Ids that may be used and given."""
    baud_table: Annotated[dict[Byte, Annotated[int, Field(ge=300)]], Field(min_length=1)] = BAUD_TABLE
    """Code of the baud rate command -> rate."""
    servos: dict[Name, KstServo] = {}
    """Empty: a line to scan."""

    @property
    def spread(self) -> float | None:
        least, greatest = self.reply_delay_ms
        return (greatest - least) / 1000 if self.duplex == "full" else None

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        if self.baudrate not in self.baud_table.values():
            known = ", ".join(map(str, sorted(self.baud_table.values())))
            raise ValueError(f"baudrate: {self.baudrate} is none of the servos' rates {known} (baud_table)")
        lone = self.broadcast_reply == "expect_one"
        if not lone and set(self.broadcast_allow) - {int(Command.SET_POSITION)}:
            raise ValueError(
                "broadcast_allow: only set position (0x09) may be said to several servos: take the others out, or set "
                "broadcast_reply: expect_one for a line with a single servo"
            )
        if lone and len(self.servos) > 1:
            raise ValueError("broadcast_reply: expect_one is for a single servo; several answers would collide: set it to ignore")
        if self.reply_delay_ms[0] > self.reply_delay_ms[1]:
            raise ValueError(f"reply_delay_ms: the first must not be above the second, found {list(self.reply_delay_ms)}")
        first, last = self.id_range
        if first > last:
            raise ValueError(f"id_range: the first must not be above the second, found {list(self.id_range)}")
        for name, servo in self.servos.items():
            if not first <= servo.id <= last:
                raise ValueError(f"servos: the id {servo.id} of {name} is outside id_range {first} to {last}")
        return self
