"""The scene: pool, islands, path, formation, robots."""

import math
from itertools import pairwise
from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from shoal.config import LARGEST_ROBOT
from shoal.config.formation_shapes import FORM_USAGE, SHAPES, Shape
from shoal.config.loader import Section
from shoal.config.vehicle import NotNegative, Positive
from shoal.frames import Array

Vec2 = tuple[float, float]
Vec3 = tuple[float, float, float]
Vec4 = tuple[float, float, float, float]

AT_SURFACE_M = 1e-6  # a path at depth 0, rounded
MOST_WAYPOINTS = 30_000  # of a path, all laps together: no file has room for more


class PoolConfig(Section):
    """The basin. Its walls stand at +-length/2 and +-width/2 around the origin.

    Poses and trajectories have to lie within `size_m`, also in open water.
    """

    size_m: tuple[Positive, Positive, Positive]
    """Length (x), width (y) and depth (z)."""
    walls: bool = True
    """Plans keep clear of sides, floor and surface. False: open water."""

    def holds(self, position_m: Array) -> NDArray[np.bool_]:
        """True (n,) for centres (n, 3) that may be on a trajectory. In open water there is no surface either."""
        length_m, width_m, depth_m = self.size_m
        inside = (np.abs(position_m) <= [0.5 * length_m, 0.5 * width_m, depth_m]).all(axis=1)
        return np.asarray(inside & (position_m[:, 2] >= -AT_SURFACE_M) if self.walls else inside)


class Island(Section):
    """A round island, from the floor to above the water."""

    position_m: Vec2
    """Centre, x and y."""
    radius_m: Positive
    """Radius."""


class Circle(Section):
    """A circle around the origin, flown clockwise seen from above (heading grows), starting at its largest x."""

    kind: Literal["circle"]
    """A circle around the origin."""
    diameter_m: Positive
    """Diameter of the formation centre's circle."""
    lap_s: Positive
    """Time for one lap."""
    depth_m: NotNegative
    """Depth of the formation's centre."""
    slow: bool = False
    """Slow down where a robot would exceed its limits; false: refuse the plan."""


class Waypoints(Section):
    """A way through waypoints: a natural cubic spline (equations 12, 13) flown at constant speed, or straight sides."""

    kind: Literal["waypoints"]
    """A way through waypoints."""
    points_m: Annotated[tuple[Vec2, ...], Field(min_length=2)]
    """Waypoints x, y of the formation's centre, in order."""
    speed_mps: Positive
    """Speed of the formation's centre."""
    laps: Annotated[int, Field(ge=1, le=1000)] = 1
    """Number of laps. With more than one, the last waypoint leads back to the first."""
    start_index: Annotated[int, Field(ge=0)] = 0
    """Waypoint at which the flight begins, from 0."""
    depth_m: NotNegative = 0.0
    """Depth of the formation's centre at the start."""
    dive_mps: float = 0.0
    """Rate at which the depth grows."""
    slow: bool = False
    """Slow down where a robot would exceed its limits; false: refuse the plan."""
    stop: bool = False
    """Stop at the last waypoint. False: the run must end before the path does."""
    corner: Literal["smooth", "round", "stop"] = "smooth"
    """One smooth curve through all waypoints; straight sides with round corners; or a stop and a turn at each corner."""
    corner_m: Positive = 0.5
    """Distance before a round corner at which the path leaves its side; less between short sides."""

    @model_validator(mode="after")
    def _starts_on_the_path(self) -> Self:
        if self.start_index >= len(self.points_m):
            raise ValueError(f"start_index = {self.start_index}: no such waypoint (allowed: 0 to {len(self.points_m) - 1})")
        if self.corner == "stop" and self.dive_mps != 0.0:
            raise ValueError(f"dive_mps = {self.dive_mps:g}: a path that stops at its corners is level (allowed: 0)")
        if len(self.points_m) * self.laps > MOST_WAYPOINTS:
            raise ValueError(f"laps = {self.laps}: {len(self.points_m)} waypoints so often are more than {MOST_WAYPOINTS}")
        return self

    @property
    def all_points_m(self) -> tuple[Vec2, ...]:
        """The waypoints of all laps, in the order in which they are flown."""
        return self.points_m if self.laps == 1 else self.points_m * self.laps + self.points_m[:1]


class Route(Section):
    """The shortest way through places in order that the whole formation can take: around islands, within the walls."""

    kind: Literal["route"]
    """The shortest clear way through places."""
    via_m: Annotated[tuple[Vec2, ...], Field(min_length=2)]
    """Places x, y of the formation's centre, from the first to the last."""
    speed_mps: Positive
    """Speed of the formation's centre."""
    depth_m: NotNegative = 0.0
    """Depth of the formation's centre."""
    clearance_m: NotNegative = 0.1
    """Distance between hulls and walls or islands."""
    smooth_m: Positive = 0.5
    """Length over which bends are spread; less where there is no room."""
    slow: bool = True
    """Slow down where a robot would exceed its limits; false: refuse the plan."""
    stop: bool = True
    """Stop at the last place. False: the run must end before the path does."""


PathSpec = Annotated[Circle | Waypoints | Route, Field(discriminator="kind")]


