"""The simulated hand by itself."""

from __future__ import annotations

import pytest

from servobus.protocols.modbus.codec import encode, pack
from servobus.protocols.roh.simulated.finger import SimulatedFinger
from tests.protocols.roh.bench import ask_device, hand_of, question, read_registers, write_registers

ALL = pytest.mark.parametrize("name", ["legacy", "v1", "v2"])


# Registers


@ALL
def test_every_register_can_be_read_and_nothing_else(name: str) -> None:
    hand = hand_of(name)
    for address in range(990, 2600):
        assert bool(read_registers(hand, address)) == (address in hand._table)
    hand.refuses_write_only = True
    assert read_registers(hand, hand.model.named("beep_period").address) == []


def test_exceptions() -> None:
    hand = hand_of()
    for function, size in ((1, 4), (5, 4), (22, 6)):
        (reply,) = hand.handle(question(encode(2, function, bytes(size))), 0.0)
        assert reply.data == encode(2, 0x80 | function, b"\1")
    assert write_registers(hand, 999, 1) == write_registers(hand, 1000, 1) == 2
    hand.max_registers = 8
    assert write_registers(hand, 1125, [1] * 8) == 0
    assert write_registers(hand, 1125, [1] * 9) == 3
    assert read_registers(hand, 1020, 8) == [0] * 8
    assert read_registers(hand, 1020, 9) == []
    single = ask_device(hand, 6, pack((1125, 9)))
    assert single is not None
    assert single.data == pack((1125, 9))


def test_what_a_register_cannot_take_is_invalid_data() -> None:
    hand = hand_of()
    assert write_registers(hand, 1009, 1) == 0
    assert write_registers(hand, 1009, 2) == 4
    assert read_registers(hand, 1006) == [3]
    hand.fails[1135] = 6
    assert write_registers(hand, 1135, 1) == 4
    assert read_registers(hand, 1006) == [6]


def test_a_write_that_is_refused_midway_is_applied_in_part() -> None:
    hand = hand_of()
    hand.fails[1137] = 4
    assert write_registers(hand, 1135, [1, 2, 3, 4]) == 4
    assert read_registers(hand, 1135, 4) == [1, 2, 0, 0]


def test_broadcasts() -> None:
    hand = hand_of()
    assert write_registers(hand, 1125, 9, to=0) is None
    assert read_registers(hand, 1125) == [9]
    assert ask_device(hand, 3, pack((1000, 1)), to=0) is None
    hand.obeys_broadcasts = False
    assert write_registers(hand, 1125, 8, to=0) is None
    assert read_registers(hand, 1125) == [9]
    hand.obeys_broadcasts = hand.answers_broadcasts = True
    assert write_registers(hand, 1125, 8, to=0) == 0
    assert write_registers(hand, 1125, 8, to=3) is None
    hand.dead = True
    assert write_registers(hand, 1125, 8) is None


def test_replies_come_after_a_delay_that_can_be_longer() -> None:
    hand = hand_of()
    hand.delay, hand.extra_delay = 0.004, 0.5
    (reply,) = hand.handle(question(encode(2, 3, pack((1000, 1)))), 0.0)
    assert (reply.delay, reply.late) == (0.004, 0.5)


# Fingers


def test_a_finger_moves_at_its_speed() -> None:
    hand = hand_of()
    write_registers(hand, 1126, 10000)
    write_registers(hand, 1136, 30000)
    assert read_registers(hand, 1146, now=1.0) == [10000]
    assert read_registers(hand, 1086) == [1]
    assert read_registers(hand, 1106, now=1.0) == [150]
    assert read_registers(hand, 1146, now=9.0) == [30000]
    assert read_registers(hand, 1086, now=9.0) == [2]
    write_registers(hand, 1136, 0, now=9.0)
    assert read_registers(hand, 1146, now=10.0) == [20000]
    assert read_registers(hand, 1086, now=10.0) == [0]
    assert read_registers(hand, 1136, now=10.0) == [0]


@ALL
def test_angles_follow_and_stay_within_their_limits(name: str) -> None:
    hand = hand_of(name)
    target, angle = hand.model.named("angle_target").address + 1, hand.model.named("angle").address + 1
    assert write_registers(hand, target, 20000) == 0
    assert read_registers(hand, target) == [17837]
    assert write_registers(hand, target, 14000) == 0
    assert read_registers(hand, target) == [14000]
    assert read_registers(hand, angle, now=5.0) == [14000]
    write_registers(hand, hand.model.named("pos_target").address + 1, 65535, now=5.0)
    assert read_registers(hand, target, now=5.0) == [10022]


