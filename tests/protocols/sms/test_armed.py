"""A REG WRITE that nobody fired moves nobody later: ACTION waits until its servo reads as not armed (SMS 1.0, 1.3.4, 1.3.5)."""

from __future__ import annotations

from typing import Any

import pytest

from servobus.errors import ActionWithheld, ServobusError
from servobus.protocols.base import Plan
from servobus.protocols.sms.codec import Instruction, Packet, encode
from servobus.protocols.sms.simulated.device import SmsDevice
from servobus.values import Goal, Outcome, ServoGoal, StopTarget
from tests.protocols.sms.bench import Bench
from tests.protocols.sms.single_servo import packet_of
from tests.protocols.sms.states import FAMILIES, travel

GOALS = {"a": 10.0, "b": -10.0}
ACKED = dict.fromkeys(GOALS, Outcome.ACKED)


def bench_of(family: str, **keys: Any) -> Bench:
    return Bench({name: {"id": number, "model": family} for number, name in enumerate("abc", 1)}, **keys)


def arm(device: SmsDevice) -> None:
    """Another program leaves a REG WRITE in the servo that would move it."""
    register = device.model.registers["goal_position"]
    data = bytes((register.address,)) + register.encode(900, device.model.byte_order)
    device.handle(packet_of(encode(device.node, Instruction.REG_WRITE, data)), 0.0)


def torn(bench: Bench, frames: int) -> bool:
    """Close a confirmed plan of a and b after so many frames, as an e-stop does; return whether it was still running."""
    (turn,) = bench.driver.plan_goals(
        [ServoGoal(name, Goal("position", value)) for name, value in GOALS.items()], together=False, confirm=True
    )
    plan: Plan[object] = turn.plan
    try:
        request = next(plan)
        for _ in range(frames):
            request = plan.send(bench.exchange(request))
    except StopIteration:
        return False
    bench.exchange(request)
    plan.close()
    return True


def broadcasts(bench: Bench) -> list[Packet]:
    return [packet for packet in bench.sent if packet.code == Instruction.ACTION and packet.id == 0xFE]


# What an earlier program left


@pytest.mark.parametrize("family", FAMILIES)
def test_a_reg_write_of_an_earlier_program_is_noted_and_nothing_is_written(family: str) -> None:
    bench = bench_of(family)
    arm(bench.devices[3])
    assert "a REG WRITE of an earlier program waits in it" in "; ".join(bench.run(bench.driver.identify("c")).notes)
    assert {packet.code for packet in bench.sent} == {Instruction.READ}
    assert bench.register(3, "async_write_flag") == 1


@pytest.mark.parametrize("family", FAMILIES)
def test_it_withholds_action_and_the_error_says_who_and_how_to_disarm_it(family: str) -> None:
    bench = bench_of(family)
    arm(bench.devices[3])
    bench.run(bench.driver.identify("c"))
    bench.enable("a", "b")
    results = bench.move(GOALS, confirm=True)
    assert all(isinstance(result, ActionWithheld) for result in results.values())
    assert "c holds an older REG WRITE that ACTION would carry out: disable c" in str(results["a"])
    assert not broadcasts(bench)
    assert [bench.register(node, "async_write_flag") for node in (1, 2, 3)] == [0, 0, 1]
    bench.run(bench.driver.disable("c"))
    assert bench.move(GOALS, confirm=True) == ACKED
    assert travel(bench, bench.devices[3]) == 0


@pytest.mark.parametrize("family", FAMILIES)
def test_enable_disarms_it_first(family: str) -> None:
    bench = bench_of(family)
    arm(bench.devices[3])
    bench.enable()
    assert bench.register(3, "async_write_flag") == 0
    assert bench.move(GOALS, confirm=True) == ACKED
    assert travel(bench, bench.devices[3]) == 0


