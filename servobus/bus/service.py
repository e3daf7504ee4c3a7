"""The verbs of one bus: its parts joined together, reading, and what the engine reports.

Refusals happen here, before anything is queued: limits, enable, e-stop, exclusive sessions. Nothing is written at start. A
servo that restarted is disabled, and its goal is not sent again.
"""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine, Mapping, Sequence
from typing import Any, cast

from servobus.bus.commissioning import Sessions
from servobus.bus.discovery import Discovery
from servobus.bus.master import BusMaster
from servobus.bus.motion import Motion
from servobus.bus.records import ServoRecord
from servobus.bus.requests import BusParts, EmitEvent, Requests
from servobus.bus.stops import Stops
from servobus.engine.duplex import DuplexEngine
from servobus.engine.engine import Engine
from servobus.engine.health import FAILING, OFFLINE, ONLINE, Node, NodeTable
from servobus.engine.line import EchoFilter, Line
from servobus.engine.scheduler import Scheduler
from servobus.engine.stats import BusStats, Counter
from servobus.errors import NotSupported, ServobusError
from servobus.protocols.base import Codec, Driver, LineTraits, Request
from servobus.protocols.options import BusOptions, ServoOptions
from servobus.timers import clock_of
from servobus.values import EventName, Health, Loss, State, Update

_UNKNOWN = object()