def test_an_obstacle_stalls_a_finger() -> None:
    hand = hand_of("v1")
    hand.fingers[1].obstacle = 20000
    write_registers(hand, 1116, 65535)
    write_registers(hand, 1126, 20000)
    write_registers(hand, 1136, 65535)
    readings = [
        (read_registers(hand, 1146, now=t)[0], read_registers(hand, 1086, now=t)[0], read_registers(hand, 1106, now=t)[0])
        for t in (0.5, 1.2, 1.5)
    ]
    assert readings == [(10000, 1, 150), (20000, 3, 1178), (20000, 5, 0)]
    write_registers(hand, 1136, 0, now=1.5)
    assert read_registers(hand, 1146, now=2.0) == [10000]


def test_a_gentle_finger_stops_at_its_force() -> None:
    hand = hand_of("v1")
    hand.fingers[1].obstacle = 20000
    write_registers(hand, 1096, 600)
    write_registers(hand, 1116, 3000)
    write_registers(hand, 1136, 65535)
    assert read_registers(hand, 1086, now=3.0) == [4]
    assert read_registers(hand, 1121, now=3.0) == [3000]
    later = hand_of("v2")
    later.fingers[1].obstacle = 0
    write_registers(later, 1116, 2000)
    write_registers(later, 1195 + 11, 5000)
    write_registers(later, 1136, 65535)
    assert read_registers(later, 1086, now=1.0) == [4]
    assert read_registers(later, 1176, now=1.0) == [2000]
    write_registers(later, 1016, 1, now=1.0)
    assert read_registers(later, 1176, now=1.0) == [0]
    write_registers(later, 1116, 0, now=1.0)
    assert read_registers(later, 1086, now=2.0) == [3], "no force is aimed at: it pushes until its stop-after period is over"


def test_a_finger_without_speed_does_not_move() -> None:
    finger = SimulatedFinger(target=100, speed=0, obstacle=0.0)
    finger.advance(0.1)
    assert (finger.position, finger.status) == (0, 1)


def test_reserved_channels_are_registers_without_a_finger() -> None:
    hand = hand_of()
    assert write_registers(hand, 1141, 5) == 0
    assert read_registers(hand, 1141) == [5]
    assert read_registers(hand, 1151) == [0]


# States


def test_the_beeper() -> None:
    hand = hand_of()
    write_registers(hand, 1010, 500)
    write_registers(hand, 1009, 0)
    write_registers(hand, 1010, 600)
    assert hand.beeps == [500]


def test_a_restart_forgets_what_was_not_saved_and_homes() -> None:
    hand = hand_of()
    write_registers(hand, 1009, 0)
    write_registers(hand, 1125, 9)
    write_registers(hand, 1136, 65535)
    read_registers(hand, 1000, now=2.0)
    hand.reboot(2.0)
    assert write_registers(hand, 1136, 5, now=2.9) is None
    assert write_registers(hand, 1136, 5, now=3.1) == 4
    assert read_registers(hand, 1006, now=3.1) == [1]
    assert read_registers(hand, 1146, now=3.1)[0] < 65535
    assert write_registers(hand, 1136, 5, now=3.6) == 0
    assert [read_registers(hand, 1009, now=3.6), read_registers(hand, 1125, now=3.6)] == [[0], [65535]]


def test_without_a_self_test_it_waits_to_be_started() -> None:
    hand = hand_of()
    assert write_registers(hand, 1013, 1) == 4
    write_registers(hand, 1008, 0)
    write_registers(hand, 1014, 0)
    assert hand.state == "wait"
    assert write_registers(hand, 1136, 5, now=2.0) == 4
    hand.refuses_reads_while_busy = True
    assert read_registers(hand, 1146, now=2.0) == []
    assert write_registers(hand, 1013, 1, now=2.0) == 0
    assert write_registers(hand, 1136, 5, now=2.4) == 4
    assert write_registers(hand, 1136, 5, now=2.5) == 0


def test_calibration() -> None:
    hand = hand_of()
    assert write_registers(hand, 1012, 1) == 4
    assert write_registers(hand, 1012, hand.key) == 0
    hand.presses = 2
    assert write_registers(hand, 1136, 5) == 4
    assert read_registers(hand, 1006) == [2]
    assert write_registers(hand, 1011, 1) == 0
    assert write_registers(hand, 1136, 5) == 4
    assert write_registers(hand, 1011, 2) == 0
    assert write_registers(hand, 1136, 5) == 0
