"""The operator's page in Chromium with software rendering: how late it draws, how often it can, what it costs.

The robots speak on a real bus from a process of their own (each 20 states, poses and plans of 50 nodes a second; 5 pictures);
this process is the station's side of the page. Latency runs from the server's stamp to the begin of the frame after the one
that was drawn: the drawing has then been put on the screen.
"""

import gzip
import math
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from select import select

import cv2
import numpy as np
import psutil
from playwright.sync_api import Page, sync_playwright

from benchmarks.harness import Row
from groundstation.mission.state_machine import MissionState
from groundstation.planning import planner
from groundstation.planning.feasibility import PlanError
from groundstation.planning.segment import PlanSegment
from groundstation.telemetry import LinkMonitor, subscribe_fleet
from groundstation.web.backend import ALWAYS, Status, Validity
from groundstation.web.live_backend import LiveBackend
from groundstation.web.server import STATIC, WebServer
from shoal.bus.bus import Bus
from shoal.bus.endpoint import Endpoint
from shoal.bus.zenoh_transport import ZenohTransport
from shoal.config.experiment import Experiment, load_experiment
from shoal.frames import Array
from shoal.messages import topics
from shoal.messages.codec import Header, encode
from shoal.messages.messages import (
    BoardReading,
    CameraHealth,
    CommandKind,
    Control,
    DriveVelocity,
    Estimate,
    LocalizerStatus,
    Message,
    Mode,
    Plan,
    Pose,
    Preview,
    RobotState,
    Solve,
    StepTiming,
    Track,
    required,
)
from shoal.messages.topics import Topic
from shoal.runtime.cli_options import DEFAULT_FLEET
from shoal.runtime.runtime import WallClock
from shoal.runtime.web_access import WebOptions
from sim_bridge.sil.ports import free_port

ROBOTS = 49  # as many as there are markers
NODES = 50
PERIOD_S = 0.05
ROUND = 100  # control periods, then it begins again
PICTURE_EVERY = 4  # states: 5 a second
SETTLE_S = 5.0
MEASURE_S = 30.0
FLAGS = ["--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking", "--disable-sync"]

STATE = RobotState(
    mode=Mode.TRACKING,
    pulse_us=(1600, 1580, 1420, 1450, 1500, 1500, 1500, 1500),
    track=Track.MARKER,
    control=Control(wrench=np.array([3.0, 0.1, 0.2]), solve=Solve.SOLVED),
    estimate=Estimate(disturbance=np.array([0.02, 0.01, 0.0, 0.0])),
    timing=StepTiming(pose_age_ms=30.0, step_us=900.0),
    board=BoardReading(armed=True, battery_v=12.2),
)

# Frames drawn, and for each new state and picture the ms from its stamp to the frame after.
PROBE = """
window.measured = {frames: 0, state: [], picture: []};
let seen = [0, 0];
window.shoal = {
  ready(drawSoon) { window.drawSoon = drawSoon; },
  drawn(state, picture) {
    measured.frames += 1;
    const fresh = [state !== seen[0] && state > 0, picture !== seen[1] && picture > 0];
    seen = [state, picture];
    requestAnimationFrame(() => {
      const now = performance.timeOrigin + performance.now();
      if (fresh[0]) measured.state.push(now - state);
      if (fresh[1]) measured.picture.push(now - picture);
    });
  },
};
"""


def fleet(robots: int) -> Experiment:
    """A grid of robots on a small circle, each listening to the one before it."""
    rows = []
    side = math.ceil(math.sqrt(robots))
    for k in range(robots):
        node = [float(k % side) - side / 2, float(k // side) - side / 2, 0.0]
        rows.append({"id": k + 1, "node_m": node, "neighbours": [k] if k else []})
    size = side + 2.0
    return load_experiment(
        "pool", ["limits={}", f"robots={rows}".replace("'", '"').replace(": ", "="), f"pool.size_m=[{size},{size},1.0]"]
    )


def _state(near: Array, eta: Array, trajectory_s: float) -> RobotState:
    """A state of a robot near its reference, (4,) each."""
    estimate = replace(required(STATE.estimate), eta=near)
    control = replace(required(STATE.control), eta_reference=eta)
    return replace(STATE, estimate=estimate, control=control, trajectory_s=trajectory_s)


def _round(robots: int) -> list[list[tuple[str, Topic, bytes]]]:
    """The messages of a fleet in ROUND control periods, encoded: in a pool fifty boards do that, not one process."""
    trajectories = planner.plan(fleet(robots))
    rounds = []
    for step in range(ROUND):
        batch: list[tuple[str, Topic, bytes]] = []
        for robot, trajectory in trajectories.items():
            eta = trajectory.eta[step]
            near = eta + 0.01 * np.sin(0.1 * step + robot)
            messages: list[tuple[Topic, Message]] = [
                (topics.STATE, _state(near, eta, step * PERIOD_S)),
                (topics.POSE, Pose(near[0], near[1], near[3], 1e-5 * np.eye(3), Track.MARKER, True)),
                (topics.PLAN, Plan(PERIOD_S, trajectory.eta[step:][:NODES])),
            ]
            batch += [(topic.key(robot), topic, encode(message)) for topic, message in messages]
        batch.append((topics.LOCALIZER.name, topics.LOCALIZER, encode(LocalizerStatus(CameraHealth.OK, frame_age_ms=9.0))))
        rounds.append(batch)
    return rounds


def _publish(address: str, robots: int) -> None:
    """The fleet's process: ends with its standard input."""
    picture = cv2.GaussianBlur(np.random.default_rng(1).integers(0, 255, (480, 640, 3), np.uint8), (0, 0), 3)
    jpeg = encode(Preview(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 70])[1].tobytes()))
    rounds = _round(robots)
    with closing(ZenohTransport(Endpoint(address))) as transport:
        put = {key: transport.publisher(f"{DEFAULT_FLEET}/{key}", topic.qos) for key, topic, _ in rounds[0]}
        show = transport.publisher(f"{DEFAULT_FLEET}/{topics.PREVIEW.name}", topics.PREVIEW.qos)
        due, step = time.monotonic(), 0
        while not select([sys.stdin], [], [], max(due - time.monotonic(), 0.0))[0]:
            step += 1
            header = Header(1, step, time.time_ns()).encode()
            for key, _, payload in rounds[step % ROUND]:
                put[key](payload, header)
            if step % PICTURE_EVERY == 0:
                show(jpeg, header)
            due = max(due + PERIOD_S, time.monotonic())


