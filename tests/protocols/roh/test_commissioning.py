"""Commands that restart, re-address or recalibrate a hand are sent once."""

from __future__ import annotations

import pytest

from servobus.errors import DeviceError, LimitError, NotSupported, ReplyTimeout, UnknownName
from servobus.protocols.roh.simulated.device import RohDevice
from servobus.values import Change
from tests.protocols.roh.bench import Bench

ALL = pytest.mark.parametrize("name", ["legacy", "v1", "v2"])


# Commissioning


def twin() -> Bench:
    bench = Bench()
    bench.run(bench.driver.identify("index"))
    bench.frames()
    return bench


@pytest.mark.parametrize("answers", [True, False])
def test_a_new_unit_is_saved_and_read_back(answers: bool) -> None:
    bench = twin()
    bench.hand.answers_restart = answers
    assert bench.run(bench.driver.commissioning.set_id(2, 7)) == Change(2, "id", 7, saved=True, pending_reboot=False)
    assert bench.hand.node == 7
    frames = bench.frames()
    assert frames[0] == "unit 7 READ 1000"
    assert frames.count("unit 2 WRITE 1005 = 7") == 1
    assert set(frames[-1:]) == {"unit 7 READ 1005"}


def test_a_unit_that_is_taken_or_that_cannot_be_is_refused() -> None:
    bench = twin()
    bench.devices.append(RohDevice(bench.models["v1"], 7))
    with pytest.raises(DeviceError, match="unit 7 answers already"):
        bench.run(bench.driver.commissioning.set_id(2, 7))
    for new in (0, 2, 248):
        with pytest.raises(LimitError, match="nothing was sent"):
            bench.driver.commissioning.set_id(2, new)
    for new in (1, 247):
        assert bench.run(bench.driver.commissioning.set_id(bench.hand.node, new)).value == new


def test_who_answers_at_the_new_unit_must_be_it() -> None:
    bench = twin()
    plan = bench.driver.commissioning.set_id(2, 7)
    next(plan)
    plan.throw(ReplyTimeout("nobody"))
    plan.send(None)
    with pytest.raises(DeviceError, match="the hand at unit 7 reports unit 3"):
        plan.send(3)


def test_commands_are_sent_once() -> None:
    bench = twin()
    do = bench.driver.commissioning.command
    for plan, address in ((do(2, "zero_force"), 1016), (do(2, "power_off"), 1015), (do(2, "restart"), 1014)):
        bench.after(9)
        bench.run(plan)
        assert [frame for frame in bench.frames() if "WRITE" in frame] == [
            f"unit 2 WRITE {address} = {0 if address == 1014 else 1}"
        ]
    bench.after(9).run(do(2, "recalibrate", bench.hand.key))
    assert bench.hand.state == "calibration"
    with pytest.raises(DeviceError, match="it does not take that value"):
        bench.run(do(2, "recalibrate", 1))
    for key in (-1, 65536, None):
        with pytest.raises(LimitError, match="needs a value of 0 to 65535"):
            do(2, "recalibrate", key)
    bench.hand.state = "wait"
    bench.run(do(2, "start_init"))
    assert bench.hand.state == "init"
    bench.after(9)
    bench.loses = lambda request: request.frame[1] == 16
    bench.frames()
    with pytest.raises(ReplyTimeout):
        bench.run(do(2, "zero_force"))
    assert len(bench.frames()) == 1


def test_commands_nobody_knows_or_with_a_value_too_many() -> None:
    do = twin().driver.commissioning
    with pytest.raises(UnknownName, match=r"there are restart \(restarts it, in work mode\), "):
        do.command(2, "dance")
    with pytest.raises(LimitError, match="takes no value"):
        do.command(2, "restart", 1)
    with pytest.raises(NotSupported, match="no register for its baud rate"):
        do.set_baudrate(2, 9600)


def test_firmware_update_ends_the_talk() -> None:
    bench = twin()
    bench.hand.answers_restart = False
    bench.run(bench.driver.commissioning.command(2, "firmware_update"))
    with pytest.raises(ReplyTimeout):
        bench.exchange(bench.driver.ping(2))


def test_a_command_needs_a_map_with_its_register() -> None:
    bench = Bench(maps={2: "legacy"})
    with pytest.raises(NotSupported, match="map legacy has no register reset"):
        bench.run(bench.driver.commissioning.command(2, "restart"))
    bench = Bench({}, maps={})
    bench.devices = twin().devices
    bench.run(bench.driver.commissioning.command(2, "zero_force"))
    assert bench.hand.written == [(1016, 1)]
