"""Robots and obstacles as foxglove.* messages that 3-D viewers draw: hulls with headings, plans, paths, obstacles, pool.
Pure.

    drawer = SceneDrawer(experiment)
    drawer.take(topic, robot, message, stamp_ns)    # every message of the run, in order
    drawer.moving(stamp_ns)                     # SceneUpdate: robots, horizons, obstacles; all of it each time
    drawer.standing(stamp_ns)                   # SceneUpdate: pool, islands, paths
    upright(stamp_ns)                           # FrameTransform: viewers like z up, the pool's frame has it down
"""

import math
from collections.abc import Iterable
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.Point3_pb2 import Point3
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from groundstation.palette import colour
from shoal.config.experiment import Experiment
from shoal.frames import Array
from shoal.messages import topics
from shoal.messages.messages import Obstacles, Plan, RobotState, Trajectory, Truth
from shoal.messages.topics import Topic

POOL_FRAME, UPRIGHT_FRAME = "pool", "upright"
MOVING, STANDING, FRAMES = "viewer/scene", "viewer/pool", "viewer/frame"  # topics, below the fleet's name
SCHEMAS: dict[str, Any] = {MOVING: SceneUpdate, STANDING: SceneUpdate, FRAMES: FrameTransform}
DRAWN = (topics.STATE, topics.PLAN, topics.TRUTH, topics.OBSTACLES, topics.TRAJECTORY)  # topics that SceneDrawer takes
GONE_NS = 500_000_000  # what is not told again is not drawn any longer
GREY, RED = "#767676", "#CC0000"
FULL, FAINT, GLASS = 1.0, 0.45, 0.25  # opacities
PATH_POINTS = 400  # of a trajectory: enough for the eye


M = TypeVar("M")  # type of a message


class _Stamped(NamedTuple, Generic[M]):
    message: M
    stamp_ns: int


def _fresh(newest: _Stamped[M] | None, now_ns: int) -> M | None:
    """The newest message if it is recent; None otherwise."""
    return newest.message if newest is not None and newest.stamp_ns >= now_ns - GONE_NS else None


