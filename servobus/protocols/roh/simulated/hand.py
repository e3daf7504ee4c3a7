"""The inside of a simulated ROH hand: its registers, its fingers, and the effect of one on the other (ROH Modbus, 4.1).

Where the documents are silent: a write-only register reads 0. An unknown address, and a write to a read-only register, is refused
as illegal address. A value that a register cannot have is a device failure (invalid data). While the hand initialises or waits
for calibration, only the system registers can be written. Attributes may be set at any time.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from servobus.protocols.roh.model import FULL, RohModel, RohRegister
from servobus.protocols.roh.options import CHANNELS
from servobus.protocols.roh.simulated.finger import SimulatedFinger

SELF_TEST = 0.5
"""Seconds of the self-test at power-on."""
SYSTEM_END = 1020
ILLEGAL_ADDRESS, DEVICE_FAILURE = 2, 4
INITIALISING, UNCALIBRATED, INVALID, STUCK, FAILED, NOT_SAVED = range(1, 7)
"""Sub-exceptions of a device failure (ROH Modbus, 3.4)."""


class Refusal(Exception):
    """The exception with which the hand replies, and the sub-exception of a device failure."""

    def __init__(self, code: int, sub: int = 0) -> None:
        super().__init__(code, sub)
        self.code = code
        self.sub = sub


class SimulatedHand:
    """Registers and fingers of one hand. `peek` and `poke` reach each register, as the hand stores it."""

    def __init__(self, model: RohModel, unit: int) -> None:
        self.model = model
        self.node = unit
        self.refuses_write_only = False
        """A write-only register is refused when it is read, instead of reading 0."""
        self.refuses_reads_while_busy = False
        self.ignores_targets = False
        """It confirms a target, and keeps the old one."""
        self.fails: dict[int, int] = {}
        """Address -> sub-exception with which a write to it is refused."""
        self.key = 0xCA11
        """The value that `recalibrate` accepts."""
        self.presses = 1
        """Presses of the button that complete the calibration."""
        self.state = "work"
        """work, wait (for start_init), init, calibration, or update (of the firmware)."""
        self.fingers = [SimulatedFinger(current_limit=model.default_current) for _ in CHANNELS]
        self.beeps: list[int] = []
        """Milliseconds of each beep."""
        self.written: list[tuple[int, int]] = []
        """Address and word of each write that was accepted."""
        self._table = _table(model)
        self._memory = {address: register.default or 0 for address, (register, _) in self._table.items()}
        self.poke("node_id", 0, unit)
        self._moved_at = self._awake = self._ready = -math.inf

    def advance(self, now: float) -> None:
        """Move to where it is at `now`."""
        elapsed, self._moved_at = now - self._moved_at, max(now, self._moved_at)
        if self.state == "init" and now >= self._ready:
            self.state = "work"
        if 0 < elapsed < math.inf:
            for finger in self.fingers:
                finger.advance(elapsed)

    def reboot(self, now: float) -> None:
        """Switch off and on: what was not saved is lost. With a self-test, the fingers open."""
        self.advance(now)
        self._awake = now + self.model.reboot_s
        self.node = self.peek("node_id")
        for address, (register, _) in self._table.items():
            if register.memory == "ram":
                self._memory[address] = register.default or 0
        for finger, number in zip(self.fingers, range(len(self.fingers)), strict=True):
            self.fingers[number] = SimulatedFinger(
                finger.position, round(finger.position), current_limit=self.model.default_current
            )
        self.state = "wait" if "start_init" in self.model.registers else "work"
        if self.peek("self_test"):
            self._initialise(self._awake)

    def peek(self, name: str, channel: int = 0) -> int:
        """Return the stored raw value of a register."""
        register = self.model.named(name)
        return register.from_word(self._memory[register.address_of(channel)])

    def poke(self, name: str, channel: int, raw: int) -> None:
        """Store a raw value, without any effect on the fingers."""
        register = self.model.named(name)
        self._memory[register.address_of(channel)] = register.to_word(raw)

    def read_word(self, address: int) -> int:
        if address not in self._table:
            raise Refusal(ILLEGAL_ADDRESS)
        register, channel = self._table[address]
        if self.refuses_reads_while_busy and address >= SYSTEM_END:
            self._require_ready()
        if register.access == "w":
            if self.refuses_write_only:
                raise Refusal(ILLEGAL_ADDRESS)
            return 0
        live = LIVE.get(register.name)
        if live is not None and channel < len(self.fingers):
            return register.to_word(live(self, channel))
        return self._memory[address]

    def write_word(self, address: int, word: int) -> None:
        register, channel = self._table.get(address, (None, 0))
        if register is None or register.access == "r":
            raise Refusal(ILLEGAL_ADDRESS)
        if address in self.fails:
            raise Refusal(DEVICE_FAILURE, self.fails[address])
        if address >= SYSTEM_END:
            self._require_ready()
        raw = register.from_word(word)
        if not register.raw_range[0] <= raw <= register.raw_range[1]:
            raise Refusal(DEVICE_FAILURE, INVALID)
        self.written.append((address, word))
        self._memory[address] = word
        if channel >= len(self.fingers):
            return
        if register.name in FINGER_SETTINGS:
            attribute, convert = FINGER_SETTINGS[register.name]
            setattr(self.fingers[channel], attribute, convert(raw))
        elif register.name in EFFECTS:
            EFFECTS[register.name](self, channel, raw)

    def _require_ready(self) -> None:
        if self.state in ("wait", "init"):
            raise Refusal(DEVICE_FAILURE, INITIALISING)
        if self.state == "calibration":
            raise Refusal(DEVICE_FAILURE, UNCALIBRATED)

    # Effects of writes

    def _aim(self, channel: int, raw: int) -> None:
        self._set_target(channel, raw)
        self.poke("angle_target", channel, self._angle(channel, raw))

    def _aim_angle(self, channel: int, raw: int) -> None:
        """Replace a target outside by the limit, which then reads back."""
        open_, closed = self._ends(channel)
        angle = max(min(open_, closed), min(max(open_, closed), raw))
        position = round(FULL * (angle - open_) / (closed - open_))
        self._set_target(channel, position)
        self.poke("pos_target", channel, position)
        self.poke("angle_target", channel, angle)

    def _set_target(self, channel: int, raw: int) -> None:
        if not self.ignores_targets:
            self.fingers[channel].target = raw

    def _ends(self, channel: int) -> tuple[int, int]:
        open_, closed = self.model.angles[CHANNELS[channel]]
        return round(100 * open_), round(100 * closed)

    def _angle(self, channel: int, position: float) -> int:
        open_, closed = self._ends(channel)
        return round(open_ + (closed - open_) * position / FULL)

    def _beep(self, channel: int, raw: int) -> None:
        if self.peek("beep_switch"):
            self.beeps.append(raw)

    def _restart(self, channel: int, raw: int) -> None:
        if not raw:
            self.reboot(self._moved_at)
        else:
            self.state = "update"

    def _move_to_unit(self, channel: int, raw: int) -> None:
        self.poke("node_id", 0, raw & 0xFF)
        self.reboot(self._moved_at)

    def _recalibrate(self, channel: int, raw: int) -> None:
        if raw != self.key:
            raise Refusal(DEVICE_FAILURE, INVALID)
        self.state = "calibration"
        self.poke("button_press_cnt", 0, 0)

    def _press(self, channel: int, raw: int) -> None:
        if self.state == "calibration" and raw >= self.presses:
            self.state = "work"

    def _start_init(self, channel: int, raw: int) -> None:
        if self.state != "wait":
            raise Refusal(DEVICE_FAILURE, FAILED)
        self._initialise(self._moved_at)

    def _initialise(self, begin: float) -> None:
        self.state, self._ready = "init", begin + SELF_TEST
        for finger in self.fingers:
            finger.target = 0

    def _zero_force(self, channel: int, raw: int) -> None:
        for finger in self.fingers:
            finger.force = 0


LIVE: dict[str, Callable[[SimulatedHand, int], int]] = {
    "pos": lambda hand, channel: round(hand.fingers[channel].position),
    "angle": lambda hand, channel: hand._angle(channel, hand.fingers[channel].position),
    "pos_target": lambda hand, channel: hand.fingers[channel].target,
    "status": lambda hand, channel: hand.fingers[channel].status,
    "current": lambda hand, channel: hand.fingers[channel].current,
    "force": lambda hand, channel: hand.fingers[channel].force,
}
FINGER_SETTINGS: dict[str, tuple[str, Callable[[int], float | None]]] = {
    "speed": ("speed", int),
    "current_limit": ("current_limit", int),
    "force_limit": ("force_limit", int),
    "force_target": ("force_limit", lambda raw: raw or None),
    "stop_after_period": ("stop_after", lambda raw: raw / 1000),
}
"""Register -> attribute of the finger that a write sets, and its value."""
EFFECTS: dict[str, Callable[[SimulatedHand, int, int], None]] = {
    "pos_target": SimulatedHand._aim,
    "angle_target": SimulatedHand._aim_angle,
    "beep_period": SimulatedHand._beep,
    "reset": SimulatedHand._restart,
    "node_id": SimulatedHand._move_to_unit,
    "recalibrate": SimulatedHand._recalibrate,
    "button_press_cnt": SimulatedHand._press,
    "start_init": SimulatedHand._start_init,
    "reset_force": SimulatedHand._zero_force,
}


def _table(model: RohModel) -> dict[int, tuple[RohRegister, int]]:
    """Return address -> its register and channel."""
    table = {}
    for register in model.registers.values():
        for channel in range(max(1, register.channels)):
            first = register.address + channel * register.stride
            for address in range(first, first + register.length_of(channel)):
                assert address not in table, f"{model.name}: two registers at {address}"
                table[address] = (register, channel)
    return table
