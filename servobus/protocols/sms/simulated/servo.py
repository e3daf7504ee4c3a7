"""The inside of a simulated FEETECH servo: a memory table and a joint, and how they act on each other.

Where the documents are silent or contradict each other, the simulated servo behaves like this:
- torque 128 stores the offset that makes the present position 2048, locked or not; goal and torque do not change;
- a goal outside the stored angle limits ends at the limit, and the goal register keeps the written value;
- both limits 0 mean many turns: there is no limit, and the position counts on after one turn;
- in step mode a goal is a number of steps to go from where the joint is when the goal is written; turns are counted;
- under PWM (mode pwm, and motor) the joint turns in proportion to the word, and at full PWM as fast as it can;
- a mode that the model does not know, and torque 2 (damping), leave the joint at rest;
- after a restart the goal register is 0 (the table's default), so torque without a new goal moves the joint there;
- RESET stores the factory values in all EEPROM but the id, needs no unlock, and does not change RAM.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

from servobus.protocols.model import Register
from servobus.protocols.sms.codec import MAX_ID, MAX_PARAMETERS
from servobus.protocols.sms.model import LIMITS, SmsModel
from servobus.protocols.sms.simulated.joint import Joint
from servobus.protocols.sms.simulated.registers import SIZE, RegisterTable

TORQUE_ON, CALIBRATE = 1, 128
MIDDLE = 2048
"""The position that the present position becomes after CALIBRATE."""
AMPERES_AT_FULL_LOAD = 2.0
PWM_SIGN = 1 << 10
"""The PWM word is 0 to 1000 (0.1 %), sign in bit 10 (FEETECH memory table, address 44; vendor header SCSCL.h, WritePWM)."""
OVERLOAD = 1 << 5
SETTINGS = ("torque_limit", "max_torque", "position_offset")
"""These registers act on the joint too, beside goal, torque, and what decides about limits, mode and unit."""


class SimulatedServo:
    """Registers and joint of one servo. Plain attributes may be set at any time: `faults`, `voltage`, `joint.stuck`."""

    def __init__(self, model: SmsModel, servo_id: int, *, baudrate: int, position: int | None, response_level: int) -> None:
        self.model = model
        self.node = servo_id
        self.baudrate = baudrate
        self.voltage = 12.0
        self.faults = 0
        """The health byte (SMS 1.0, 1.2): in each reply and in register 65."""
        self.memory = RegisterTable(model)
        self._registers = self.memory.registers
        self._offset = 0
        self._mode = ""
        self._scale = 1.0
        """Steps/s of a count of speed."""
        self._end_of_steps = 0.0
        """Where the last goal in step mode ends."""
        start = float(model.zero if position is None else position) % model.steps_per_turn
        self.joint = Joint(model.steps_per_turn, model.max_steps_per_second, start, start)
        self._live = [(self._registers[name], measure) for name, measure in LIVE.items() if name in self._registers]
        self._steering = self._mark_steering()
        self._rates = dict(self._registers["baud_rate"].values)
        self._configure(baudrate, response_level)
        self._wake()

    def read_table(self, address: int, size: int, now: float) -> bytes:
        """Return the bytes of a READ. Measured registers are measured now."""
        end = address + size
        for register, measure in self._live:
            if register.address < end and register.end > address:
                self.joint.advance(now)
                scale = self._scale if register.unit == "speed" else register.scale
                self.memory.put(register, round(measure(self) / scale))
        return self.memory.read(address, min(size, MAX_PARAMETERS))

    def apply(self, address: int, data: bytes, now: float) -> None:
        """Carry out a WRITE. Writing the goal position switches torque on."""
        self.joint.advance(now)
        end = min(SIZE, address + len(data))
        torque, goal, *_ = self._parts
        before = self.memory.get(torque)
        self.memory.write(address, data)
        if self.memory.get(torque) == CALIBRATE:
            self.memory.put(torque, before)
            self._calibrate()
        if address < goal.end and end > goal.address:
            self.memory.put(torque, TORQUE_ON)
            self._end_of_steps = self.joint.position + self.memory.get(goal)
        if address <= self._registers["baud_rate"].address:
            self._adopt()
        if any(self._steering[address:end]):
            self._steer()

    def reset(self, now: float) -> None:
        """Return to factory values."""
        self.joint.advance(now)
        self.memory.reset(self._registers["id"])
        self._adopt()
        self._steer()

    def restart(self, now: float) -> None:
        """Switch power off and on: the joint does not move, unstored values and the count of turns are lost."""
        self.joint.advance(now)
        self.joint.position %= self.joint.turn
        self.memory.restart()
        self._wake()

    def trip(self, now: float) -> None:
        """Do what a protection does: torque off, and the fault is reported."""
        self.joint.advance(now)
        self.faults |= OVERLOAD
        self.memory.put(self._parts[0], 0)
        self._steer()

    def pose_as(self, end: int, major: int, minor: int) -> None:
        """Report another identity at addresses 2 to 4."""
        self.memory.identify(bytes((end, major, minor)))

    def get(self, name: str) -> int:
        """Return a raw value; 0 where this model has no such register."""
        register = self._registers.get(name)
        return self.memory.get(register) if register else 0

    # Measurements

    def reported(self) -> float:
        """Return the position as the servo reports it."""
        position = round(self.joint.position)
        return position % self.joint.turn if self.joint.wraps else position

    def load(self) -> float:
        """Return the load in percent, at most the torque limit."""
        limit = self._torque_limit() / 1000
        return 100 * max(-limit, min(limit, self.joint.load))

    # From registers to the joint

    @cached_property
    def _parts(self) -> tuple[Register, Register, Register, Register]:
        """The registers of torque, goal, time (or PWM) and speed."""
        torque, goal, word, speed = (self._registers[name] for name in (self.model.torque, *self.model.goal))
        return torque, goal, word, speed

    def _steer(self) -> None:
        """Make the joint follow the registers."""
        settings = {name: self.get(name) for name in self.model.settings_at_start}
        joint, mode = self.joint, self.model.mode(settings)
        self._scale = self.model.speed_scale(settings)
        if mode != self._mode:  # one that begins has no goal yet
            self._mode, self._end_of_steps = mode, joint.position
        offset = self.get("position_offset")
        joint.position += self._offset - offset
        self._offset = offset
        joint.wheel = mode in ("velocity", "pwm", "motor")
        limits = self.get(LIMITS[0]), self.get(LIMITS[1])
        joint.wraps = joint.wheel or (mode != "step" and limits != (0, 0))
        if joint.wraps:
            joint.position %= joint.turn
        joint.target = self._target(mode, limits)
        torque = self.memory.get(self._parts[0])
        joint.driven = torque == TORQUE_ON and self._torque_limit() > 0 and mode in self.model.modes
        joint.rate = self._rate(mode)

    def _target(self, mode: str, limits: tuple[int, int]) -> float:
        if mode == "step":
            return self._end_of_steps
        goal = self.memory.get(self._parts[1])
        return goal if limits == (0, 0) else max(limits[0], min(limits[1], goal))

    def _rate(self, mode: str) -> float:
        """Return steps/s. Speed 0 is rest in velocity mode; else the time register counts, where there is one, or no limit."""
        fastest = self.joint.fastest
        if mode in ("pwm", "motor"):
            return fastest * max(-1.0, min(1.0, self._pwm() / 1000))
        rate = self.memory.get(self._parts[3]) * self._scale
        if mode == "velocity":
            return max(-fastest, min(fastest, rate))
        if rate:
            return min(fastest, abs(rate))
        milliseconds = self.memory.get(self._parts[2]) if self.model.time_is_ms else 0
        distance = abs(self.joint.target - self.joint.position)
        return min(fastest, 1000 * distance / milliseconds) if milliseconds else fastest

    def _pwm(self) -> int:
        """Return the PWM word in 0.1 %, with its sign."""
        register = self._parts[2]
        word = int.from_bytes(self.memory.read(register.address, register.size), self.model.byte_order)
        return -(word & PWM_SIGN - 1) if word & PWM_SIGN else word

    def _torque_limit(self) -> int:
        """Return the torque limit in 0.1 %."""
        return self.get("torque_limit" if "torque_limit" in self._registers else "max_torque")

    def _calibrate(self) -> None:
        register = self._registers.get("position_offset")
        if register:
            half = self.joint.turn // 2
            offset = round(self.joint.position) + self._offset - MIDDLE
            self.memory.store(register, (offset + half) % (2 * half) - half)

    def _mark_steering(self) -> bytes:
        marks = bytearray(SIZE)
        for name in (*self.model.goal, self.model.torque, *SETTINGS, *self.model.settings_at_start):
            if register := self._registers.get(name):
                marks[register.address : register.end] = b"\1" * register.size
        return bytes(marks)

    # Id and baud rate

    def _configure(self, baudrate: int, response_level: int) -> None:
        """Store id, rate and response level. A rate that has no code replaces the factory's."""
        register = self._registers["baud_rate"]
        codes = [code for code, rate in self._rates.items() if rate == baudrate]
        code = codes[0] if codes else register.default or 0
        self._rates[code] = baudrate
        for name, raw in (("id", self.node), ("baud_rate", code), ("response_status_level", response_level)):
            self.memory.store(self._registers[name], raw)

    def _adopt(self) -> None:
        """Use the id and the baud rate of the registers at once; values that are not valid change nothing."""
        if (servo_id := self.get("id")) <= MAX_ID:
            self.node = servo_id
        self.memory.put(self._registers["id"], self.node)
        self.baudrate = int(self._rates.get(self.get("baud_rate"), self.baudrate))

    def _wake(self) -> None:
        if "torque_limit" in self._registers:
            self.memory.put(self._registers["torque_limit"], self.get("max_torque"))
        self._adopt()
        self._steer()


LIVE: dict[str, Callable[[SimulatedServo], float]] = {
    "present_position": SimulatedServo.reported,
    "present_speed": lambda servo: servo.joint.velocity,
    "present_load": SimulatedServo.load,
    "present_voltage": lambda servo: servo.voltage,
    "present_temperature": lambda servo: servo.joint.temperature,
    "servo_status": lambda servo: servo.faults,
    "moving": lambda servo: servo.joint.velocity != 0,
    "present_goal_position": lambda servo: servo.joint.target,
    "present_current": lambda servo: servo.load() / 100 * AMPERES_AT_FULL_LOAD,
}
"""Registers that are measured when they are read, in physical units."""
