"""SHELL: the simulated pool on the wires: thruster boards on UDP, a camera and the truth on the bus.

By the wall clock the plant keeps up with time and pictures are rendered in a thread of their own, like a camera's. In
lockstep the simulator owns time: it stops at every control step until each robot's pulses have arrived.
"""

import contextlib
import queue
import threading
import time
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_bridge.camera.faults import CameraTrouble
from sim_bridge.camera.ideal_localizer import Located
from sim_bridge.camera.renderer import Renderer
from sim_bridge.node.udp_ports import Sockets
from sim_bridge.thruster_board.board import Board
from sim_bridge.thruster_board.nonvolatile import MakeBoard
from sim_bridge.world import World
from wire.config.experiment import Experiment
from wire.config.fault_injection import Break
from wire.frames import Array
from wire.messages import topics
from wire.messages.messages import CameraHealth, Frame, LocalizerStatus, RobotState, Tick, Trajectory
from wire.process.lockstep import LOCKSTEP_SAYS_S, LockstepClock, Reminder
from wire.process.runtime import SLICE_S, Clock, Stop, WallClock, guarded_thread, log, log_to_bus, wait
from wire.transport.bus import Bus


@dataclass(frozen=True, eq=False)
class Shot:
    """What the camera needs to take a picture: the plant in the middle of an exposure."""

    eta: Array
    nu: Array
    tilt: Array
    time_s: float
    index: int
    stamp_ns: int
    broken: tuple[Break, ...] = ()  # of the camera
    bare: frozenset[int] = frozenset()  # robots without markers, by index


