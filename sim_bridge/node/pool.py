"""SHELL: the simulated pool as a process: thruster boards on UDP, camera frames and the truth on the bus.

By the wall clock the plant keeps up with time, and a thread renders the frames. In lockstep the simulator owns time: it
stops at every control step until each robot's pulses have arrived.
"""

import contextlib
import math
import queue
import threading
import time
from collections import deque
from collections.abc import Callable

import numpy as np

from shoal.bus.bus import Bus
from shoal.config.experiment import Experiment
from shoal.config.fault_injection import BY_HAND
from shoal.frames import Array
from shoal.messages import topics
from shoal.messages.codec import DecodeError, Header, decode
from shoal.messages.messages import (
    CameraHealth,
    FaultRequest,
    Frame,
    LocalizerStatus,
    StationHeartbeat,
    Tick,
    Trajectory,
)
from shoal.messages.topics import Topic
from shoal.runtime.runtime import SLICE_S, Clock, Stop, WallClock, guarded_thread, log, log_to_bus, wait
from shoal.runtime.version import code
from sim_bridge.lockstep.clock import LOCKSTEP_SAYS_S, LockstepClock, Reminder
from sim_bridge.node.board_ports import BoardPorts
from sim_bridge.node.ideal_localizer import IdealLocalizer
from sim_bridge.node.simulated_camera import Exposure, SimulatedCamera
from sim_bridge.thruster_board.board import ThrusterBoard
from sim_bridge.world import World, WorldBoard


