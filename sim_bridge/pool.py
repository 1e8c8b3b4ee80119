"""SHELL: the simulated pool on the wires: thruster boards on UDP, a camera and the truth on the bus.

By the wall clock the plant keeps up with time and pictures are rendered in a thread of their own, like a camera's. In
lockstep the simulator owns time: it stops at every control step until each robot's pulses have arrived.
"""

import queue
import select
import socket
import threading
import time
from dataclasses import dataclass

import cv2
import numpy as np

from sim_bridge.camera import Renderer
from sim_bridge.world import World
from wire import topics
from wire.bus import Bus
from wire.experiment import Experiment
from wire.frames import Array
from wire.messages import Frame, Tick, Trajectory
from wire.runtime import LOCKSTEP_PATIENCE_S, SLICE_S, Clock, LockstepClock, Stop, WallClock, log, log_to_bus, wait

READ_BYTES = 65536


class Sockets:
    """One UDP port per thruster board. A board answers to where it was last spoken to from."""

    def __init__(self, base_port: int, robots: tuple[int, ...]) -> None:
        self._sockets = []
        self._peers: list[tuple[str, int] | None] = [None] * len(robots)
        for robot in robots:
            board = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            board.bind(("127.0.0.1", base_port + robot))
            board.setblocking(False)
            self._sockets.append(board)

    def exchange(self, world: World) -> None:
        """Give the boards what has arrived."""
        for i, board in enumerate(self._sockets):
            while True:
                try:
                    data, self._peers[i] = board.recvfrom(READ_BYTES)
                except (BlockingIOError, ConnectionRefusedError):
                    break
                world.receive(i, data)

    @property
    def all_heard(self) -> bool:
        """Whether every board knows whom to answer."""
        return None not in self._peers

    def send(self, i: int, data: bytes) -> None:
        """Send a board's bytes, if somebody has spoken to it."""
        peer = self._peers[i]
        if data and peer is not None:
            try:
                self._sockets[i].sendto(data, peer)
            except OSError:  # its computer is gone; the board times out by itself
                return

    def wait(self, timeout_s: float) -> None:
        """Sleep until something arrives."""
        select.select(self._sockets, [], [], max(timeout_s, 0.0))

    def close(self) -> None:
        """Free the ports."""
        for board in self._sockets:
            board.close()


@dataclass(frozen=True, eq=False)
class Shot:
    """What the camera needs to take a picture: the plant in the middle of an exposure."""

    eta: Array
    nu: Array
    time_s: float
    index: int
    stamp_ns: int