class SceneDrawer:
    """The newest of everything that is drawn."""

    def __init__(self, experiment: Experiment) -> None:
        self._experiment = experiment
        self._states: dict[int, _Stamped[RobotState]] = {}
        self._plans: dict[int, _Stamped[Plan]] = {}
        self._trajectories: dict[int, Trajectory] = {}
        self._obstacles: _Stamped[Obstacles] | None = None
        self._truth: _Stamped[Truth] | None = None
        self.replanned = True  # whether what stands has changed since `standing`

    def take(self, topic: Topic, robot: int, message: Any, stamp_ns: int) -> None:
        """Keep the newest message of each kind that the scene is drawn from."""
        if topic is topics.STATE:
            self._states[robot] = _Stamped(message, stamp_ns)
        elif topic is topics.PLAN:
            self._plans[robot] = _Stamped(message, stamp_ns)
        elif topic is topics.OBSTACLES:
            self._obstacles = _Stamped(message, stamp_ns)
        elif topic is topics.TRUTH:
            self._truth = _Stamped(message, stamp_ns)
        elif topic is topics.TRAJECTORY:
            self._trajectories[robot] = message
            self.replanned = True

    def moving(self, stamp_ns: int) -> SceneUpdate:
        """Robots, their horizons, the truth behind them, obstacles; without those whose last message is old."""
        scene, radius_m = SceneUpdate(), self._experiment.vehicle.radius_m
        for index, robot in enumerate(self._experiment.robot_ids):
            paint = _colour(colour(index), FULL)
            state, plan = _fresh(self._states.get(robot), stamp_ns), _fresh(self._plans.get(robot), stamp_ns)
            if state is not None and state.estimate is not None:
                entity, eta = _entity(scene, f"robot {robot}", stamp_ns), state.estimate.eta
                _add_hull(entity, eta, radius_m, paint)
                label = f"{robot} {state.mode.name.lower()}"
                text = entity.texts.add(text=label, billboard=True, font_size=14.0, scale_invariant=True)
                _place(text, eta + np.array([0.0, 0.0, -1.6 * radius_m, 0.0]))
                text.color.CopyFrom(paint)
            if plan is not None:
                _line(_entity(scene, f"plan {robot}", stamp_ns), plan.eta[:, :3], paint, 4.0)
        truth, obstacles = _fresh(self._truth, stamp_ns), _fresh(self._obstacles, stamp_ns)
        if truth is not None:
            for robot, eta in zip(truth.robots, truth.eta, strict=False):
                _add_hull(_entity(scene, f"truth {robot}", stamp_ns), eta, radius_m, _colour(GREY, GLASS))
        if obstacles is not None:
            self._draw_obstacles(scene, obstacles, stamp_ns)
        return scene

    def _draw_obstacles(self, scene: SceneUpdate, obstacles: Obstacles, stamp_ns: int) -> None:
        for number, outline in zip(obstacles.ids, obstacles.outline, strict=False):
            corners = np.column_stack([outline, np.full(len(outline), obstacles.depth_m)])
            _line(_entity(scene, f"obstacle {number}", stamp_ns), corners, _colour(RED, FULL), 3.0, closed=True)

    def standing(self, stamp_ns: int) -> SceneUpdate:
        """Pool, islands, paths."""
        self.replanned = False
        scene = SceneUpdate()
        length, width, depth = self._experiment.pool.size_m
        pool = _entity(scene, "pool", stamp_ns, lasting=True)
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [length / 2, width / 2]
        for z in (0.0, depth):
            _line(pool, np.column_stack([corners, np.full(4, z)]), _colour(GREY, FULL), 2.0, closed=True)
        for k, island in enumerate(self._experiment.islands):
            entity = _entity(scene, f"island {k + 1}", stamp_ns, lasting=True)
            cylinder = entity.cylinders.add(bottom_scale=1.0, top_scale=1.0)
            _place(cylinder, np.array([*island.position_m, depth / 2, 0.0]))
            cylinder.size.x = cylinder.size.y = 2.0 * island.radius_m
            cylinder.size.z = depth
            cylinder.color.CopyFrom(_colour(GREY, FAINT))
        for index, robot in enumerate(self._experiment.robot_ids):
            trajectory = self._trajectories.get(robot)
            if trajectory is not None and len(trajectory.eta):
                every = max(1, len(trajectory.eta) // PATH_POINTS)
                entity = _entity(scene, f"path {robot}", stamp_ns, lasting=True)
                _line(entity, trajectory.eta[::every, :3], _colour(colour(index), FAINT), 1.5)
        return scene


def upright(stamp_ns: int) -> FrameTransform:
    """The pool's frame in one with z up: half a turn about x."""
    frame = FrameTransform(parent_frame_id=UPRIGHT_FRAME, child_frame_id=POOL_FRAME)
    frame.timestamp.FromNanoseconds(stamp_ns)
    frame.rotation.x = 1.0
    return frame


def _entity(scene: SceneUpdate, name: str, stamp_ns: int, lasting: bool = False) -> SceneEntity:
    """Add an entity of the scene, in the pool frame. It vanishes after GONE_NS without a new one, unless it is `lasting`."""
    entity = scene.entities.add(frame_id=POOL_FRAME, id=name)
    entity.timestamp.FromNanoseconds(stamp_ns)
    if not lasting:
        entity.lifetime.FromNanoseconds(GONE_NS)
    return entity


def _add_hull(entity: SceneEntity, eta: Array, radius_m: float, paint: Color) -> None:
    """Add a sphere, and an arrow that shows its heading."""
    sphere = entity.spheres.add()
    _place(sphere, eta)
    sphere.size.x = sphere.size.y = sphere.size.z = 2.0 * radius_m
    sphere.color.CopyFrom(Color(r=paint.r, g=paint.g, b=paint.b, a=paint.a * FAINT))
    arrow = entity.arrows.add(
        shaft_length=1.2 * radius_m, shaft_diameter=0.12 * radius_m, head_length=0.4 * radius_m, head_diameter=0.35 * radius_m
    )
    _place(arrow, eta)
    arrow.color.CopyFrom(paint)


def _place(primitive: Any, eta: Array) -> None:
    """Put a primitive at a pose (4,)."""
    x, y, z, yaw_rad = eta.tolist()
    primitive.pose.position.x, primitive.pose.position.y, primitive.pose.position.z = x, y, z
    primitive.pose.orientation.z, primitive.pose.orientation.w = math.sin(yaw_rad / 2), math.cos(yaw_rad / 2)


def _line(entity: SceneEntity, points: Array, paint: Color, width_px: float, closed: bool = False) -> None:
    """A line through points (n, 3)."""
    kind = LinePrimitive.LINE_LOOP if closed else LinePrimitive.LINE_STRIP
    line = entity.lines.add(type=kind, thickness=width_px, scale_invariant=True, color=paint)
    line.pose.orientation.w = 1.0
    line.points.extend(_points(points.tolist()))


def _points(rows: Iterable[Any]) -> Iterable[Point3]:
    return (Point3(x=x, y=y, z=z) for x, y, z in rows)


def _colour(text: str, opacity: float) -> Color:
    r, g, b = (int(text[i : i + 2], 16) / 255.0 for i in (1, 3, 5))
    return Color(r=r, g=g, b=b, a=opacity)