class Change(Section):
    """Another form on the way: a named shape, or the present one larger and turned."""

    at_s: Annotated[NotNegative, Field(examples=[30.0])]
    """Time in the run at which the change begins."""
    over_s: Positive = 10.0
    """Duration of the change."""
    shape: Annotated[Shape | None, Field(examples=["column"])] = None
    """The new shape; left out: the same one."""
    spacing_m: Positive = 0.8
    """Distance of the new shape's nearest nodes, before `scale`."""
    scale: Positive = 1.0
    """Factor on the nodes' offsets."""
    turn_rad: float = 0.0
    """Turn of the nodes about the centre."""
    order: Annotated[tuple[int, ...], Field(examples=[(2, 1)])] = ()
    """Ids of the robots in the order of the places. Left out: by shortest distance to a new shape, else as before."""


PACES_S = (8.0, 14.0, 25.0, 45.0)  # of a change whose duration nobody gave; the first that can be flown


def read_form(text: str, at_s: float) -> tuple[Change, ...]:
    """The change of form in `line 0.8 turn 30`, at each pace that may be tried. Raises ValueError for other text."""
    words = text.split()
    names = ["turn", "scale", "order", "over"]
    shape = next((each for each in SHAPES if words and words[0] == each), None)
    if shape is not None:
        words.pop(0)
        if words and words[0] not in names:  # the number behind a shape needs no name
            words.insert(0, "spacing")
        names.append("spacing")
    values: dict[str, float] = {}
    order: tuple[int, ...] = ()
    for name, number in zip(words[::2], [*words[1::2], ""], strict=False):
        if name not in names or name in values or (name == "order" and order):
            raise ValueError(f"{name!r}: must read {FORM_USAGE}, with a shape of {', '.join(SHAPES)}")
        if name == "order":
            order = _form_order(number)
        else:
            values[name] = _form_number(name, number)
    if shape is None and not order and not values.keys() - {"over"}:
        raise ValueError(f"which form? It reads {FORM_USAGE}, with a shape of {', '.join(SHAPES)}")
    change = Change(
        at_s=at_s,
        shape=shape,
        spacing_m=values.get("spacing", 0.8),
        scale=values.get("scale", 1.0),
        turn_rad=math.radians(values.get("turn", 0.0)),
        order=order,
    )
    paces = (values["over"],) if "over" in values else PACES_S
    return tuple(change.model_copy(update={"over_s": over_s}) for over_s in paces)


def _form_order(text: str) -> tuple[int, ...]:
    """Parse the robots' numbers of a change of formation, in the order of their nodes. Raises ValueError."""
    ids = tuple(int(word) if word.isascii() and word.isdigit() and len(word) < 4 else 0 for word in text.split(","))
    if 0 in ids or len(set(ids)) < len(ids):
        raise ValueError(f"order {text}: must be the robots' numbers, each once, with commas: 2,1,3")
    return ids


def _form_number(name: str, text: str) -> float:
    """Parse the number of a change of formation: spacing, turn, scale or duration. Raises ValueError."""
    least, most = {"spacing": (0.1, 20.0), "turn": (-360.0, 360.0), "scale": (0.1, 10.0), "over": (1.0, 600.0)}[name]
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not least <= value <= most:
        raise ValueError(f"{name} {text}: must be a number, {least:g} to {most:g}")
    return value


class FormationConfig(Section):
    """Nodes around a virtual centre (14-16): `translate` keeps offsets constant in the pool frame, `rotate` turns them with
    the path's tangent (ambiguity A10).

    With `virtual-structure` every robot follows its own node, and the formation terms couple neighbours. With
    `leader-follower` only the leader follows its node; the others keep their offsets from wherever the leader is.
    """

    kind: Literal["virtual-structure", "leader-follower"] = "virtual-structure"
    """Robots follow their own nodes, or keep their offsets from the leader."""
    leader: Annotated[int | None, Field(examples=[2])] = None
    """Id of the leader; left out: the first robot."""
    mode: Literal["translate", "rotate"] = "translate"
    """Offsets keep their direction in the pool, or turn with the path."""
    scale: Positive = 1.0
    """Factor on all nodes' offsets, L = l I of (15)."""
    shape: Shape | None = None
    """Shape for robots without a node_m, in the file's order."""
    spacing_m: Positive = 0.8
    """Distance of the shape's nearest nodes, before `scale`."""
    changes: tuple[Change, ...] = ()
    """Changes of the formation on the way, one after the other."""

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

    id: Annotated[int, Field(ge=1, le=LARGEST_ROBOT)]
    """Number of the robot."""
    node_m: Vec3
    """Node in the formation, from its centre. With formation.shape it may be left out."""
    path: Annotated[
        PathSpec | None, Field(examples=[{"kind": "circle", "diameter_m": 0.5, "lap_s": 60.0, "depth_m": 0.3}])
    ] = None
    """A path of its own, in place of the formation's."""
    start_offset: Vec4 = (0.0, 0.0, 0.0, 0.0)
    """Start, from the first reference: x, y, z in m and yaw in rad."""
    start: Vec4 | None = None
    """Start in the pool frame instead: x, y, z in m and yaw in rad."""
    neighbours: tuple[int, ...] = ()
    """Ids of the robots whose plans enter this robot's formation term."""
    urgent: bool = False
    """Has priority: others give way to it."""
    marker_id: Annotated[int | None, Field(ge=0, le=49, examples=[7])] = None
    """Id of the marker on its back; left out: its id."""
    depth_offset_m: Annotated[float, Field(ge=-1, le=1)] = 0.0
    """Measured depth minus true depth of the centre; subtracted before anything uses it."""

    @property
    def marker(self) -> int:
        """ArUco id on the robot's back: its own number unless the file says otherwise."""
        return self.id if self.marker_id is None else self.marker_id