class Pool:
    """The pool's shell: world, sockets, camera, bus."""

    def __init__(self, experiment: Experiment, bus: Bus, base_port: int, stop: Stop, lockstep: bool) -> None:
        self._experiment, self._bus, self._stop = experiment, bus, stop
        self._lockstep = LockstepClock() if lockstep else None
        self._clock: Clock = self._lockstep or WallClock()
        self._sockets = Sockets(base_port, experiment.robot_ids)
        cv2.setNumThreads(1)  # two cores, five processes: more threads only fight
        self._renderer = Renderer(experiment, experiment.seed)
        self._frame_index = 0
        self._frame_ns = -1
        self._neutral = dict.fromkeys(experiment.robot_ids, True)

    def run(self) -> None:
        """Simulate until told to stop. Robots are put into the water when their trajectories are known."""
        try:
            self._bus.watch_presence()
            log_to_bus(self._bus, self._clock, "sim-bridge")
            starts = self._starts()
            if starts is None:
                return
            world = World(self._experiment, self._experiment.seed, starts)
            self._bus.announce("sim-bridge")
            log.info("robots are in the water")
            if self._lockstep is not None:
                self._run_lockstep(world, self._lockstep)
            else:
                self._run_wall(world)
        finally:
            self._sockets.close()

    def _starts(self) -> Array | None:
        """Start poses (n, 4): as the experiment gives them, or an offset from where the robot's trajectory begins."""
        robots = self._experiment.robots
        inboxes = {r.id: self._bus.inbox(topics.TRAJECTORY, Trajectory, r.id) for r in robots if r.start is None}
        while not wait(self._bus, self._stop, lambda: all(i.newest_header() for i in inboxes.values()), 10.0):
            if self._stop.requested:
                return None
            log.info("waiting for the station's trajectories: they say where the robots start")
        starts = []
        for robot in robots:
            if robot.start is not None:
                starts.append(np.array(robot.start))
                continue
            received = inboxes[robot.id].newest()
            if received is None:
                raise RuntimeError(f"trajectory of robot {robot.id}: {inboxes[robot.id].last_error}")
            starts.append(received.message.eta[0] + np.array(robot.start_offset))
        return np.array(starts)

    def _move(self, world: World) -> None:
        """One step of the plant. What boards do with thrusters is worth a line in the log: it is what faults are judged by."""
        for i, data in world.step():
            self._sockets.send(i, data)
            robot = self._experiment.robot_ids[i]
            if world.neutral(i) is not self._neutral[robot]:
                self._neutral[robot] = world.neutral(i)
                log.info("board of robot %d: %s", robot, "neutral" if self._neutral[robot] else "thrusting")

    # --- by the wall clock

    def _run_wall(self, world: World) -> None:
        shots: queue.Queue[Shot | None] = queue.Queue(1)
        camera = threading.Thread(target=self._camera, args=(shots,), name="camera")
        camera.start()
        begin_ns = self._clock.now_ns()
        try:
            while not self._stop.requested:
                self._sockets.exchange(world)
                self._move(world)
                if world.exposed:
                    self._expose(world, begin_ns, shots)
                ahead_s = (begin_ns + world.now_ns - self._clock.now_ns()) * 1e-9
                if ahead_s > 0:
                    self._sockets.wait(ahead_s)
                elif ahead_s < -SLICE_S:  # the machine was suspended or overloaded: time lost is lost
                    log.warning("simulation was %.2f s late; time skipped", -ahead_s)
                    begin_ns -= round(ahead_s * 1e9)
        finally:
            shots.put(None)
            camera.join()

    def _expose(self, world: World, begin_ns: int, shots: "queue.Queue[Shot | None]") -> None:
        stamp_ns = begin_ns + world.now_ns
        self._bus.publish(topics.TRUTH, world.truth(), stamp_ns)
        shot = Shot(world.eta, world.nu, world.now_ns * 1e-9, self._next_frame(), stamp_ns)
        try:
            shots.put_nowait(shot)
        except queue.Full:
            log.debug("camera late: a frame is left out")

    def _next_frame(self) -> int:
        self._frame_index += 1
        return self._frame_index

    def _camera(self, shots: "queue.Queue[Shot | None]") -> None:
        while (shot := shots.get()) is not None:
            self._publish_frame(shot)

    def _publish_frame(self, shot: Shot) -> None:
        pixels = self._renderer.render(shot.eta, shot.nu, shot.time_s, shot.index)
        age_ns = max(self._clock.now_ns() - shot.stamp_ns, 0)
        self._bus.publish(topics.FRAME, Frame(pixels), shot.stamp_ns, age_ns=age_ns)

    # --- in lockstep

    def _run_lockstep(self, world: World, clock: LockstepClock) -> None:
        everyone = {"groundstation", "localizer", *(f"agent-{r}" for r in self._experiment.robot_ids)}
        while not wait(self._bus, self._stop, lambda: everyone <= self._bus.present, LOCKSTEP_PATIENCE_S):
            if self._stop.requested:
                return
            log.info("waiting for %s", ", ".join(sorted(everyone - self._bus.present)))
        while not (self._sockets.all_heard or self._stop.requested):  # else the first bursts would go nowhere
            self._sockets.wait(SLICE_S)
            self._sockets.exchange(world)
        period_ns = round(self._experiment.controller.period_s * 1e9)
        tick_ns, previous_ns = round(self._experiment.sim.latency_s * 1e9), -1
        self._shoot(world)
        while not self._stop.requested:
            while world.now_ns < tick_ns:
                self._move(world)
                clock.tick_ns = world.now_ns
                if world.exposed:
                    self._shoot(world)
            clock.tick_ns = tick_ns
            self._tick(world, tick_ns, previous_ns)
            tick_ns, previous_ns = tick_ns + period_ns, tick_ns

    def _shoot(self, world: World) -> None:
        self._frame_ns = world.now_ns
        self._bus.publish(topics.TRUTH, world.truth(), world.now_ns)
        self._publish_frame(Shot(world.eta, world.nu, world.now_ns * 1e-9, self._next_frame(), world.now_ns))

    def _tick(self, world: World, tick_ns: int, previous_ns: int) -> None:
        """Stop time until every robot that is there has sent its pulses for this step."""
        robots = tuple(r for r in self._experiment.robot_ids if f"agent-{r}" in self._bus.present)
        indices = [self._experiment.robot_ids.index(r) for r in robots]
        before = [world.overrides(i) for i in indices]
        board_ms = tuple(world.board_ms(i) for i in indices)
        self._bus.publish(topics.TICK, Tick(tick_ns, previous_ns, self._frame_ns, robots, board_ms), tick_ns)
        deadline = time.monotonic() + 2 * LOCKSTEP_PATIENCE_S
        while not self._stop.requested:
            self._sockets.exchange(world)
            late = [r for r, i, n in zip(robots, indices, before, strict=True) if world.overrides(i) <= n]
            late = [r for r in late if f"agent-{r}" in self._bus.present]
            if not late:
                return
            if time.monotonic() > deadline:
                log.error("lockstep: no pulses from robot %s; going on without", ", ".join(map(str, late)))
                return
            self._sockets.wait(SLICE_S)
