"""A new id and a new rate: one at a time, on one servo, read back, saved on request, in effect after a restart."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from servobus.errors import DeviceError, EchoMismatch, LimitError, NotSupported, ReplyTimeout, UnknownName
from servobus.protocols.kst.codec import FACTORY_ID, Command, encode
from servobus.protocols.kst.commissioning import KstCommissioning
from tests.protocols.kst.bench import Bench, device_of


def resolved(bench: Bench, node: int = FACTORY_ID) -> int | None:
    """The id a restarted servo answers to; None: its change is pending as before."""
    plan = bench.driver.commissioning.restarted(node)
    assert plan is not None
    return bench.run(plan)


def new_servo(**keys: Any) -> tuple[Bench, KstCommissioning]:
    bench = Bench({"new": {"id": FACTORY_ID}}, **keys)
    return bench, bench.driver.commissioning


def test_a_new_id_is_read_back_saved_and_answers_after_a_restart() -> None:
    bench, commissioning = new_servo()
    change = bench.run(commissioning.set_id(FACTORY_ID, 5, save=True))
    assert (change.what, change.value, change.saved, change.pending_reboot, change.notes) == ("id", 5, True, True, ())
    frames = bench.frames()
    assert frames[0] == encode(5, Command.READ_ID)
    assert frames[-3:] == [
        encode(FACTORY_ID, Command.SET_ID, b"\5"),
        encode(FACTORY_ID, Command.READ_ID),
        encode(FACTORY_ID, Command.SAVE, b"save"),
    ]
    bench.devices[0].reboot(0.0)
    bench.after(1.0)
    assert resolved(bench) == 5
    assert commissioning.pending == {}


def test_until_the_restart_the_old_id_answers_and_reports_the_change() -> None:
    """KST RS422, 3.1, 3.2: a change is in effect after save and restart."""
    bench, commissioning = new_servo()
    bench.run(commissioning.set_id(FACTORY_ID, 5))
    assert bench.run(bench.driver.identify("new")).notes == (
        "pending_reboot: id 5 is set and not in effect yet: save and restart the servo",
    )
    assert bench.driver.fault_names("new", None) == ("pending_reboot",)
    bench.run(commissioning.save(FACTORY_ID))
    assert str(commissioning.pending[FACTORY_ID]).endswith("not in effect yet: restart the servo")
    assert bench.exchange(bench.driver.ping(FACTORY_ID)) is None


def test_a_second_change_is_refused_while_one_waits() -> None:
    """KST RS422, 3.1, 3.2: a change is in effect after save and restart."""
    bench, commissioning = new_servo()
    bench.run(commissioning.set_id(FACTORY_ID, 5))
    bench.frames()
    with pytest.raises(NotSupported, match=r"pending_reboot: id 5 is set .* One change at a time: nothing was sent"):
        commissioning.set_id(FACTORY_ID, 6)
    with pytest.raises(NotSupported, match=r"pending_reboot: id 5 is set .* One change at a time: nothing was sent"):
        commissioning.set_baudrate(FACTORY_ID, 9600)
    assert bench.frames() == []


def test_a_change_that_was_not_saved_is_lost_by_the_restart() -> None:
    bench, commissioning = new_servo()
    bench.run(commissioning.set_id(FACTORY_ID, 5))
    bench.devices[0].reboot(0.0)
    bench.after(1.0)
    assert resolved(bench) == FACTORY_ID
    assert commissioning.pending == {}
    assert bench.driver.fault_names("new", None) == ()
    assert bench.run(commissioning.set_id(FACTORY_ID, 6)).value == 6


def test_a_saved_change_that_the_servo_did_not_keep_is_over() -> None:
    """After the restart the servo answers at its old id, not at the new one."""
    bench, commissioning = new_servo()
    bench.run(commissioning.set_id(FACTORY_ID, 5))
    commissioning.pending[FACTORY_ID] = replace(commissioning.pending[FACTORY_ID], saved=True)
    bench.devices[0].reboot(0.0)
    bench.after(1.0).frames()
    assert resolved(bench) == FACTORY_ID
    assert bench.frames() == [encode(5, Command.READ_ID), encode(FACTORY_ID, Command.READ_ID)]
    assert commissioning.pending == {}


def test_a_change_stays_pending_while_nobody_answers() -> None:
    bench, commissioning = new_servo()
    bench.run(commissioning.set_id(FACTORY_ID, 5, save=True))
    bench.loses = lambda request: True
    assert resolved(bench) is None
    assert FACTORY_ID in commissioning.pending


def test_a_restart_without_a_pending_change_needs_no_plan() -> None:
    bench, commissioning = new_servo()
    assert commissioning.restarted(FACTORY_ID) is None
    assert bench.frames() == []


def test_a_scan_that_finds_the_new_id_ends_the_change() -> None:
    bench, commissioning = new_servo()
    bench.run(commissioning.set_id(FACTORY_ID, 5))
    bench.run(bench.driver.inspect(FACTORY_ID))
    assert FACTORY_ID in commissioning.pending
    bench.run(commissioning.save(FACTORY_ID))
    bench.devices[0].reboot(0.0)
    bench.after(1.0).run(bench.driver.inspect(5))
    assert commissioning.pending == {}


def test_an_address_that_answers_with_another_id_is_not_the_one() -> None:
    bench, commissioning = new_servo()
    bench.run(commissioning.set_id(FACTORY_ID, 5, save=True))
    bench.devices[0].reboot(0.0)
    bench.devices[0].answers = {Command.READ_ID: b"\x09"}
    assert resolved(bench.after(1.0)) is None
    assert FACTORY_ID in commissioning.pending


def test_a_new_rate_is_echoed_and_counts_after_save_and_restart() -> None:
    """KST RS422, 3.1: no command reads a rate back."""
    bench, commissioning = new_servo()
    change = bench.run(commissioning.set_baudrate(FACTORY_ID, 115_200, save=True))
    assert (change.what, change.value, change.saved) == ("baudrate", 115_200, True)
    bench.devices[0].reboot(0.0)
    bench.after(1.0)
    assert resolved(bench) is None
    bench.baudrate = 115_200
    assert resolved(bench) == FACTORY_ID


def test_an_own_baud_table_is_obeyed() -> None:
    """KST RS422, 3.1: eight baud rates."""
    bench, commissioning = new_servo(baud_table={6: 512_000, 9: 1_000_000})
    bench.run(commissioning.set_baudrate(FACTORY_ID, 1_000_000))
    assert encode(FACTORY_ID, Command.SET_BAUD, b"\x09") in bench.frames()
    with pytest.raises(LimitError, match="baud rate 9600 is not one of 512000, 1000000: nothing was sent"):
        commissioning.set_baudrate(FACTORY_ID, 9600)


@pytest.mark.parametrize(("new", "fits"), [(0, False), (1, True), (254, True), (255, False)])
def test_which_ids_may_be_given(new: int, fits: bool) -> None:
    """KST RS422, 2.1: ids are 0x00 to 0xFF, and 0x00 is the broadcast."""
    bench, commissioning = new_servo()
    if fits:
        assert bench.run(commissioning.set_id(FACTORY_ID, new)).value == new
    else:
        with pytest.raises(LimitError, match=f"id {new} is outside 1 to 254"):
            commissioning.set_id(FACTORY_ID, new)


def test_id_255_is_warned_of() -> None:
    """KST RS422, 2.1: ids are 0x00 to 0xFF, and 0x00 is the broadcast."""
    bench, commissioning = new_servo(id_range=[1, 255])
    assert "silent line" in bench.run(commissioning.set_id(FACTORY_ID, 255)).notes[0]


def test_an_id_that_is_taken_is_not_given() -> None:
    bench = Bench({"new": {"id": FACTORY_ID}, "pan": {"id": 1}})
    with pytest.raises(LimitError, match="id 1 belongs to another servo of this bus"):
        bench.driver.commissioning.set_id(FACTORY_ID, 1)
    bench.devices.append(device_of(servo_id=9))
    with pytest.raises(DeviceError, match="id 9 answers already: choose a free one"):
        bench.run(bench.driver.commissioning.set_id(FACTORY_ID, 9))
    assert not bench.driver.commissioning.pending


def test_an_id_that_another_servo_waits_for_is_not_given() -> None:
    bench = Bench({"one": {"id": 1}, "two": {"id": 2}})
    bench.run(bench.driver.commissioning.set_id(1, 9))
    with pytest.raises(LimitError, match="id 9 belongs to another servo"):
        bench.driver.commissioning.set_id(2, 9)


def test_its_own_id_may_be_given_again() -> None:
    bench, commissioning = new_servo()
    assert bench.run(commissioning.set_id(FACTORY_ID, FACTORY_ID)).value == FACTORY_ID


def test_nothing_is_changed_where_two_servos_are_suspected() -> None:
    """KST RS422, 1: every new servo has the id 0x25."""
    bench, commissioning = new_servo()
    bench.devices.append(device_of(position=111))
    for plan in (commissioning.set_id(FACTORY_ID, 5), commissioning.set_baudrate(FACTORY_ID, 9600)):
        with pytest.raises(DeviceError, match=r"two servos with id 37 \(0x25.* are suspected.*Nothing was changed"):
            bench.run(plan)
    assert not any(frame[3] in (Command.SET_ID, Command.SET_BAUD) for frame in bench.frames())


def test_nothing_is_changed_where_answers_are_missing() -> None:
    bench, commissioning = new_servo()
    bench.loses = lambda request: request.frame[3] == Command.READ_VERSION
    with pytest.raises(DeviceError, match="5 of 10 replies were garbled or missing"):
        bench.run(commissioning.set_id(FACTORY_ID, 5))


def test_neither_id_nor_rate_nor_save_is_sent_twice() -> None:
    bench, commissioning = new_servo(save_reply="required")
    once = (Command.SET_ID, Command.SET_BAUD, Command.SAVE)
    bench.loses = lambda request: request.frame[3] in once
    for plan in (
        commissioning.set_id(FACTORY_ID, 5),
        commissioning.set_baudrate(FACTORY_ID, 9600),
        commissioning.save(FACTORY_ID),
    ):
        with pytest.raises(ReplyTimeout):
            bench.run(plan)
    assert [frame[3] for frame in bench.frames() if frame[3] in once] == list(once)


def test_a_servo_that_says_another_id_afterwards_is_not_saved() -> None:
    bench, commissioning = new_servo()
    bench.devices[0].answers = {Command.READ_ID: b"\x4d"}
    with pytest.raises(DeviceError, match="the servo reports id 77: do not save it"):
        bench.run(commissioning.set_id(FACTORY_ID, 5, save=True))
    assert not any(frame[3] == Command.SAVE for frame in bench.frames())


# Save (KST RS422, 3.3)


def test_save_waits_for_no_answer_and_leaves_the_flash_its_time() -> None:
    bench, commissioning = new_servo(save_settle_ms=300)
    assert bench.run(commissioning.save(FACTORY_ID)) == ()
    (request,) = bench.sent
    assert (request.replies, request.quiet_after) == (0, 0.3)


def test_save_is_the_command_with_a_name() -> None:
    bench, commissioning = new_servo()
    assert bench.run(commissioning.command(FACTORY_ID, "save")) == ()
    assert bench.frames() == [encode(FACTORY_ID, Command.SAVE, b"save")]
    with pytest.raises(UnknownName, match="no command 'factory_reset': there are save"):
        commissioning.command(FACTORY_ID, "factory_reset")
    with pytest.raises(LimitError, match="save takes no value: nothing was sent"):
        commissioning.command(FACTORY_ID, "save", 1)
    assert bench.frames() == []


def test_an_optional_reply_may_be_missing_and_a_refusal_is_a_note() -> None:
    bench, commissioning = new_servo(save_reply="optional")
    assert bench.run(commissioning.save(FACTORY_ID)) == ()
    bench.devices[0].answers_save = True
    assert bench.run(commissioning.save(FACTORY_ID)) == ()
    bench.devices[0].refuses = {Command.SAVE: 0x08000020}
    change = bench.run(commissioning.set_id(FACTORY_ID, 5, save=True))
    assert not change.saved
    assert "save was refused: 0800 0020" in change.notes[0]
    assert not commissioning.pending[FACTORY_ID].saved


def test_a_required_answer_must_come() -> None:
    bench, commissioning = new_servo(save_reply="required")
    assert bench.run(commissioning.save(FACTORY_ID)) == ()
    bench.devices[0].refuses = {Command.SAVE: 0x08000020}
    with pytest.raises(DeviceError, match="0800 0020"):
        bench.run(commissioning.save(FACTORY_ID))


# Where changes take effect at once


def test_an_id_that_counts_at_once_is_read_back_and_saved_there() -> None:
    bench, commissioning = new_servo(id_effective="immediate")
    change = bench.run(commissioning.set_id(FACTORY_ID, 5, save=True))
    assert (change.pending_reboot, change.saved, bench.devices[0].node) == (False, True, 5)
    assert bench.frames()[-2:] == [encode(5, Command.READ_ID), encode(5, Command.SAVE, b"save")]
    assert commissioning.pending == {}


def test_a_rate_that_counts_at_once_is_not_read_back() -> None:
    bench, commissioning = new_servo(id_effective="immediate")
    change = bench.run(commissioning.set_baudrate(FACTORY_ID, 9600))
    assert (change.pending_reboot, bench.devices[0].baudrate) == (False, 9600)
    assert bench.frames()[-1] == encode(FACTORY_ID, Command.SET_BAUD, b"\0")
    bench.baudrate = 9600
    assert bench.exchange(bench.driver.read_register("new", "id")) == FACTORY_ID


def test_another_echo_is_a_mismatch() -> None:
    bench, commissioning = new_servo()
    bench.devices[0].answers = {Command.SET_ID: b"\6"}
    with pytest.raises(EchoMismatch):
        bench.run(commissioning.set_id(FACTORY_ID, 5))