class Pool:
    """The pool's shell: world, sockets, camera, bus."""

    def __init__(
        self,
        experiment: Experiment,
        bus: Bus,
        sockets: Sockets,
        stop: Stop,
        lockstep: bool,
        poses: bool = False,
        make: MakeBoard = Board,
    ) -> None:
        """`sockets` are closed when the run ends. With `poses` there is no camera: poses go out in the localizer's place.
        `make` makes the thruster boards."""
        self._experiment, self._bus, self._stop = experiment, bus, stop
        self._make = make
        self._lockstep = LockstepClock() if lockstep else None
        self._clock: Clock = self._lockstep or WallClock()
        self._sockets = sockets
        self._states = bus.inboxes(topics.STATE, RobotState, experiment.robot_ids if experiment.sim.faults else ())
        self._eye: Renderer | Located = (
            Located(experiment, experiment.seed) if poses else Renderer(experiment, experiment.seed)
        )
        self._camera_trouble = CameraTrouble()
        self._prepared: tuple[Shot, NDArray[np.uint8]] | None = None
        self._bare: frozenset[int] = frozenset()
        self._frame_index = 0
        self._undeveloped: deque[Shot] = deque()  # lockstep: exposed, and not old enough yet to count at a control step
        self._frame_ns = self._obstacles_ns = -1
        self._neutral = dict.fromkeys(experiment.robot_ids, True)

    def run(self) -> None:
        """Simulate until told to stop, or until the camera's thread has failed (Stop.raise_failure says so). Robots are put
        into the water when their trajectories are known."""
        try:
            self._bus.watch_presence()
            log_to_bus(self._bus, self._clock, "sim-bridge")
            starts = self._starts()
            if starts is None:
                return
            # Nobody arms before the localizer knows the water: robots that drifted meanwhile would begin elsewhere.
            held = isinstance(self._eye, Renderer) and self._experiment.watches_obstacles
            world = World(self._experiment, self._experiment.seed, starts, self._make, held)
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
        inboxes = self._bus.inboxes(topics.TRAJECTORY, Trajectory, (r.id for r in robots if r.start is None))
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
        for text in world.break_things():
            log.info(text)
        sent = world.step()
        for i, data in sent:
            self._sockets.send(i, data, world)
            robot = self._experiment.robot_ids[i]
            if world.neutral(i) is not self._neutral[robot]:
                self._neutral[robot] = world.neutral(i)
                log.info("board of robot %d: %s", robot, "neutral" if self._neutral[robot] else "thrusting")
        self._sockets.deliver(world)

    def _look_for_start(self, world: World, begin_ns: int) -> None:
        """Faults count from where the trajectories begin; a robot that flies tells when. Plant time 0 is `begin_ns`."""
        if world.start_ns is not None:
            return
        for inbox in self._states.values():
            received = inbox.newest()
            if received is not None and received.message.trajectory_s > 0.0:
                flown_ns = round(received.message.trajectory_s * 1e9)
                world.start_ns = self._clock.instant_ns(received) - flown_ns - begin_ns
                return

    # --- by the wall clock

    def _run_wall(self, world: World) -> None:
        shots: queue.Queue[Shot | None] = queue.Queue(1 if isinstance(self._eye, Renderer) else 0)  # poses only wait there
        camera = guarded_thread(self._stop, "camera", lambda: self._camera(shots))
        camera.start()
        begin_ns = self._clock.now_ns()
        try:
            while not self._stop.requested:
                self._sockets.exchange(world)
                self._move(world)
                if world.exposed:
                    self._look_for_start(world, begin_ns)
                    self._expose(world, begin_ns, shots)
                # The next step only when its time has come, however much arrives until then: else the water would run ahead.
                while (ahead_s := (begin_ns + world.now_ns - self._clock.now_ns()) * 1e-9) > 0 and not self._stop.requested:
                    self._sockets.wait(ahead_s)
                    self._sockets.exchange(world)
                if ahead_s < -SLICE_S:  # the machine was suspended or overloaded: time lost is lost
                    log.warning("simulation was %.2f s late; time skipped", -ahead_s)
                    begin_ns -= round(ahead_s * 1e9)
        finally:
            _end(camera, shots)

    def _expose(self, world: World, begin_ns: int, shots: "queue.Queue[Shot | None]") -> None:
        stamp_ns = begin_ns + world.now_ns
        self._bus.publish(topics.TRUTH, world.truth(), stamp_ns)
        shot = self._shot(world, stamp_ns)
        try:
            shots.put_nowait(shot)
        except queue.Full:
            log.debug("camera late: a frame is left out")

    def _shot(self, world: World, stamp_ns: int) -> Shot:
        self._frame_index += 1
        broken, bare = world.faults.camera, world.faults.bare
        return Shot(world.eta, world.nu, world.tilt, world.now_ns * 1e-9, self._frame_index, stamp_ns, broken, bare)

    def _camera(self, shots: "queue.Queue[Shot | None]") -> None:
        while (shot := shots.get()) is not None:
            self._see(shot)

    def _see(self, shot: Shot) -> None:
        """Publish what comes of an exposure: a picture, or poses as late as the localizer's."""
        if isinstance(self._eye, Renderer):
            self._publish_frame(self._eye, shot)
            return
        if self._lockstep is None:
            time.sleep(max(self._experiment.sim.latency_s - (self._clock.now_ns() - shot.stamp_ns) * 1e-9, 0.0))
        age_ns = max(self._clock.now_ns() - shot.stamp_ns, 0)
        for robot, pose in zip(self._experiment.robot_ids, self._eye.poses(shot.eta), strict=True):
            self._bus.publish(topics.POSE, pose, shot.stamp_ns, robot, age_ns=age_ns)
        if self._lockstep is not None:  # where others wait for what is told of each picture
            told = LocalizerStatus(
                CameraHealth.OK, shot.index, robots=self._experiment.robot_ids, obstacles_ns=self._obstacles_ns
            )
            self._bus.publish(topics.LOCALIZER, told, shot.stamp_ns)
        obstacles = self._eye.obstacles(shot.time_s)
        if obstacles is not None:
            self._obstacles_ns = shot.stamp_ns
            self._bus.publish(topics.OBSTACLES, obstacles, shot.stamp_ns, age_ns=age_ns)

    def _publish_frame(self, renderer: Renderer, shot: Shot) -> None:
        if shot.bare != self._bare:
            self._bare = shot.bare
            renderer.lose_markers(shot.bare)
        pixels = self._prepared_picture(shot)
        if pixels is None:
            pixels = renderer.render(shot.eta, shot.nu, shot.time_s, shot.index, shot.tilt)
        pixels = self._camera_trouble.apply(pixels, shot.broken)
        age_ns = max(self._clock.now_ns() - shot.stamp_ns, 0)
        self._bus.publish(topics.FRAME, Frame(pixels), shot.stamp_ns, age_ns=age_ns)

    # --- in lockstep

    def _prepare_picture(self, world: World) -> None:
        """Render the next frame while the others compute: until it is exposed, the pulses that are awaited move nothing."""
        expected = world.next_exposure() if not self._undeveloped else None
        if expected is None or not isinstance(self._eye, Renderer):
            return
        shot = Shot(*expected, world.exposure_ns * 1e-9, self._frame_index + 1, world.exposure_ns, bare=self._bare)
        self._prepared = shot, self._eye.render(shot.eta, shot.nu, shot.time_s, shot.index, shot.tilt)

    def _prepared_picture(self, shot: Shot) -> NDArray[np.uint8] | None:
        """The picture that was rendered ahead, if all came as expected, to the bit."""
        if self._prepared is None:
            return None
        (expected, pixels), self._prepared = self._prepared, None
        same = (expected.time_s, expected.index, expected.bare) == (shot.time_s, shot.index, shot.bare)
        moved = ((expected.eta, shot.eta), (expected.nu, shot.nu), (expected.tilt, shot.tilt))
        if same and all(np.array_equal(then, now) for then, now in moved):
            return pixels
        log.debug("frame %d came otherwise than expected", shot.index)
        return None

    def _run_lockstep(self, world: World, clock: LockstepClock) -> None:
        self._await_everyone(world)
        period_ns = round(self._experiment.controller.period_s * 1e9)
        tick_ns, previous_ns = round(self._experiment.sim.latency_s * 1e9) or period_ns, -1  # at 0 no board has said a word
        self._shoot(world, tick_ns, previous_ns)
        while not self._stop.requested:
            while world.now_ns < tick_ns:
                self._move(world)
                clock.tick_ns = world.now_ns
                if world.exposed:
                    self._shoot(world, tick_ns, previous_ns)
            clock.tick_ns = tick_ns
            self._tick(world, tick_ns, previous_ns)
            tick_ns, previous_ns = tick_ns + period_ns, tick_ns
            self._develop(world, tick_ns, previous_ns)

    def _await_everyone(self, world: World) -> None:
        """Until all are there and every board has heard whom to answer, in words that it can follow on."""
        self._sockets.forget()
        everyone = {"groundstation", *(f"agent-{r}" for r in self._experiment.robot_ids)}
        everyone |= {"localizer"} if isinstance(self._eye, Renderer) else set()
        reminder = Reminder()
        while not self._stop.requested:
            self._sockets.exchange(world)
            missing = everyone - self._bus.present
            if not missing and self._sockets.all_heard:
                return
            if reminder.due():
                log.info("waiting for %s", ", ".join(sorted(missing)) or "the robots to greet their boards")
            self._sockets.wait(SLICE_S)

    def _shoot(self, world: World, tick_ns: int, previous_ns: int) -> None:
        """Expose."""
        self._undeveloped.append(self._shot(world, world.now_ns))
        self._develop(world, tick_ns, previous_ns)
        self._bus.publish(topics.TRUTH, world.truth(), world.now_ns)  # nobody waits for it

    def _develop(self, world: World, tick_ns: int, previous_ns: int) -> None:
        """Publish the pictures that will be old enough at the coming tick. When the one that counts there is among them, the
        localizer hears at once."""
        newest_ns = tick_ns - round(self._experiment.sim.latency_s * 1e9)
        before_ns = self._frame_ns
        while self._undeveloped and self._undeveloped[0].stamp_ns <= newest_ns:
            shot = self._undeveloped.popleft()
            self._frame_ns = shot.stamp_ns
            self._see(shot)
        next_ns = self._undeveloped[0].stamp_ns if self._undeveloped else world.exposure_ns
        if self._frame_ns > before_ns and next_ns > newest_ns:
            self._bus.publish(topics.EXPOSED, Tick(tick_ns, previous_ns, self._frame_ns, self._there), tick_ns)

    @property
    def _there(self) -> tuple[int, ...]:
        """Robots whose agents are present."""
        return tuple(r for r in self._experiment.robot_ids if f"agent-{r}" in self._bus.present)

    def _await_states(self, world: World, robots: tuple[int, ...], stamp_ns: int) -> None:
        """Where faults wait for the start, see every robot's last state before time goes on: else chance would set it."""
        if not self._states or world.start_ns is not None or stamp_ns < 0:
            return

        def here() -> bool:
            headers = [self._states[robot].newest_header() for robot in robots if f"agent-{robot}" in self._bus.present]
            return all(header is not None and header.stamp_ns >= stamp_ns for header in headers)

        while not (wait(self._bus, self._stop, here, LOCKSTEP_SAYS_S) or self._stop.requested):
            log.warning("lockstep: waiting for the robots' states of %.3f s", stamp_ns * 1e-9)
        self._look_for_start(world, 0)

    def _tick(self, world: World, tick_ns: int, previous_ns: int) -> None:
        """Stop time until every robot that is there has sent its pulses for this step."""
        robots = self._there
        indices = [self._experiment.robot_ids.index(r) for r in robots]
        self._await_states(world, robots, previous_ns)
        before = [self._sockets.commands[i] for i in indices]
        board_ms = tuple(self._sockets.burst_ms[i] for i in indices)
        self._bus.publish(topics.TICK, Tick(tick_ns, previous_ns, self._frame_ns, robots, board_ms), tick_ns)
        self._prepare_picture(world)
        reminder = Reminder()
        while not self._stop.requested:
            self._sockets.exchange(world)
            late = [r for r, i, n in zip(robots, indices, before, strict=True) if self._sockets.commands[i] <= n]
            late = [r for r in late if f"agent-{r}" in self._bus.present]
            if not late:
                return
            if reminder.due():
                log.warning(
                    "lockstep: at %.3f s waiting for the pulses of robot %s", tick_ns * 1e-9, ", ".join(map(str, late))
                )
            self._sockets.wait(SLICE_S)


def _end(camera: threading.Thread, shots: "queue.Queue[Shot | None]") -> None:
    """Have the camera's thread see what waits, and end. One that has failed takes nothing any more: nobody waits for it."""
    while camera.is_alive():
        with contextlib.suppress(queue.Full):
            shots.put(None, timeout=SLICE_S)
            camera.join()