class _Station:
    """A station whose mission runs, seen afresh for each picture of it."""

    paths = None

    def __init__(self, experiment: Experiment, bus: Bus) -> None:
        self.experiment = experiment
        self.fleet, self.clock = subscribe_fleet(bus, experiment.robot_ids), WallClock()

    def status(self) -> Status:
        views = {robot: self.fleet.view(robot, LinkMonitor(), self.clock) for robot in self.fleet.states}
        return Status(state=MissionState.RUNNING, views=views)

    def request(
        self,
        order: CommandKind,
        via: Sequence[tuple[float, float]] = (),
        only: int = 0,
        text: str = "",
        valid: Validity = ALWAYS,
    ) -> tuple[str, int]:
        return "", 0

    def draft(self, order: CommandKind, text: str) -> PlanSegment:
        raise PlanError("nothing is planned here")

    def drive(self, robot: int, velocity: DriveVelocity, valid: Validity = ALWAYS) -> str:
        return ""

    def request_gains(self, values: Mapping[str, float] | None, next_lap: bool, valid: Validity = ALWAYS) -> tuple[str, int]:
        return "", 0


@contextmanager
def lab(robots: int) -> Iterator[str]:
    """Station's side and fleet; where the page is."""
    experiment = fleet(robots)
    address, port = f"tcp/127.0.0.1:{free_port()}", free_port()
    with Bus(ZenohTransport(Endpoint(address, router=True))) as bus:
        station = _Station(experiment, bus)
        desk = LiveBackend(experiment, planner.plan(experiment), bus, station.fleet, station.clock, station, "real-time")
        with WebServer(desk, WebOptions(port=port)):
            command = [sys.executable, "-m", "benchmarks.groundstation.page", address, str(robots)]
            talking = subprocess.Popen(command, stdin=subprocess.PIPE)
            try:
                yield f"http://127.0.0.1:{port}/"
            finally:
                talking.communicate()


def _cpu_s(browser: psutil.Process) -> float:
    """CPU time of a browser's processes so far."""
    return sum(sum(p.cpu_times()[:2]) for p in [browser, *browser.children(recursive=True)])


def _measure(page: Page, browser: psutil.Process, case: str) -> Iterator[Row]:
    page.evaluate("Object.assign(measured, {frames: 0, state: [], picture: []})")
    before_s, began_s = _cpu_s(browser), time.monotonic()
    page.wait_for_timeout(MEASURE_S * 1e3)
    took_s = time.monotonic() - began_s
    cpu = (_cpu_s(browser) - before_s) / took_s
    timings = page.evaluate("measured")
    yield Row.of("page", case, "stamp to drawn, state", "ms", timings["state"])
    yield Row.of("page", case, "stamp to drawn, picture", "ms", timings["picture"])
    yield Row.of("page", case, "drawn", "frames/s", [timings["frames"] / took_s])
    yield Row.of("page", case, "all of Chromium's processes", "% of a core", [100.0 * cpu])


def run() -> Iterator[Row]:
    """All rows. Without Chromium only the size."""
    sizes = [
        len(gzip.compress(path.read_bytes())) for path in STATIC.rglob("*") if path.is_file() and "three" not in path.name
    ]
    yield Row.of("page", "all assets but the 3-D view", "gzip", "kB", [sum(sizes) / 1e3])
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        print("page: needs Chromium, and none is installed", file=sys.stderr)
        return
    for robots in (2, ROBOTS):
        with lab(robots) as url, sync_playwright() as playwright:
            ours = {p.pid for p in psutil.Process().children(recursive=True)}
            browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
            roots = [
                p
                for p in psutil.Process().children(recursive=True)
                if p.pid not in ours and "--type=" not in " ".join(p.cmdline())
            ]
            page = browser.new_page(viewport={"width": 1440, "height": 900})
            page.add_init_script(PROBE)
            page.goto(url)
            page.wait_for_selector("[data-robot='1']:not(.stale)")
            page.wait_for_timeout(SETTLE_S * 1e3)
            yield from _measure(page, roots[0], f"{robots} robots, as states come")
            page.evaluate("(() => { const again = () => { drawSoon(); requestAnimationFrame(again); }; again(); })()")
            yield from _measure(page, roots[0], f"{robots} robots, drawing all the time")
            browser.close()


if __name__ == "__main__":
    _publish(sys.argv[1], int(sys.argv[2]))