class PoolNode:
    """The process: world, ports, camera and bus."""

    def __init__(
        self,
        experiment: Experiment,
        bus: Bus,
        sockets: BoardPorts,
        stop: Stop,
        lockstep: bool,
        poses: bool = False,
        make: Callable[[Experiment, int, int], WorldBoard] = ThrusterBoard,
        pace: float | None = None,
    ) -> None:
        """`sockets` are closed when the run ends. With `poses` there is no camera: poses are published in the localizer's
        place. `make` makes the thruster boards. A lockstep run goes no faster than `pace` times real time."""
        self._experiment, self._bus, self._stop = experiment, bus, stop
        self._make, self._pace = make, pace
        self._lockstep = LockstepClock() if lockstep else None
        self._clock: Clock = self._lockstep or WallClock()
        self._sockets = sockets
        self._heartbeat = bus.inbox(topics.HEARTBEAT, StationHeartbeat)
        self._began_ns = 0  # of the newest flight, on the station's clock,
        self._start_ns: int | None = None  # and on ours
        self._requests: deque[FaultRequest] = deque()  # of people, not applied yet
        self._localizer = IdealLocalizer(experiment, experiment.seed) if poses else None
        names = () if poses else experiment.camera_names or ("",)
        self._cameras = [SimulatedCamera(experiment, name) for name in names]
        if not lockstep:
            for camera in self._cameras:
                camera.prepare()  # frames of a wall clock must not wait
        self._frame_index = 0
        self._pending: deque[Exposure] = deque()  # lockstep: exposed, and not old enough yet to count at a control step
        self._frame_ns = self._obstacles_ns = -1
        self._no_radio: tuple[int, ...] = ()  # robots without one at the last control step
        self._neutral = dict.fromkeys(experiment.robot_ids, True)

    def run(self) -> None:
        """Simulate until told to stop, or until the camera's thread has failed (Stop.raise_failure says so).

        Robots are put into the water when their trajectories are known.
        """
        try:
            self._bus.watch_presence()
            log_to_bus(self._bus, self._clock, "sim-bridge")
            starts = self._starts()
            if starts is None:
                return
            # No robot arms before the localizer has learnt the water. Until then they are held, or they would drift away.
            held = self._localizer is None and self._experiment.watches_obstacles
            world = World(self._experiment, self._experiment.seed, starts, self._make, held)
            self._bus.subscribe(topics.FAULT, None, self._fault)
            self._bus.announce("sim-bridge")
            log.info("robots are in the water")
            if self._lockstep is not None:
                self._run_lockstep(world, self._lockstep)
            else:
                self._run_wall(world)
        finally:
            for camera in self._cameras:
                camera.close()
            self._sockets.close()

    def _starts(self) -> Array | None:
        """Start poses (n, 4): as the experiment gives them, or an offset from the start of the robot's trajectory. None if
        told to stop."""
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

    def _step_plant(self, world: World, until_ns: int = 0) -> None:
        """Move to the next event up to `until_ns`, by one step at least. Log the faults that change, and the boards that
        become neutral or thrusting."""
        while self._requests:
            request = self._requests.popleft()
            if self._lockstep is None and request.what.startswith("radio"):
                log.warning("%s: only in simulated time: start the run without --real-time", request.what)
                continue
            log.info("%s%s", BY_HAND, world.break_by_hand(request.what, request.for_s) or "nothing to mend")
        for text in world.apply_faults():
            log.info(text)
        sent = world.step(until_ns)
        for i, data in sent:
            self._sockets.send(i, data, world)
            robot = self._experiment.robot_ids[i]
            if world.neutral(i) is not self._neutral[robot]:
                self._neutral[robot] = world.neutral(i)
                log.info("board of robot %d: %s", robot, "neutral" if self._neutral[robot] else "thrusting")
        self._sockets.deliver(world)

    def _fault(self, topic: Topic, key: str, header: Header, payload: bytes) -> None:
        """Take a person's request. The station has checked it, by its experiment."""
        try:
            request = decode(FaultRequest, payload, key, topic.name)
            if request.what:
                text = f"{request.what} for {request.for_s!r}" if request.for_s else request.what
                request = FaultRequest(*self._experiment.fault_request(text))
        except (DecodeError, ValueError) as error:
            log.warning("a fault that cannot be made: %s", error)
        else:
            self._requests.append(request)

    def _note_start(self, world: World, begin_ns: int) -> None:
        """Note the instant at which the newest flight of the formation begins, from which faults count: the station reports
        it. Plant time 0 is `begin_ns`, which is a later instant after the plant has lost time."""
        received = self._heartbeat.newest()
        if received is not None and received.message.began_ns not in (0, self._began_ns):
            self._began_ns = received.message.began_ns
            self._start_ns = self._clock.instant_ns(received) - (received.header.stamp_ns - self._began_ns)
        if self._start_ns is not None:
            world.start_ns = self._start_ns - begin_ns

    # --- by the wall clock

    def _run_wall(self, world: World) -> None:
        """Step the world by the wall clock until told to stop."""
        exposures: queue.Queue[Exposure | None] = queue.Queue(1 if self._localizer is None else 0)  # poses only wait there
        camera = guarded_thread(self._stop, "camera", lambda: self._run_camera(exposures))
        camera.start()
        begin_ns = self._clock.now_ns()
        try:
            while not self._stop.requested:
                self._sockets.exchange(world)
                self._step_plant(world)
                if world.exposed:
                    self._note_start(world, begin_ns)
                    self._expose(world, begin_ns, exposures)
                # The next step only when its time has come, however much arrives until then: else the water would run ahead.
                while (ahead_s := (begin_ns + world.now_ns - self._clock.now_ns()) * 1e-9) > 0 and not self._stop.requested:
                    self._sockets.wait(ahead_s)
                    self._sockets.exchange(world)
                if ahead_s < -SLICE_S:  # the machine was suspended or overloaded: time lost is lost
                    log.warning("simulation was %.2f s late; time skipped", -ahead_s)
                    begin_ns -= round(ahead_s * 1e9)
        finally:
            _end_camera(camera, exposures)

    def _expose(self, world: World, begin_ns: int, exposures: "queue.Queue[Exposure | None]") -> None:
        """Publish the truth, and hand an exposure to the camera; left out if that is still busy with those before."""
        stamp_ns = begin_ns + world.now_ns
        self._bus.publish(topics.TRUTH, world.truth(), stamp_ns)
        exposure = self._exposure(world, stamp_ns)
        try:
            exposures.put_nowait(exposure)
        except queue.Full:
            log.debug("camera late: a frame is left out")

    def _exposure(self, world: World, stamp_ns: int) -> Exposure:
        self._frame_index += 1
        return Exposure(
            world.eta, world.nu, world.tilt, world.now_ns * 1e-9, self._frame_index, stamp_ns, world.faults.camera,
            world.faults.unmarked, world.faults.water_drop_m, world.faults.balls,
        )  # fmt: skip

    def _run_camera(self, exposures: "queue.Queue[Exposure | None]") -> None:
        while (exposure := exposures.get()) is not None:
            self._publish_exposure(exposure, exposure.stamp_ns)

    def _publish_exposure(self, exposure: Exposure, newest_ns: int) -> None:
        """Publish the frames that are due when that of an exposure would be, or poses as late as the localizer's."""
        if self._localizer is None:
            for camera in self._cameras:
                camera.expose(exposure)
                for stamp_ns, pixels in camera.due(newest_ns):
                    age_ns = max(self._clock.now_ns() - stamp_ns, 0)
                    self._bus.publish(topics.FRAME.of_camera(camera.name), Frame(pixels), stamp_ns, age_ns=age_ns)
                    self._frame_ns = max(self._frame_ns, stamp_ns)
            return
        self._frame_ns = exposure.stamp_ns
        if self._lockstep is None:
            time.sleep(max(self._experiment.sim.latency_s - (self._clock.now_ns() - exposure.stamp_ns) * 1e-9, 0.0))
        age_ns = max(self._clock.now_ns() - exposure.stamp_ns, 0)
        for robot, pose in zip(self._experiment.robot_ids, self._localizer.poses(exposure.eta), strict=True):
            self._bus.publish(topics.POSE, pose, exposure.stamp_ns, robot, age_ns=age_ns)
        if self._lockstep is not None:  # where others wait for what is told of each picture
            status = LocalizerStatus(
                CameraHealth.OK,
                exposure.index,
                robots=self._experiment.robot_ids,
                obstacles_ns=self._obstacles_ns,
                code=code().short,
                experiment_hash=self._experiment.hash,
            )
            self._bus.publish(topics.LOCALIZER, status, exposure.stamp_ns)
        obstacles = self._localizer.obstacles(exposure.time_s, exposure.balls)
        if obstacles is not None:
            self._obstacles_ns = exposure.stamp_ns
            self._bus.publish(topics.OBSTACLES, obstacles, exposure.stamp_ns, age_ns=age_ns)

    # --- in lockstep

    def _render_ahead(self, world: World) -> None:
        """Render the next frame while the others compute: the pulses that are awaited cannot move a robot before it is
        exposed."""
        expected = world.next_exposure() if not self._pending else None
        if expected is None:
            return
        exposure = Exposure(*expected, world.exposure_ns * 1e-9, self._frame_index + 1, world.exposure_ns)
        for camera in self._cameras:
            camera.render_ahead(exposure)

    def _run_lockstep(self, world: World, clock: LockstepClock) -> None:
        """Step the world from tick to tick, each after all processes have done their step."""
        self._await_everyone(world)
        steps, period_ns = self._experiment.plant_steps, round(self._experiment.controller.period_s * 1e9)
        step_ns = period_ns // steps
        # A tick is at a step of the plant: boards would report from after it. At 0 no board has said a word.
        latency_steps = math.ceil(round(self._experiment.sim.latency_s * 1e9) / step_ns)
        tick_ns, previous_ns = latency_steps * step_ns or period_ns, -1
        self._expose_in_lockstep(world, tick_ns, previous_ns)
        due_s = 0.0
        while not self._stop.requested:
            while world.now_ns < tick_ns:
                self._step_plant(world, self._sockets.quiet_until_ns(tick_ns))
                clock.tick_ns = world.now_ns
                if world.exposed:
                    self._expose_in_lockstep(world, tick_ns, previous_ns)
            clock.tick_ns = tick_ns
            self._tick(world, tick_ns, previous_ns)
            tick_ns, previous_ns = tick_ns + period_ns, tick_ns
            self._publish_due(world, tick_ns, previous_ns)
            due_s = self._keep_pace(due_s)

    def _keep_pace(self, due_s: float) -> float:
        """Wait until `due_s` by the monotonic clock. Returns when the step after it is due: lost time is not made up for."""
        if self._pace is None:
            return due_s
        while (ahead_s := due_s - time.monotonic()) > 0.0 and not self._stop.requested:
            time.sleep(min(ahead_s, SLICE_S))
        return max(due_s, time.monotonic()) + self._experiment.controller.period_s / self._pace

    def _await_everyone(self, world: World) -> None:
        """Wait until all processes are present and every board has a peer."""
        self._sockets.forget()
        everyone = {"groundstation", *(f"agent-{r}" for r in self._experiment.robot_ids)}
        everyone |= {topics.localizer_name(camera.name) for camera in self._cameras}
        everyone |= {topics.localizer_name("")} if self._cameras else set()
        reminder = Reminder()
        while not self._stop.requested:
            self._sockets.exchange(world)
            missing = everyone - self._bus.present
            if not missing and self._sockets.all_heard:
                return
            if reminder.due():
                log.info("waiting for %s", ", ".join(sorted(missing)) or "the robots to greet their boards")
            self._sockets.wait(SLICE_S)

    def _expose_in_lockstep(self, world: World, tick_ns: int, previous_ns: int) -> None:
        """Add the exposure of this instant, publish what is due, and publish the truth."""
        self._pending.append(self._exposure(world, world.now_ns))
        self._publish_due(world, tick_ns, previous_ns)
        self._bus.publish(topics.TRUTH, world.truth(), world.now_ns)  # no process waits for it

    def _publish_due(self, world: World, tick_ns: int, previous_ns: int) -> None:
        """Publish the frames that will be old enough at the coming tick. When the last of them is out, tell the localizer
        at once."""
        newest_ns = tick_ns - round(self._experiment.sim.latency_s * 1e9)
        before_ns = self._frame_ns
        while self._pending and self._pending[0].stamp_ns <= newest_ns:
            self._publish_exposure(self._pending.popleft(), newest_ns)
        next_ns = self._pending[0].stamp_ns if self._pending else world.exposure_ns
        if self._frame_ns > before_ns and next_ns > newest_ns:
            exposed = Tick(
                tick_ns, previous_ns, self._frame_ns, self._present_robots, (), self._frames_ns, unheard=self._no_radio
            )
            self._bus.publish(topics.EXPOSED, exposed, tick_ns)

    @property
    def _frames_ns(self) -> tuple[int, ...]:
        """Stamps of the newest frames of several cameras."""
        return tuple(camera.frame_ns for camera in self._cameras if camera.name)

    @property
    def _present_robots(self) -> tuple[int, ...]:
        """Robots whose agents are present."""
        return tuple(r for r in self._experiment.robot_ids if f"agent-{r}" in self._bus.present)

    def _await_heartbeat(self, stamp_ns: int) -> None:
        """Wait for the station's heartbeat of a step: otherwise it would depend on chance when a start is noted."""

        def here() -> bool:
            header = self._heartbeat.newest_header()
            return "groundstation" not in self._bus.present or (header is not None and header.stamp_ns >= stamp_ns)

        while not (stamp_ns < 0 or wait(self._bus, self._stop, here, LOCKSTEP_SAYS_S) or self._stop.requested):
            log.warning("lockstep: waiting for the station's heartbeat of %.3f s", stamp_ns * 1e-9)

    def _tick(self, world: World, tick_ns: int, previous_ns: int) -> None:
        """Stop time until every robot that is present has sent its pulses for this step."""
        robots = self._present_robots
        indices = [self._experiment.robot_ids.index(r) for r in robots]
        self._await_heartbeat(previous_ns)
        self._note_start(world, 0)
        before = [self._sockets.commands[i] for i in indices]
        board_ms = tuple(self._sockets.burst_ms[i] for i in indices)
        unheard, self._no_radio = self._no_radio, tuple(sorted(world.faults.without_radio))
        tick = Tick(tick_ns, previous_ns, self._frame_ns, robots, board_ms, self._frames_ns, self._no_radio, unheard)
        self._bus.publish(topics.TICK, tick, tick_ns)
        self._render_ahead(world)
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


def _end_camera(camera: threading.Thread, exposures: "queue.Queue[Exposure | None]") -> None:
    """End the camera's thread after the waiting exposures; a thread that has failed is not waited for."""
    while camera.is_alive():
        with contextlib.suppress(queue.Full):
            exposures.put(None, timeout=SLICE_S)
            camera.join()
