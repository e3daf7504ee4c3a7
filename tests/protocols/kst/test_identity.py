"""Who answers at an address, and when two servos with one id are suspected."""

from __future__ import annotations

import pytest

from servobus.errors import ReplyTimeout
from servobus.protocols.kst.codec import FACTORY_ID, Command
from servobus.protocols.kst.identity import JITTER, ROUNDS
from tests.protocols.kst.bench import Bench, device_of


def factory_bench() -> Bench:
    return Bench({"pan": {"id": FACTORY_ID}})


def test_one_servo_raises_no_suspicion() -> None:
    bench = factory_bench()
    result = bench.run(bench.driver.inspect(FACTORY_ID))
    assert (result.model, result.firmware, result.notes) == ("kst", "1.00", ())
    assert len(bench.sent) == 2 * ROUNDS


def test_two_new_servos_at_different_places_are_suspected_by_name() -> None:
    """KST RS422, 1: every new servo has the id 0x25."""
    bench = factory_bench()
    bench.devices.append(device_of(position=111))
    (note,) = bench.run(bench.driver.inspect(FACTORY_ID)).notes
    assert note.startswith("two servos with id 37 (0x25, the id of every new servo) are suspected: 5 of 10 replies were garbled")
    assert "Connect them one at a time" in note


@pytest.mark.parametrize("position", [0, -333])
def test_two_servos_with_equal_replies_are_taken_for_one(position: int) -> None:
    """A clash is never excluded. The answers 0 and -333 at once make the very frame of the answer 0."""
    bench = factory_bench()
    bench.devices.append(device_of(position=position))
    assert bench.run(bench.driver.inspect(FACTORY_ID)).notes == ()


def test_different_versions_are_suspected() -> None:
    bench = Bench()
    turns = iter(range(2 * ROUNDS))

    def another_speaks(request: object) -> bool:
        bench.devices[0].firmware = b"1.00" if next(turns) % 4 > 1 else b"2.00"
        return False

    bench.loses = another_speaks
    (note,) = bench.run(bench.driver.inspect(1)).notes
    assert "it reports different firmware versions" in note
    assert "0x25" not in note


@pytest.mark.parametrize(("way", "suspected"), [(JITTER, False), (JITTER + 1, True)])
def test_a_position_that_jumps_is_suspected(way: int, suspected: bool) -> None:
    bench = Bench()

    turns = iter(range(2 * ROUNDS))

    def jump(request: object) -> bool:
        device = bench.devices[0]
        device.position = device.goal = float(way if next(turns) % 4 > 1 else 0)
        return False

    bench.loses = jump
    notes = bench.run(bench.driver.inspect(1)).notes
    assert any(f"its position jumps between 0 and {way} steps" in note for note in notes) is suspected


@pytest.mark.parametrize(
    ("positions", "suspected"), [((0, 50, 100, 150, 200), False), ((0, 50, 0, 50, 0), True), ((9, 0, 9, 0, 9), False)]
)
def test_a_configured_servo_may_be_on_its_way_but_not_to_and_fro(positions: tuple[int, ...], suspected: bool) -> None:
    bench = factory_bench()
    turns = iter([position for position in positions for _ in range(2)])

    def go(request: object) -> bool:
        bench.devices[0].position = bench.devices[0].goal = float(next(turns))
        return False

    bench.loses = go
    assert bool(bench.run(bench.driver.identify("pan")).notes) is suspected


def test_a_refusal_is_no_sign_of_a_second_servo() -> None:
    bench = Bench()
    bench.devices[0].refuses = {Command.READ_VERSION: 0x06020000}
    result = bench.run(bench.driver.inspect(1))
    assert (result.firmware, result.notes) == (None, ())
    assert bench.run(bench.driver.identify("pan")).firmware is None


def test_where_nothing_answers_there_is_nobody() -> None:
    bench = Bench()
    with pytest.raises(ReplyTimeout):
        bench.run(bench.driver.inspect(3))
    assert len(bench.sent) == 2 * ROUNDS


def test_a_configured_servo_is_asked_once_unless_it_has_the_factory_id() -> None:
    bench = Bench({"pan": {"id": 1}, "new": {"id": FACTORY_ID}})
    result = bench.run(bench.driver.identify("pan"))
    assert (result.firmware, result.mode, len(bench.sent)) == ("1.00", "position", 1)
    bench.devices.append(device_of(position=111))
    assert "two servos with id 37" in bench.run(bench.driver.identify("new")).notes[0]


def test_a_learned_byte_order_is_a_note() -> None:
    bench = Bench()
    bench.driver.settings.aborts.code(b"\x30\x00\x09\x06")
    assert "low byte first" in bench.run(bench.driver.identify("pan")).notes[0]
    bench = Bench(sdo_order="le")
    assert bench.run(bench.driver.identify("pan")).notes == ()
