"""Ages wherever a stamp is used, among computers whose wall clocks differ by up to 20 s, are set in flight, and drift.

camera -> localizer -> fusion -> robot, station, page; all into a log, and from it into replay and report. The programs' own
nodes run on simulated computers (computers.py), which alone know true time. An age may be wrong by 5 ms.
"""

import time
from collections import defaultdict
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from groundstation.logs.reader import DecodedMessage, key_topic, open_log, read_log, valid_messages
from groundstation.logs.recorder import Recorder, run_metadata
from groundstation.station.process import record_everything
from groundstation.telemetry import LinkMonitor
from groundstation.web.live_backend import LiveBackend
from groundstation.web.replay_backend import ReplayBackend
from localizer import fusion_node, node
from localizer.camera_model import RefractiveCamera
from localizer.fusion_node import FusionNode
from localizer.node import LocalizerNode
from localizer.sources import bus as bus_source
from localizer.tracking.fleet_localizer import LocalizationResult
from robot_agent.node import AgentNode, StepTime
from shoal.bus.bus import Bus
from shoal.bus.delay_estimator import WINDOW_NS, WINDOWS
from shoal.config.experiment import Experiment, dump_experiment, load_experiment
from shoal.messages import topics
from shoal.messages.codec import Header
from shoal.messages.messages import (
    CameraHealth,
    Event,
    Frame,
    LocalizerStatus,
    Mode,
    Obstacles,
    Plan,
    Pose,
    RobotState,
    StationHeartbeat,
    Track,
    required,
)
from shoal.messages.topics import Topic
from shoal.runtime.runtime import Stop, WallClock
from sim_bridge.replay.step_replay import own_messages
from tests.closed_loop.computers import MS, ClockedComputer, NetworkLine, S, TimedWorld
from tests.groundstation.fake_station import FakeStation
from tests.robot_agent.obedient_board import Board

SETTINGS = ["localizer.preview_rate_hz=0", "recording.video=none", "safety.watch_thrusters=false"]
EXPERIMENT = load_experiment("two-cameras", SETTINGS)
pytestmark = pytest.mark.long
ALLOWED_MS = 5.0
STEP_NS = 8 * MS  # of a robot's computing
PERIOD_NS = 50 * MS
ROUND = 0.1 * np.array([[np.cos(a), np.sin(a)] for a in np.arange(12) * np.pi / 6.0])
SHOWN = Pose(0.1, 0.0, 0.0, 1e-6 * np.eye(3), Track.MARKER, True)
SEEN = Obstacles((3,), ROUND[None], np.zeros((1, 2)), unseen_s=np.zeros(1))


class TimelessLocator:
    """In place of the picture's contents, which have no time in them."""

    def __init__(self, experiment: Experiment, sees_all: bool) -> None:
        self._view = RefractiveCamera(experiment.camera)

    def locate(self, *_: Any) -> LocalizationResult:
        return LocalizationResult(((1, SHOWN), (2, SHOWN)), LocalizerStatus(CameraHealth.OK), self._view)

    def finish(self) -> None: ...


class TimelessDetector:
    """In place of the search for obstacles."""

    def step(self, *_: Any) -> Obstacles:
        return SEEN


@dataclass
class AgeErrors:
    """Worst error of an age, in ms, by what shows it; and how many there were."""

    worst_ms: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    count: dict[str, int] = field(default_factory=lambda: defaultdict(int))

    def note(self, what: str, error_ns: float) -> None:
        self.count[what] += 1
        if abs(error_ns) * 1e-6 > abs(self.worst_ms[what]):
            self.worst_ms[what] = error_ns * 1e-6


