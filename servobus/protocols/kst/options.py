"""The YAML keys of a KST bus. What the KST RS422 document leaves open is a key; its default is the safe choice."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, field_validator, model_validator

from servobus.protocols.kst.codec import BAUD_TABLE, VERSION
from servobus.protocols.model import Pair
from servobus.protocols.options import BusOptions, Finite, Name, ServoOptions

Byte = Annotated[int, Field(ge=0, le=0xFF)]

ALWAYS_HOLDS = "a KST servo has no torque command and cannot be made limp: it always holds. Use hold, or park"


class KstServo(ServoOptions):
    live: ClassVar[frozenset[str]] = ServoOptions.live | {"range_deg"}

    id: Annotated[int, Field(ge=1, le=255)]
    """1 to 254; 255 only where the bus's id_range has it. 0 is the broadcast id."""
    model: str = "kst"
    """kst, or the path of a model file of your own (*.yaml, relative to the config)."""
    range_deg: Pair[Finite] | None = None
    """Minimum and maximum goal in degrees, as the servo counts them; default: the model's -90 to +90. A goal outside is refused,
    whatever `on_limit` is, which only clamps to `limits`."""

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

    @field_validator("allow_max_speed")
    @classmethod
    def _has_no_speed(cls, allowed: bool) -> bool:
        if allowed:
            raise ValueError("the host keeps the speed of a KST servo, so it has no speed without a limit: take it out")
        return allowed

    @model_validator(mode="after")
    def _range_ascends(self) -> Self:
        if self.range_deg and self.range_deg[0] >= self.range_deg[1]:
            raise ValueError(f"range_deg: the first must be below the second, found {list(self.range_deg)}")
        return self


class KstBus(BusOptions):
    live: ClassVar[frozenset[str]] = BusOptions.live | {"status_bits"}

    protocol: Literal["kst"]
    baudrate: Annotated[int, Field(ge=300, le=10_000_000)] = 512_000
    """Baud rate of the servos, in bits/s."""
    duplex: Literal["half", "full"] = "half"
    """full: RS422 has four wires, so the next request may travel while the previous reply arrives."""
    reply_delay_ms: Pair[Annotated[float, Field(ge=0, le=100)]] = (0.0, 0.5)
    """Minimum and maximum pause before a reply, over all servos, in ms. Full duplex is timed by their difference: with a larger
    difference than this, two replies may collide."""
    sdo_order: Literal["auto", "be", "le"] = "auto"
    """Order of the four bytes of an abort code; auto learns it from the first known code."""
    save_reply: Literal["none", "optional", "required"] = "none"
    """Whether the reply to save is waited for, and whether it must come. The document says that none is needed."""
    save_settle_ms: Annotated[float, Field(ge=0, le=10_000)] = 200.0
    """How long a servo may need to write its flash, in ms: silence after save, or patience for its reply."""
    id_effective: Literal["after_reboot", "immediate"] = "after_reboot"
    """When a servo uses a new id or baud rate."""
    version_byte: Byte = VERSION
    """The second byte of each frame; frames with another one are discarded."""
    min_gap_us: Annotated[float, Field(ge=0, le=1_000_000)] = 0.0
    """Silence after each reply, before the next request, in us."""
    status_bits: dict[Annotated[int, Field(ge=0, le=15)], str] = {}
    """Names for bits of the two status bytes (8 to 15: the second byte). A bit with a name is reported as a fault."""
    echo_check: Literal["strict", "off"] = "strict"
    """strict: the reply to a set command must repeat its data."""
    pad_check: Literal["strict", "ignore"] = "strict"
    """strict: unused data bytes must be 0, which lets ten times fewer garbled frames pass."""
    id_range: Pair[Annotated[int, Field(ge=1, le=255)]] = (1, 254)
    """Minimum and maximum id that may be used and assigned."""
    baud_table: Annotated[dict[Byte, Annotated[int, Field(ge=300)]], Field(min_length=1)] = BAUD_TABLE
    """Rates of the baud rate command, in bits/s, by code."""
    servos: dict[Name, KstServo] = {}
    """The servos by name; without any, the line can be scanned."""

    @property
    def spread(self) -> float | None:
        fastest, slowest = self.reply_delay_ms
        return (slowest - fastest) / 1000 if self.duplex == "full" else None

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        if self.baudrate not in self.baud_table.values():
            rates = ", ".join(map(str, sorted(self.baud_table.values())))
            raise ValueError(f"baudrate: {self.baudrate} is not one of the servos' rates {rates} (baud_table)")
        if self.reply_delay_ms[0] > self.reply_delay_ms[1]:
            raise ValueError(f"reply_delay_ms: the first must not be above the second, found {list(self.reply_delay_ms)}")
        first, last = self.id_range
        if first > last:
            raise ValueError(f"id_range: the first must not be above the second, found {list(self.id_range)}")
        for name, servo in self.servos.items():
            if not first <= servo.id <= last:
                raise ValueError(f"servos: the id {servo.id} of {name} is outside id_range {first} to {last}")
        return self
