"""What is inside a simulated ROH hand: its registers and its fingers, and how each moves the other (seed 4.1).

Where the documents are silent it does this: a register that can only be written reads 0; an address no register has, and a write
to one that can only be read, is refused as illegal address; what a register cannot take is a device failure (invalid data); while
it initialises or waits for calibration only the system block can be written. Plain attributes may be set at any time.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from servobus.protocols.roh.model import CHANNELS, FULL, RohModel, RohRegister
from servobus.protocols.roh.simulated.finger import SimulatedFinger

SELF_TEST = 0.5
"""Seconds of the self-test at power-on."""
SYSTEM_END = 1020
ILLEGAL_ADDRESS, DEVICE_FAILURE = 2, 4
INITIALISING, UNCALIBRATED, INVALID, STUCK, FAILED, NOT_SAVED = range(1, 7)
"""Sub-exceptions of a device failure (seed 3.4)."""


class Refusal(Exception):
    """The exception, and the sub-exception of a device failure, that is the answer."""

    def __init__(self, code: int, sub: int = 0) -> None:
        super().__init__(code, sub)
        self.code = code
        self.sub = sub


class SimulatedHand:
    """Registers and fingers of one hand."""

    def __init__(self, model: RohModel, unit: int) -> None:
        self.model = model
        self.node = unit
        self.refuses_write_only = False
        """A register that can only be written is refused when it is read, instead of reading 0."""
        self.refuses_reads_while_busy = False
        self.fails: dict[int, int] = {}
        """Address -> sub-exception that a write to it is refused with."""
        self.key = 0xCA11
        """What `recalibrate` takes."""
        self.presses = 1
        """Times the button confirms until the calibration is done."""
        self.state = "work"
        """Or wait (for start_init), init, calibration, update (of the firmware)."""
        self.digits = [SimulatedFinger(current_limit=model.default_current) for _ in CHANNELS]
        self.beeps: list[int] = []
        """Milliseconds of each beep."""
        self.written: list[tuple[int, int]] = []
        """Address and word of each write that was taken."""
        self._table = _table(model)
        self._memory = {address: register.default or 0 for address, (register, _) in self._table.items()}
        self._put("node_id", 0, unit)
        self._at = self._awake = self._ready = -math.inf

    def advance(self, now: float) -> None:
        """Be where it is at `now`."""
        elapsed, self._at = now - self._at, max(now, self._at)
        if self.state == "init" and now >= self._ready:
            self.state = "work"
        if 0 < elapsed < math.inf:
            for digit in self.digits:
                digit.advance(elapsed)

    def reboot(self, now: float) -> None:
        """Off and on: what was not saved is lost; with a self-test the fingers open."""
        self.advance(now)
        self._awake = now + self.model.reboot_s
        self.node = self.get("node_id")
        for address, (register, _) in self._table.items():
            if register.memory == "ram":
                self._memory[address] = register.default or 0
        for digit, number in zip(self.digits, range(len(self.digits)), strict=True):
            self.digits[number] = SimulatedFinger(digit.position, round(digit.position), current_limit=self.model.default_current)
        self.state = "wait"
        if self.get("self_test"):
            self._initialise(self._awake)

    def get(self, name: str, channel: int = 0) -> int:
        """Raw value of a register as it is stored."""
        register = self.model.named(name)
        return register.raw(self._memory[register.place(channel)])

    def look(self, address: int) -> int:
        if address not in self._table:
            raise Refusal(ILLEGAL_ADDRESS)
        register, channel = self._table[address]
        if self.refuses_reads_while_busy and address >= SYSTEM_END:
            self._require_work()
        if register.access == "w":
            if self.refuses_write_only:
                raise Refusal(ILLEGAL_ADDRESS)
            return 0
        live = LIVE.get(register.name)
        if live is not None and channel < len(self.digits):
            return register.word(live(self, channel))
        return self._memory[address]

    def write(self, address: int, word: int) -> None:
        register, channel = self._table.get(address, (None, 0))
        if register is None or register.access == "r":
            raise Refusal(ILLEGAL_ADDRESS)
        if address in self.fails:
            raise Refusal(DEVICE_FAILURE, self.fails[address])
        if address >= SYSTEM_END:
            self._require_work()
        raw = register.raw(word)
        if not register.raw_range[0] <= raw <= register.raw_range[1]:
            raise Refusal(DEVICE_FAILURE, INVALID)
        self.written.append((address, word))
        self._memory[address] = word
        act = ACTS.get(register.name)
        if act is not None and channel < len(self.digits):
            act(self, channel, raw)

    def _require_work(self) -> None:
        if self.state in ("wait", "init"):
            raise Refusal(DEVICE_FAILURE, INITIALISING)
        if self.state == "calibration":
            raise Refusal(DEVICE_FAILURE, UNCALIBRATED)

    def _put(self, name: str, channel: int, raw: int) -> None:
        register = self.model.named(name)
        self._memory[register.place(channel)] = register.word(raw)

    # What a write does

    def _aim(self, channel: int, raw: int) -> None:
        self.digits[channel].target = raw
        self._put("angle_target", channel, self._angle(channel, raw))

    def _aim_angle(self, channel: int, raw: int) -> None:
        """What lies outside is replaced by the limit, and reads back so."""
        open_, closed = self._ends(channel)
        angle = max(min(open_, closed), min(max(open_, closed), raw))
        position = round(FULL * (angle - open_) / (closed - open_))
        self.digits[channel].target = position
        self._put("pos_target", channel, position)
        self._put("angle_target", channel, angle)

    def _ends(self, channel: int) -> tuple[int, int]:
        open_, closed = self.model.angles[CHANNELS[channel]]
        return round(100 * open_), round(100 * closed)

    def _angle(self, channel: int, position: float) -> int:
        open_, closed = self._ends(channel)
        return round(open_ + (closed - open_) * position / FULL)

    def _set_speed(self, channel: int, raw: int) -> None:
        self.digits[channel].speed = raw

    def _limit_current(self, channel: int, raw: int) -> None:
        self.digits[channel].current_limit = raw

    def _limit_force(self, channel: int, raw: int) -> None:
        self.digits[channel].force_limit = raw

    def _aim_force(self, channel: int, raw: int) -> None:
        self.digits[channel].force_limit = raw or None

    def _stop_after(self, channel: int, raw: int) -> None:
        self.digits[channel].stop_after = raw / 1000

    def _beep(self, channel: int, raw: int) -> None:
        if self.get("beep_switch"):
            self.beeps.append(raw)

    def _restart(self, channel: int, raw: int) -> None:
        if not raw:
            self.reboot(self._at)
        else:
            self.state = "update"

    def _move_to_unit(self, channel: int, raw: int) -> None:
        self._put("node_id", 0, raw & 0xFF)
        self.reboot(self._at)

    def _recalibrate(self, channel: int, raw: int) -> None:
        if raw != self.key:
            raise Refusal(DEVICE_FAILURE, INVALID)
        self.state = "calibration"
        self._put("button_press_cnt", 0, 0)

    def _press(self, channel: int, raw: int) -> None:
        if self.state == "calibration" and raw >= self.presses:
            self.state = "work"

    def _start_init(self, channel: int, raw: int) -> None:
        if self.state != "wait":
            raise Refusal(DEVICE_FAILURE, FAILED)
        self._initialise(self._at)

    def _initialise(self, begin: float) -> None:
        self.state, self._ready = "init", begin + SELF_TEST
        for digit in self.digits:
            digit.target = 0

    def _zero_force(self, channel: int, raw: int) -> None:
        for digit in self.digits:
            digit.force = 0


LIVE: dict[str, Callable[[SimulatedHand, int], int]] = {
    "pos": lambda hand, channel: round(hand.digits[channel].position),
    "angle": lambda hand, channel: hand._angle(channel, hand.digits[channel].position),
    "pos_target": lambda hand, channel: hand.digits[channel].target,
    "status": lambda hand, channel: hand.digits[channel].status,
    "current": lambda hand, channel: hand.digits[channel].current,
    "force": lambda hand, channel: hand.digits[channel].force,
}
ACTS: dict[str, Callable[[SimulatedHand, int, int], None]] = {
    "pos_target": SimulatedHand._aim,
    "angle_target": SimulatedHand._aim_angle,
    "speed": SimulatedHand._set_speed,
    "current_limit": SimulatedHand._limit_current,
    "force_limit": SimulatedHand._limit_force,
    "force_target": SimulatedHand._aim_force,
    "stop_after_period": SimulatedHand._stop_after,
    "beep_period": SimulatedHand._beep,
    "reset": SimulatedHand._restart,
    "node_id": SimulatedHand._move_to_unit,
    "recalibrate": SimulatedHand._recalibrate,
    "button_press_cnt": SimulatedHand._press,
    "start_init": SimulatedHand._start_init,
    "reset_force": SimulatedHand._zero_force,
}


def _table(model: RohModel) -> dict[int, tuple[RohRegister, int]]:
    """Address -> register, and the channel it is of."""
    table = {}
    for register in model.registers.values():
        for channel in range(max(1, register.channels)):
            size = register.words if isinstance(register.words, int) else register.words[channel]
            first = register.address + channel * register.stride
            for address in range(first, first + size):
                assert address not in table, f"{model.name}: two registers at {address}"
                table[address] = (register, channel)
    return table