class BusService:
    """One bus. `emit(name, **fields)` reports what a person or a log should know."""

    def __init__(self, name: str, options: BusOptions, driver: Driver, codec: Codec, traits: LineTraits, emit: EmitEvent) -> None:
        self.name = name
        self.options = options
        self.driver = driver
        self.emit = emit
        self.clock = clock_of(asyncio.get_running_loop())
        self.stats = BusStats(self.clock())
        self.line = Line(traits)
        if options.echo == "on":
            self.line.echo = EchoFilter()
        timeout_s = None if options.timeout_ms is None else options.timeout_ms / 1000
        self.nodes = NodeTable(set(driver.nodes.values()), timeout_s=timeout_s, changed=self._node_changed)
        self.records = {
            servo: ServoRecord(servo, each, self.nodes.node(driver.nodes[servo])) for servo, each in _servos(options).items()
        }
        self.scheduler = self._scheduler()
        self.engine = self._engine(codec)
        self.master = BusMaster(self.engine)
        shared = (self.records, self.nodes, self.scheduler, self.line, self.stats, self.master, self.clock, emit)
        self.parts = BusParts(name, driver, *shared)
        requests = Requests(self.parts)
        self.ask = requests.ask
        self.perform = requests.perform
        self.read_register = requests.read_register
        self.discovery = Discovery(self.parts, requests, self.read)
        self.identify = self.discovery.identify
        self.stops = Stops(self.parts)
        self.motion = Motion(self.parts, requests, self.stops, identify=self.identify, read=self.read)
        sessions = Sessions(self.parts, requests, self.motion)
        self.exclusive = sessions.exclusive
        self.commission = sessions.commission
        self.set_baudrate = sessions.set_baudrate

    def _scheduler(self) -> Scheduler:
        return Scheduler(
            self.driver,
            self.nodes,
            enabled_servos=self._enabled_on,
            on_update=self._polled,
            on_restart=self._restarted,
            on_loss=self._lost,
            blind_stops=self._blind_stops,
            on_cut=self._cut,
            on_setpoint=self._setpoint_sent,
            goal_rate_hz=self.options.rate_of_goals,
        )

    def _engine(self, codec: Codec) -> Engine:
        spread = self.options.spread
        if spread is None:
            return Engine(self.name, codec, self.scheduler, self.line, self.stats)
        return DuplexEngine(self.name, codec, self.scheduler, self.line, self.stats, spread=spread)

    async def start(self) -> None:
        """Wait for silence, identify and read every servo, then poll. Called after the line was opened; writes nothing."""
        if self.options.echo == "auto":
            await self.discovery.probe_echo()
        self.driver.use_traits(self.line.traits)
        await self.discovery.identify_all()
        if self.master.up and self.stops.latched:
            await self.stops.stop()  # it was asked for while the line was down
        if self.master.up:
            self.scheduler.set_polls(self.driver.polls(self.options.poll.rates()), self.clock())

    def use_options(self, options: BusOptions) -> bool:
        """Take the options of a config that was read again, without a pause; return False where the bus must be opened again.

        The line, the ids, the models and the calibration must be the same; rates, limits, speeds and policies may differ.
        """
        if not self.driver.use_options(options):
            return False
        rates_before = self.options.poll.rates()
        self.options = options
        for name, servo in _servos(options).items():
            self.records[name].options = servo
        self.scheduler.goals.ramps.use_rate(options.rate_of_goals)
        if options.poll.rates() != rates_before and self.master.up:
            self.scheduler.set_polls(self.driver.polls(options.poll.rates()), self.clock())
        return True

    # Reading and writing

    async def read(self, servo: str, max_age: float | None = None) -> State:
        """Return the state of a servo: from a fresh turn, or the newest one if it is no older than `max_age` seconds."""
        if max_age is None or not self.is_fresh(servo, max_age):
            self._update(await self.ask(self.driver.read_state(servo), servo=servo))
        return self.state(servo)

    def is_fresh(self, servo: str, max_age: float) -> bool:
        """Return whether the position of a servo was read within `max_age` seconds: some polls bring only other fields."""
        position_at = self.records[servo].position_at
        return position_at is not None and self.clock() - position_at <= max_age

    def state(self, servo: str) -> State:
        """Return the newest state of a servo, without a turn."""
        record = self.records[servo]
        return record.state(self.clock(), self.driver.fault_names(servo, record.node.status))

    async def write_register(self, servo: str, register: str, value: Any, *, raw: bool = False, persist: bool = False) -> Any:
        enabled = [record.name for record in self.parts.on(self.records[servo].node) if record.enabled]
        if persist and enabled:
            message = f"permanent settings are written to disabled servos only: disable {', '.join(enabled)} first"
            raise NotSupported(message, bus=self.name, servo=servo)
        plan = self.driver.write_register(servo, register, value, raw=raw, persist=persist)
        return await self.perform(plan, self.driver.nodes[servo], servo=servo)

    def ping(self, servo: str) -> Coroutine[Any, Any, int | None]:
        return self.ask(self.driver.ping(self.driver.nodes[servo]), servo=servo, even_if_offline=True)

    def snapshot(self) -> dict[str, Any]:
        """Return counters, latencies and the health of each node, for people and machines."""
        counters = {
            Counter.DRAINS: self.line.drains,
            Counter.COLLISIONS: self.line.echo.collisions if self.line.echo else 0,
            Counter.POLLS_MISSED: self.scheduler.polls.missed,
            Counter.GOAL_GROUPS_SPLIT: self.scheduler.goals.split_groups,
            Counter.GOAL_TURNS: self.scheduler.goals.turns,
        }
        nodes = {
            str(node.id): {
                "health": node.shown_health.value,
                **({"reason": node.failing} if node.failing else {}),
                "misses": node.misses,
                "causes": {cause.value: count for cause, count in node.causes.items() if count},
                "deadline_ms": round(1e3 * node.reply_allowance_s, 3),
            }
            for node in self.nodes.by_id.values()
            if node.configured
        }
        stats = self.stats.snapshot(self.clock(), counters)
        return {"up": self.master.up, "waiting": self.scheduler.waiting(), **stats, "nodes": nodes}

    # What the engine reports

    def _enabled_on(self, node: Node) -> list[str]:
        return [record.name for record in self.parts.on(node) if record.enabled]

    def _blind_stops(self, node: Node) -> Sequence[Request[Any]]:
        return self.stops.blind_frames(node)

    def _polled(self, result: dict[str, Update] | Exception) -> None:
        """A poll has ended; one that failed shows in the health of its nodes."""
        if isinstance(result, dict):
            self.stats.counts[Counter.POLLED] += len(result)
            self._update(result)

    def _update(self, result: dict[str, Update]) -> None:
        now, verification = self.clock(), self.scheduler.goals.verification
        for servo, fields in result.items():
            self.records[servo].update(fields, now)
            loss = fields.get("loss", _UNKNOWN)
            if loss is None:
                verification.confirm(servo, now)
            elif loss is not _UNKNOWN and self.records[servo].enabled:
                self._lost(servo, loss)

    def _setpoint_sent(self, servo: str, setpoint: float) -> None:
        self.motion.setpoint_sent(servo, setpoint)

    def _cut(self, servo: str, error: Exception) -> None:
        """A setpoint of the host's ramp failed on the way."""
        self.records[servo].cut = error if isinstance(error, ServobusError) else None
        self.emit(EventName.MOTION_CUT, bus=self.name, servo=servo, reason=str(error))

    def _lost(self, servo: str, loss: Loss) -> None:
        """An enabled servo is not as it was left."""
        record = self.records[servo]
        if loss is Loss.RESTARTED:
            self._restarted(record.node)
        elif self.motion.lost([record], loss):
            self.emit(EventName.TORQUE_LOST, bus=self.name, servo=servo, id=record.node.id)

    def _restarted(self, node: Node) -> None:
        self.stats.counts[Counter.RESTARTS] += 1
        for record in self.motion.lost(self.parts.on(node), Loss.RESTARTED):
            self.emit(EventName.SERVO_RESTARTED, bus=self.name, servo=record.name, id=node.id)
        self.discovery.restarted(node)

    def _node_changed(self, node: Node, before: Health) -> None:
        self.scheduler.node_changed(node)
        if not node.configured:
            return
        if node.health is ONLINE:
            self.stops.node_online(node)
        else:
            self.scheduler.goals.verification.forget(record.name for record in self.parts.on(node))
        shown = node.shown_health
        if OFFLINE in (node.health, before) or FAILING in (shown, before):
            names = ",".join(record.name for record in self.parts.on(node))
            reason = {"reason": node.failing} if shown is FAILING else {}
            self.emit(EventName(f"servo_{shown}"), bus=self.name, servo=names, id=node.id, **reason)
        self.discovery.node_changed(node, before)


def _servos(options: BusOptions) -> Mapping[str, ServoOptions]:
    """Return the options of the servos, which each protocol narrows to its own class."""
    return cast("Mapping[str, ServoOptions]", vars(options)["servos"])