class ClockedFleet:
    """Two cameras with their localizers, the fusion, a robot, another one, the station with its page and its log."""

    def __init__(self, world: TimedWorld, run: Path) -> None:
        self.world, self.run, self.stop, self.errors = world, run, Stop(install=False), AgeErrors()
        self.clocks, self.set_ns, self.buses = dict[str, WallClock](), dict[str, int](), dict[str, Bus]()
        self.ended, self.locators = list[Generator[None]](), dict[str, Generator[None]]()
        self.headers = dict[str, Header | None]()
        self.fused_ns = -1
        for camera in EXPERIMENT.camera_names:
            self.start_camera(camera)
            self.start_localizer(camera)
        self.start("fusion")
        self.fusion = FusionNode(EXPERIMENT, self.buses["fusion"], self.stop, self.clocks["fusion"])
        with self.world.on("fusion"):
            self.fusing = self.fusion.steps()
            next(self.fusing)
            next(self.fusing)
        self.start_robot()
        for name in ("robot 2", "station", "orders"):
            self.start(name)
        bus, clock = self.buses["station"], self.clocks["station"]
        with self.world.on("station"):
            self.station = FakeStation(EXPERIMENT, bus, clock=clock)
            self.page = LiveBackend(EXPERIMENT, {}, bus, self.station.inboxes, clock, self.station, "real-time")
            self.recorder = Recorder(run / "run.mcap", dump_experiment(EXPERIMENT), run_metadata(EXPERIMENT, "real-time"))
            self.sources: Any = ()
            record_everything(bus, self, clock)  # type: ignore[arg-type]
        (run / "experiment.toml").write_text(dump_experiment(EXPERIMENT))
        self.links = {1: LinkMonitor(), 2: LinkMonitor()}

    def gather(self, sources: Any, arrival_ns: Callable[[Header], int]) -> None:
        """As Recorder.gather, but in this thread, whose time is simulated."""
        self.sources, self.arrival_ns = sources, arrival_ns

    def start(self, name: str) -> Bus:
        """Start a process on the computer of its name, or start it again."""
        if name in self.buses:
            self.buses[name].close()
        with self.world.on(name) as computer:
            self.clocks[name], self.buses[name] = WallClock(), Bus(NetworkLine(self.world, name))
            self.set_ns[name] = computer.set_ns
        return self.buses[name]

    def start_camera(self, camera: str) -> None:
        self.start(f"camera {camera}")

    def start_localizer(self, camera: str) -> None:
        name = f"localizer {camera}"
        self.start(name)
        self.ended += [self.locators[camera]] if camera in self.locators else []
        with self.world.on(name):
            shell = LocalizerNode(EXPERIMENT, self.buses[name], self.stop, self.clocks[name], camera=camera)
            self.locators[camera] = shell.steps()
            next(self.locators[camera])
            next(self.locators[camera])  # it says that there is no picture yet
            self.headers[name] = self.world.computers[name].newest.get(f"shoal/{topics.FRAME.of_camera(camera).key()}")

    def start_robot(self) -> None:
        bus = self.start("robot 1")
        with self.world.on("robot 1"):
            self.robot = AgentNode(EXPERIMENT, 1, bus, Board(), self.stop)

    def close(self) -> None:
        """End everything, by real time."""
        self.stop.request()
        for steps in (self.fusing, *self.locators.values(), *self.ended):
            steps.close()
        self.recorder.close()

    # --- what happens

    def expose(self, camera: str) -> None:
        """A camera takes a picture and sends it 12 ms later."""
        name, exposed_ns = f"camera {camera}", self.world.true_ns
        self.world.run_until(exposed_ns + 12 * MS)
        with self.world.on(name):
            clock = self.clocks[name]
            stamp_ns = clock.now_ns() - 12 * MS
            self.publish(
                exposed_ns, name, topics.FRAME.of_camera(camera), Frame(np.zeros((4, 4), np.uint8)), stamp_ns, age_ns=12 * MS
            )

    def publish(self, about_ns: int | None, name: str, *message: Any, **options: Any) -> None:
        self.world.about_ns = about_ns
        self.buses[name].publish(*message, **options)
        self.world.about_ns = None

    def locate(self, camera: str) -> None:
        """The localizer takes a picture that has come, and needs 20 ms for it."""
        name, world = f"localizer {camera}", self.world
        key = f"shoal/{topics.FRAME.of_camera(camera).key()}"
        newest = world.computers[name].newest.get(key)
        if newest is None or newest is self.headers[name]:
            return
        self.headers[name] = newest
        world.about_ns = world.truth_of(key, newest)
        with world.on(name):
            next(self.locators[camera])
        world.about_ns = None

    def fuse(self) -> None:
        """The fusion takes what has come."""
        world, computer = self.world, self.world.computers["fusion"]

        def new(topic: Topic) -> list[int]:
            """The instants of pictures that cameras have told of since the last look."""
            keys = [f"shoal/{topic.of_camera(camera).key()}" for camera in EXPERIMENT.camera_names]
            news = {key: head for key in keys if (head := computer.newest.get(key)) is not self.headers.get(key) and head}
            self.headers |= news
            return [world.truth_of(key, header) for key, header in news.items()]

        if not any(
            computer.newest.get(key) is not self.headers.get(key)
            for key in (f"shoal/{topics.LOCALIZER.of_camera(camera).key()}" for camera in EXPERIMENT.camera_names)
        ):
            return
        self.fused_ns = world.about_ns = max(self.fused_ns, *new(topics.LOCALIZER))
        world.obstacles_ns = max(new(topics.OBSTACLES), default=None)
        with world.on("fusion"):
            next(self.fusing)
        world.about_ns = world.obstacles_ns = None

    def step_robot(self) -> None:
        world, robot, clock = self.world, self.robot, self.clocks["robot 1"]
        with world.on("robot 1") as computer:
            now_ns, started_ns = clock.now_ns(), time.perf_counter_ns()
            record, outputs = robot.step(now_ns, StepTime(now_ns))
            world.about_ns = begun_ns = world.true_ns
            world.true_ns += STEP_NS
            robot.write(outputs, now_ns, now_ns, started_ns)
            world.about_ns, world.true_ns = None, begun_ns
            self.publish(None, "robot 1", topics.INPUTS, record, now_ns, 1)

        def check(what: str, key: str, instant_ns: int) -> None:
            header = computer.newest.get(f"shoal/{key}")
            if header is not None and instant_ns:
                told_ns = computer.true_ns(instant_ns, self.set_ns["robot 1"])
                self.errors.note(f"robot: {what}", told_ns - world.truth_of(f"shoal/{key}", header))

        check("pose", topics.POSE.key(1), record.pose_instant_ns)
        check("station", topics.HEARTBEAT.key(), record.station_instant_ns)
        check("obstacles", topics.OBSTACLES.key(), record.obstacles_instant_ns)
        check("plan", topics.PLAN.key(2), next(iter(record.plan_instants_ns), 0))
        if record.pose is not None:
            check(
                "age of the pose that it tells",
                topics.POSE.key(1),
                now_ns - round(required(outputs.state.timing.pose_age_ms) * 1e6),
            )

    def other(self) -> None:
        with self.world.on("robot 2"):
            now_ns = self.clocks["robot 2"].now_ns()
            self.publish(None, "robot 2", topics.PLAN, Plan(0.05, np.zeros((50, 4)), np.zeros((50, 4))), now_ns, 2)
            self.publish(None, "robot 2", topics.STATE, RobotState(), now_ns, 2)
            self.publish(None, "robot 2", topics.EVENT, Event(2, "agent-2", f"{self.world.true_ns}"), now_ns)

    def beat(self) -> None:
        with self.world.on("orders"):
            self.publish(None, "orders", topics.HEARTBEAT, StationHeartbeat(), self.clocks["orders"].now_ns())

    def record(self) -> None:
        with self.world.on("station"):
            for source in self.sources:
                for topic, key, header, payload in source():
                    self.recorder.put(topic, key, header, payload, self.arrival_ns(header))

    # --- what is shown

    def look(self) -> None:
        """Compare the ages that station and page show now."""
        world = self.world
        with world.on("station") as computer:
            views = {robot: self.station.inboxes.view(robot, self.links[robot], self.clocks["station"]) for robot in (1, 2)}
            snapshot, notes = self.page.snapshot(), self.page.notes()

        def check(what: str, key: str, age_ns: float) -> None:
            header = computer.newest.get(f"shoal/{key}")
            if header is not None:
                self.errors.note(what, world.true_ns - age_ns - world.truth_of(f"shoal/{key}", header))

        for robot, view in views.items():
            check("station: state", topics.STATE.key(robot), view.state_age_s * 1e9)
            check("station: pose", topics.POSE.key(robot), view.pose_age_s * 1e9)
            check("station: plan", topics.PLAN.key(robot), view.plan_age_s * 1e9)
        for news in snapshot["robots"]:
            check("page: state", topics.STATE.key(news["id"]), news["age_ms"] * 1e6)
            for what, topic in (("pose", topics.POSE), ("plan", topics.PLAN)):
                if what in news:
                    check(f"page: {what}", topic.key(news["id"]), news[what]["age_ms"] * 1e6)
        for what, topic in (("localizer", topics.LOCALIZER), ("obstacles", topics.OBSTACLES)):
            if snapshot[what] is not None:
                check(f"page: {what}", topic.key(), snapshot[what]["age_ms"] * 1e6)
        for note in notes:
            if note["source"] == "agent-2":
                at_ns = computer.true_ns(round(note["time_s"] * 1e9), self.set_ns["station"])
                way_ns = at_ns - int(note["text"])  # it is the arrival
                self.errors.note("page: time of a line of the log", 0 if 0 <= way_ns <= 700 * MS else way_ns)

    def read_back(self) -> None:
        """The log as reports and reruns read it: on the recorder's clock, in the order in which it was."""
        log, truth = read_log(self.run / "run.mcap"), self.world.truth
        stamps = ((key_topic(key), session, sequence, ns) for (key, session, sequence), ns in truth.items())
        instants_ns = {(*of, session, sequence): ns for of, session, sequence, ns in stamps if of is not None}
        station, set_ns = self.world.computers["station"], self.set_ns["station"]
        for topic, robot in ((topics.STATE, 1), (topics.STATE, 2), (topics.POSE, 1), (topics.HEARTBEAT, 0)):
            entries: list[DecodedMessage[Any]] = log.of(topic, topic.type, robot)
            for entry in entries:
                error_ns = station.true_ns(entry.stamp_ns, set_ns) - instants_ns[topic, robot, entry.session, entry.sequence]
                self.errors.note(f"log: {topic.name}", error_ns)
        with open_log(self.run) as file:
            own = [(x.topic, x.robot, x.header.session, x.header.sequence) for x in own_messages(file, 1, with_states=True)]
        instants = [instants_ns[name] for name in own]
        assert instants == sorted(instants) and len({session for _, _, session, _ in own}) == 2

    def look_back(self, at_s: Sequence[float]) -> None:
        """Compare the ages that a replay of the log shows, once all is closed."""
        computer, key_of = self.world.computers["station"], dict[tuple[Topic, int, int, int], str]()
        for key, session, sequence in self.world.truth:
            parts = key_topic(key)
            if parts is not None:
                key_of[*parts, session, sequence] = key
        lines = list(valid_messages(self.run / "run.mcap"))
        with ReplayBackend(self.run) as replay:
            for when_s in at_s:
                log_ns = min(line.arrived_ns for line in lines) + round(when_s * 1e9)
                true_ns = computer.true_ns(log_ns, self.set_ns["station"])
                replay.seek(when_s, 0.0)
                snapshot = replay.snapshot()

                def check(
                    what: str, topic: Topic, age_ms: float, robot: int = 0, now_ns: float = true_ns, at_ns: int = log_ns
                ) -> None:
                    entries = [x for x in lines if x.topic is topic and x.robot == robot and x.arrived_ns <= at_ns]
                    session = entries[-1].header.session  # by the file's order, which is that of arrival
                    sequence = max(x.header.sequence for x in entries if x.header.session == session)
                    truth_ns = self.world.truth[key_of[topic, robot, session, sequence], session, sequence]
                    self.errors.note(f"replay: {what}", now_ns - age_ms * 1e6 - truth_ns)

                for news in snapshot["robots"]:
                    check("state", topics.STATE, news["age_ms"], news["id"])
                    check("pose", topics.POSE, news["pose"]["age_ms"], news["id"])
                    check("plan", topics.PLAN, news["plan"]["age_ms"], news["id"])
                check("localizer", topics.LOCALIZER, snapshot["localizer"]["age_ms"])
                check("obstacles", topics.OBSTACLES, snapshot["obstacles"]["age_ms"])

    def fly(self, until_s: float) -> None:
        """Go on until then, in steps of a period. The cameras expose 25 ms apart, and not quite regularly."""
        world = self.world
        while world.true_ns < until_s * S:
            begin_ns = world.true_ns // PERIOD_NS * PERIOD_NS
            for at_ns, do in self._schedule(begin_ns):
                world.run_until(max(at_ns, world.true_ns))
                do()
            world.run_until(begin_ns + PERIOD_NS)

    def _schedule(self, begin_ns: int) -> list[tuple[int, Callable[[], None]]]:
        jitter_ns = self.world.random.randrange(3 * MS)
        done: list[tuple[int, Callable[[], None]]] = [
            (begin_ns + jitter_ns, lambda: self.expose("west")),
            (begin_ns + 25 * MS + jitter_ns, lambda: self.expose("east")),
            (begin_ns + 36 * MS, self.step_robot), (begin_ns + 7 * MS, self.other), (begin_ns + 1 * MS, self.beat),
        ]  # fmt: skip
        for k in range(5):
            done.append((begin_ns + (k * 10 + self.world.random.randrange(10)) * MS, self.record))
            done += [(begin_ns + k * 10 * MS + 5 * MS, partial(self.locate, c)) for c in EXPERIMENT.camera_names]
        done += [(begin_ns + k * 5 * MS + 4 * MS, self.fuse) for k in range(10)]
        if begin_ns % (3 * PERIOD_NS) == 0:
            done.append((begin_ns + 44 * MS, self.look))
        return sorted(done, key=lambda entry: entry[0])