@pytest.mark.parametrize("family", FAMILIES)
def test_a_servo_that_is_not_configured_withholds_action_too(family: str) -> None:
    bench = Bench({name: {"id": number, "model": family} for number, name in enumerate("ab", 1)})
    stranger = SmsDevice(bench.devices[1].model, 9, baudrate=1_000_000)
    bench.devices[9] = stranger
    arm(stranger)
    bench.enable()
    notes = bench.run(bench.driver.inspect(9)).notes
    assert any("a REG WRITE of an earlier program waits in it" in note for note in notes)
    results = bench.move(GOALS, confirm=True)
    assert "id 9 holds an older REG WRITE that ACTION would carry out: switch its power off and on" in str(results["a"])
    stranger.reboot(bench.now)
    bench.now += 100.0
    assert bench.move(GOALS, confirm=True) == ACKED


@pytest.mark.parametrize("together", [True, False])
@pytest.mark.parametrize("family", FAMILIES)
def test_a_servo_that_never_answered_is_not_fired_and_holds_nobody_up(family: str, together: bool) -> None:
    """It hears, does not answer, and an earlier program has armed it: each other servo gets an ACTION of its own."""
    bench = bench_of(family)
    arm(bench.devices[3])
    bench.is_unanswered = lambda packet: packet.id == 3
    bench.enable("a", "b")
    assert bench.move(GOALS, together=together, confirm=True) == ACKED
    assert not broadcasts(bench)
    before = [device.joint.position for device in bench.devices.values()]
    assert travel(bench, bench.devices[3]) == 0
    for device in bench.devices.values():
        device.joint.advance(bench.now)
    assert [device.joint.position != start for device, start in zip(bench.devices.values(), before, strict=True)] == [
        True,
        True,
        False,
    ]


@pytest.mark.parametrize("family", FAMILIES)
def test_an_action_of_its_own_that_is_not_acknowledged_is_an_error_of_that_servo(family: str) -> None:
    bench = bench_of(family)
    bench.enable("a", "b")
    bench.is_unanswered = lambda packet: packet.id == 1 and packet.code == Instruction.ACTION
    results = bench.move(GOALS, confirm=True)
    assert isinstance(results["a"], ServobusError)
    assert results["b"] is Outcome.ACKED


@pytest.mark.parametrize("family", FAMILIES)
def test_the_flag_is_read_again_after_a_doubtful_spell(family: str) -> None:
    bench = bench_of(family)
    bench.enable()
    arm(bench.devices[3])
    assert bench.run(bench.driver.fence(3, [], ["c"]))
    assert "c holds an older REG WRITE" in str(bench.move(GOALS, confirm=True)["a"])


@pytest.mark.parametrize("family", FAMILIES)
def test_a_node_in_doubt_that_does_not_answer_withholds_action(family: str) -> None:
    bench = bench_of(family)
    bench.enable()
    bench.run(bench.driver.fence(3, [], ["c"]))
    bench.devices[3].dead = True
    results = bench.move(GOALS, confirm=True)
    assert "c may hold an older REG WRITE that ACTION would carry out, and does not answer" in str(results["a"])
    assert [bench.register(node, "async_write_flag") for node in (1, 2)] == [0, 0]
    bench.devices[3].dead = False
    assert bench.move(GOALS, confirm=True) == ACKED


@pytest.mark.parametrize("family", FAMILIES)
def test_a_servo_of_another_family_is_disarmed_by_what_all_tables_share(family: str) -> None:
    """The address of the lock differs by family; that of torque does not (FEETECH memory tables, address 40)."""
    bench = bench_of(family)
    arm(bench.devices[3])
    bench.devices[3].pose_as(0, 10, 5)
    bench.run(bench.driver.identify("c"))
    bench.sent.clear()
    bench.run(bench.driver.disable("c"))
    assert bench.register(3, "async_write_flag") == 0
    assert travel(bench, bench.devices[3]) == 0
    assert {packet.params[0] for packet in bench.sent if packet.code in (Instruction.WRITE, Instruction.REG_WRITE)} == {40}


# What we armed ourselves


