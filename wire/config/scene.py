"""The scene: pool, islands, path, formation, robots."""

from itertools import pairwise
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from wire.config.formation_shapes import Shape
from wire.config.vehicle import NotNegative, Positive
from wire.toml_loader import Section

Vec2 = tuple[float, float]
Vec3 = tuple[float, float, float]
Vec4 = tuple[float, float, float, float]


class PoolConfig(Section):
    """The basin. Its walls stand at +-length/2 and +-width/2 around the origin.

    Without `walls` the water has no sides, no floor and no surface that a plan must keep clear of; poses and trajectories
    still have to lie within `size_m`.
    """

    size_m: tuple[Positive, Positive, Positive]
    walls: bool = True


class Island(Section):
    """A round island: its foot stands on the floor, its head out of the water."""

    position_m: Vec2
    radius_m: Positive


class Circle(Section):
    """A circle around the origin, flown clockwise seen from above (heading grows), starting at its largest x."""

    kind: Literal["circle"]
    diameter_m: Positive
    lap_s: Positive
    depth_m: NotNegative
    slow: bool = False  # as for waypoints


class Waypoints(Section):
    """A natural cubic spline through waypoints (equations 12, 13), flown at constant speed."""

    kind: Literal["waypoints"]
    points_m: Annotated[tuple[Vec2, ...], Field(min_length=2)]
    speed_mps: Positive
    start_index: Annotated[int, Field(ge=0)] = 0
    depth_m: NotNegative = 0.0
    dive_mps: float = 0.0
    slow: bool = False  # slow down where a robot would exceed its limits, instead of refusing the plan
    stop: bool = False  # at the last waypoint, and stay; otherwise the run must end before the path does

    @model_validator(mode="after")
    def _starts_on_the_path(self) -> Self:
        if self.start_index >= len(self.points_m):
            raise ValueError(f"start_index = {self.start_index}: no such waypoint (allowed: 0 to {len(self.points_m) - 1})")
        return self


class Route(Section):
    """The shortest way through places in order that the whole formation can take: around islands, within the walls."""

    kind: Literal["route"]
    via_m: Annotated[tuple[Vec2, ...], Field(min_length=2)]  # of the formation's centre: from the first, to the last
    speed_mps: Positive
    depth_m: NotNegative = 0.0
    clearance_m: NotNegative = 0.1  # between hulls and whatever stands there
    smooth_m: Positive = 0.5  # over how long bends are spread, also those at places on the way; less where there is no room
    slow: bool = True  # as for waypoints
    stop: bool = True  # as for waypoints


PathSpec = Annotated[Circle | Waypoints | Route, Field(discriminator="kind")]


class Change(Section):
    """Another form on the way, taken smoothly: a named shape, or the same one larger and turned."""

    at_s: NotNegative  # when it begins, in the run's time
    over_s: Positive = 10.0
    shape: Shape | None = None
    spacing_m: Positive = 0.8  # of the new shape's nearest nodes, before `scale`
    scale: Positive = 1.0
    turn_rad: float = 0.0


class FormationConfig(Section):
    """Nodes around a virtual centre (14-16): `translate` keeps offsets constant in the pool frame, `rotate` turns them with
    the path's tangent (ambiguity A10).

    With `virtual-structure` every robot follows its own node, and the formation terms couple neighbours. With
    `leader-follower` only the leader follows its node; the others keep their offsets from wherever the leader is.
    """

    kind: Literal["virtual-structure", "leader-follower"] = "virtual-structure"
    leader: int | None = None  # its id; default: the first robot
    mode: Literal["translate", "rotate"] = "translate"
    scale: Positive = 1.0
    shape: Shape | None = None  # for robots without a node_m, in the file's order
    spacing_m: Positive = 0.8  # of the shape's nearest nodes, before `scale`
    changes: tuple[Change, ...] = ()

    @model_validator(mode="after")
    def _changes_one_after_the_other(self) -> Self:
        for before, after in pairwise(self.changes):
            if after.at_s < before.at_s + before.over_s:
                end_s = before.at_s + before.over_s
                raise ValueError(
                    f"changes: at_s = {after.at_s:g}: the one before ends at {end_s:g} s (allowed: that or later)"
                )
        return self


class RobotConfig(Section):
    """One robot: its node in the formation, or a path of its own, and where it starts.

    `start_offset` is [x m, y m, z m, yaw rad] from the first reference; `start` is a pose in the pool frame instead. Robots
    on one path are planned to stay apart; on different paths they may be planned through one another, and give way there.
    """

    id: Annotated[int, Field(ge=1, le=49)]
    node_m: Vec3
    path: PathSpec | None = None  # default: the formation's
    start_offset: Vec4 = (0.0, 0.0, 0.0, 0.0)
    start: Vec4 | None = None
    neighbours: tuple[int, ...] = ()
    urgent: bool = False
    marker_id: Annotated[int, Field(ge=0, le=49)] | None = None  # DICT_4X4_50 has no more

    @property
    def marker(self) -> int:
        """ArUco id on the robot's back: its own number unless the file says otherwise."""
        return self.id if self.marker_id is None else self.marker_id