def is_ready(bus: Bus, stop: Stop, ready: Callable[[], bool], timeout_s: float) -> bool:
    """In place of a wait by real time."""
    return ready()


def computers(drift: float) -> dict[str, ClockedComputer]:
    """Clocks from 20 s behind to 20 s ahead; each drifts against the next."""
    names = [f"{what} {camera}" for camera in EXPERIMENT.camera_names for what in ("camera", "localizer")]
    names += ["fusion", "robot 1", "robot 2", "station", "orders"]
    ahead_s = np.linspace(-20.0, 20.0, len(names))[np.random.default_rng(1).permutation(len(names))]
    return {name: ClockedComputer(ahead_s[k], drift * (-1) ** k, (k + 1) * 1000 * S) for k, name in enumerate(names)}


@pytest.mark.parametrize(("set_s", "drift"), [(5.0, 1e-4), (-5.0, -1e-4)])
def test_ages(set_s: float, drift: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(node, "FleetLocalizer", TimelessLocator)
    monkeypatch.setattr(node, "_make_obstacle_detector", lambda _: TimelessDetector())
    for module in (fusion_node, bus_source):
        monkeypatch.setattr(module, "wait", is_ready)
    world = TimedWorld(monkeypatch)
    world.computers |= computers(drift)
    fleet = ClockedFleet(world, tmp_path)
    fleet.fly(3.0)
    world.held = {"robot 1": world.true_ns + 600 * MS, "station": world.true_ns + 400 * MS, "fusion": world.true_ns + 300 * MS}
    fleet.fly(6.0)
    for k, computer in enumerate(world.computers.values()):
        computer.set_ns = round(set_s * S) * (-1) ** (k // 2)
    fleet.fly(7.0)
    fleet.start_camera("west")
    fleet.start_localizer("east")
    fleet.start_robot()
    for name in ("robot 2", "orders"):
        fleet.start(name)
    fleet.fly(10.0)
    world.held = {"robot 1": world.true_ns + 600 * MS, "station": world.true_ns + 400 * MS, "fusion": world.true_ns + 300 * MS}
    fleet.fly(14.0)
    world.slow = {"robot 1": 150 * MS, "station": 250 * MS, "fusion": 60 * MS, "localizer west": 30 * MS}
    fleet.fly(16.5)
    world.slow = {}
    fleet.fly(19.0)
    fleet.close()
    fleet.look_back([2.0, 3.1, 3.3, 5.02, 6.5, 8.01, 12.0, 14.5, 16.0, 18.5])
    fleet.read_back()
    wrong = {what: ms for what, ms in fleet.errors.worst_ms.items() if abs(ms) > ALLOWED_MS}
    assert not wrong and len(fleet.errors.count) == 22, dict(fleet.errors.worst_ms)


@pytest.mark.parametrize("set_s", [5.0, -5.0, 20.0, -20.0])
def test_a_robot_stops_where_it_cannot_know_an_age(set_s: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Poses of a stranger's program, whose stamps follow its wall clock when that is set. Set back, they look late."""
    world = TimedWorld(monkeypatch)
    world.computers = {name: ClockedComputer(0.0, 0.0, S) for name in ("eyes", "robot")}
    with world.on("eyes"):
        eyes = Bus(NetworkLine(world, "eyes"))
    with world.on("robot"):
        robot = AgentNode(EXPERIMENT, 1, Bus(NetworkLine(world, "robot")), Board(), Stop(install=False))
    robot.agent.mode = Mode.HOLDING
    stopped, unknown = False, 0
    for k in range(600):
        world.run_until(k * PERIOD_NS)
        world.computers["eyes"].set_ns = round(set_s * S) * (k >= 100)
        with world.on("eyes"):
            eyes.publish(topics.POSE, SHOWN, time.time_ns(), 1)
            eyes.publish(topics.HEARTBEAT, StationHeartbeat(), time.monotonic_ns())
        world.run_until(k * PERIOD_NS + 2 * MS)
        with world.on("robot"):
            record, outputs = robot.step(robot.clock.now_ns(), StepTime(0))
            robot.write(outputs, robot.clock.now_ns(), robot.clock.now_ns(), time.perf_counter_ns())
            age_ns = robot.clock.now_ns() - record.pose_instant_ns
        stopped = stopped or "pose" in outputs.state.fault
        if abs(age_ns - 2 * MS) > ALLOWED_MS * MS:
            unknown += 1
            assert stopped and outputs.state.mode is Mode.FAULT and age_ns > 0
    assert stopped == (set_s < 0.0)
    assert unknown * PERIOD_NS <= WINDOWS * WINDOW_NS