@pytest.mark.parametrize("how", ["stop", "limp", "disable", "enable", "goal", "other goals"])
@pytest.mark.parametrize("frames", range(3))
@pytest.mark.parametrize("family", FAMILIES)
def test_a_torn_plan_leaves_nothing_armed(family: str, frames: int, how: str) -> None:
    bench = bench_of(family)
    bench.enable()
    places = {node: device.joint.position for node, device in bench.devices.items()}
    assert torn(bench, frames)
    if how in ("stop", "limp"):
        kind = "limp" if how == "limp" else "hold"
        bench.run(bench.driver.stop([StopTarget(name, kind, enabled=True) for name in "abc"]))  # type: ignore[arg-type]
    elif how in ("disable", "enable"):
        for name in GOALS:
            bench.run(getattr(bench.driver, how)(name))
    elif how == "goal":
        for name in GOALS:
            bench.move({name: 0.0})
    if frames < 2 and how != "other goals":
        assert [bench.register(node, "async_write_flag") for node in (1, 2)] == [0, 0]
    if how in ("enable", "goal", "other goals") and frames < 2:
        bench.move({"c": 0.0, "a": 0.0}, confirm=True)
        assert travel(bench, bench.devices[2]) == 0
        assert bench.devices[2].joint.position == places[2]


@pytest.mark.parametrize("family", FAMILIES)
def test_a_stop_disarms_after_everybody_was_stopped(family: str) -> None:
    bench = bench_of(family)
    bench.enable()
    torn(bench, 1)
    bench.sent.clear()
    reports = bench.run(bench.driver.stop([StopTarget(name, "hold", enabled=True) for name in "abc"]))
    assert all(report.confirmed for report in reports.values())
    names = bench.instructions()
    assert names.index("REG_WRITE") > max(number for number, name in enumerate(names) if name == "SYNC_WRITE")


@pytest.mark.parametrize("family", FAMILIES)
def test_an_action_that_got_lost_fires_nobody_later(family: str) -> None:
    """ACTION to all has no reply, so who was to obey it is read before the next one."""
    bench = bench_of(family)
    bench.enable()
    bench.is_lost = lambda packet: packet.code == Instruction.ACTION
    bench.move(GOALS, confirm=True)
    assert bench.register(2, "async_write_flag") == 1
    bench.is_lost = lambda packet: False
    bench.move({"a": 1.0, "c": 1.0}, confirm=True)
    assert travel(bench, bench.devices[2]) == 0
    assert bench.register(2, "async_write_flag") == 0


@pytest.mark.parametrize("family", FAMILIES)
def test_the_end_of_a_program_disarms_whom_a_lost_action_left_armed(family: str) -> None:
    bench = bench_of(family)
    bench.enable()
    bench.is_lost = lambda packet: packet.code == Instruction.ACTION and packet.id == 0xFE
    bench.move(GOALS, confirm=True)
    bench.run(bench.driver.stop([StopTarget(name, "hold", enabled=True) for name in "abc"]))
    assert [bench.register(node, "async_write_flag") for node in (1, 2)] == [0, 0]


@pytest.mark.parametrize("status_return", ["all", "read_only"])
@pytest.mark.parametrize("family", FAMILIES)
def test_disarming_moves_nobody_even_where_its_write_gets_lost(family: str, status_return: str) -> None:
    bench = bench_of(family, status_return=status_return)
    bench.enable()
    torn(bench, 1)
    lock = bench.devices[1].model.registers["lock"].address
    lost = [True] * 2

    def write_lost(packet: Packet) -> bool:
        return packet.code == Instruction.REG_WRITE and packet.params[0] == lock and bool(lost) and lost.pop()

    bench.is_lost = write_lost
    for name in GOALS:
        try:
            bench.run(bench.driver.disable(name))
        except ServobusError:
            assert status_return == "all"
    assert all(travel(bench, bench.devices[node]) == 0 for node in (1, 2))


@pytest.mark.parametrize("family", FAMILIES)
def test_a_plain_confirmed_move_asks_nobody_else(family: str) -> None:
    bench = bench_of(family)
    bench.enable()
    assert bench.move(GOALS, confirm=True) == ACKED
    assert bench.instructions() == ["REG_WRITE", "REG_WRITE", "ACTION"]
