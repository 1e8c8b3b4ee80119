"""Cells of the grid, and the flights drawn in them. A cell changes one thing, or everything at once; the n-th flight of a
cell is always the same, whatever is flown besides."""

import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from shoal.config.experiment import load_experiment
from tests.flights.vehicles import VEHICLES, FileVehicle, ScaledVehicle, any_build, fastest_mps

PATHS = ("circle", "eight", "straight", "square")
RATES_HZ = (10, 20, 50)  # by turns: together with four paths, twelve flights have each pair once
POSE_NOISE_M, YAW_NOISE_RAD = 0.0015, 0.008  # as the localizer has in the simulated pool (docs/evidence/scenes.md)
MOST_OF_SPEED = 0.95  # current and path together need no more of a robot's speed
EIGHT_M = tuple((0.8 * math.sin(a), 0.35 * math.sin(2.0 * a)) for a in (math.pi / 8.0 * k for k in range(16)))
LAPS = 12  # of the eight: more than any flight is long
SQUARE_M = 1.5
TRAPS = frozenset({"held at the start", "held", "held in an encounter", "turned marker", "swept"})  # a robot should stop
ANY_VEHICLE = "any"
WIDE = ("pool.size_m=[200.0,200.0,10.0]", "pool.walls=false", "safety.join_within_m=5.0", "limits={}")


@dataclass(frozen=True)
class GridCell:
    """Flights with something in common. Speeds and currents are fractions of the robot's true speed."""

    about: str
    scenes: tuple[str, ...] = PATHS  # 1, 2 or 4 of them, by turns
    vehicle: str = "spherical"  # or a name of VEHICLES, or ANY_VEHICLE
    settings: tuple[str, ...] = ()
    noise: float = 1.0  # times that of ordinary poses
    current: tuple[float, float] = (0.0, 0.0)
    speed: tuple[float, float] = (0.1, 0.4)
    start_m: tuple[float, float] = (0.0, 0.15)
    start_turn_rad: float = 0.3
    path_s: float = 40.0
    holds: bool = True  # HOLD is ordered when the path's time is over
    trouble: str = ""
    amount: tuple[float, float] = (0.0, 0.0)  # of the trouble, in its own unit

    @property
    def is_trap(self) -> bool:
        """True if the robot cannot do what is asked, and should stop."""
        return self.trouble in TRAPS

    @property
    def is_calm(self) -> bool:
        """True if nothing but model, vehicle and ordinary noise keeps a robot from its place."""
        only_model = all("_error=" in setting for setting in self.settings)
        return self.holds and only_model and self.noise <= 1.0 and self.current == (0.0, 0.0) and self.trouble == ""


def wrong_model(mass: float, drag: float) -> tuple[str, ...]:
    """Settings: the true mass and drag are the vehicle file's, times 1 + these."""
    return f"sim.plant.mass_error={mass:g}", f"sim.plant.drag_error={drag:g}"


def _meeting(
    about: str, scene: str, trouble: str = "", amount: tuple[float, float] = (0.0, 0.0), path_s: float = 90.0
) -> GridCell:
    return GridCell(
        about, (scene,), speed=(0.2, 0.4), start_turn_rad=0.8, path_s=path_s, holds=False, trouble=trouble, amount=amount
    )


def _start(about: str, current: tuple[float, float], settings: tuple[str, ...] = ()) -> GridCell:
    return GridCell(
        about, ("straight", "circle"), settings=settings, current=current, start_m=(0.5, 2.0), start_turn_rad=math.pi,
        path_s=60.0, holds=False,
    )  # fmt: skip


def _trap(
    about: str, trouble: str, amount: tuple[float, float] = (0.0, 0.0), start_m: tuple[float, float] = (0.0, 0.15)
) -> GridCell:
    return GridCell(about, ("straight", "circle"), start_m=start_m, path_s=50.0, holds=False, trouble=trouble, amount=amount)


CELLS: dict[str, GridCell] = {
    "ordinary": GridCell("the shipped robot in still water"),
    **{f"vehicle-{name}": GridCell(f"vehicle {name}", vehicle=name) for name in VEHICLES},
    **{
        f"model{name}": GridCell(f"true mass {mass:+.0%}, drag {drag:+.0%}", settings=wrong_model(mass, drag))
        for name, mass, drag in (
            ("-30", -0.3, -0.3), ("+30", 0.3, 0.3), ("+100", 1.0, 1.0), ("-50", -0.5, -0.4), ("+30-30", 0.3, -0.3),
            ("-30+30", -0.3, 0.3),
        )
    },
    "current-0.3": GridCell("current of 0.1 to 0.3 of the speed, any direction", current=(0.1, 0.3)),
    "current-0.8": GridCell("current of 0.6 to 0.8 of the speed, any direction", current=(0.6, 0.8)),
    "reverse": GridCell(
        "current of 0.1 to 0.3 that turns round within 30 s", current=(0.1, 0.3), path_s=60.0, trouble="reverse"
    ),
    "gusts": GridCell("gusts of 3 cm/s, 8 s", settings=("sim.plant.gust_mps=0.03", "sim.plant.gust_s=8.0")),
    "waves": GridCell("waves of 5 cm, 2 s", settings=("sim.plant.waves.height_m=0.05", "sim.plant.waves.period_s=2.0")),
    "disturbed": GridCell(
        "sinusoidal force of a quarter of the thrust, 0.02 Hz, no moment: that would look like a broken thruster",
        settings=("sim.plant.disturbance_wrench=[1.5,0.5,0.0]", "sim.plant.disturbance_hz=0.02"),
    ),
    "noise-0": GridCell("poses without noise", noise=0.0),
    "noise-10": GridCell("ten times the pose noise", noise=10.0),
    "gaps": GridCell(
        "no pose for 0.15 s every 3 s", settings=("safety.pose_hold_s=0.245",), trouble="gaps", amount=(0.15, 0.15)
    ),
    "gaps-hold": GridCell(
        "no pose for 0.3 s every 15 s: HOLD, then RESUME", path_s=60.0, trouble="gaps, resumed", amount=(0.3, 0.3)
    ),
    "start": _start("starts 0.5 to 2 m off, any heading", (0.0, 0.0)),
    "start-current-0.3": _start("the same in a current of 0.1 to 0.3", (0.1, 0.3)),
    "start-current-0.8": _start("the same in a current of 0.6 to 0.8", (0.6, 0.8)),
    "start-model-50": _start("the same, true mass -50 %, drag -40 %", (0.0, 0.0), wrong_model(-0.5, -0.4)),
    "start-model+100": _start("the same, true mass and drag +100 %", (0.0, 0.0), wrong_model(1.0, 1.0)),
    "mixed": GridCell(
        "any vehicle, model -50 to +100 %, noise x 1 to x 10, current up to 0.8, starts up to 2 m off",
        vehicle=ANY_VEHICLE, current=(0.0, 0.8), start_m=(0.0, 2.0), start_turn_rad=math.pi, path_s=70.0,
    ),
    "meet-2": _meeting("two robots through one point", "crossing-2"),
    "meet-4": _meeting("four robots through one point", "crossing-4"),
    "meet-8": _meeting("eight robots through one point", "crossing-8", path_s=100.0),
    "meet-overtake": _meeting("a robot overtakes one at 0.3 to 0.5 of its speed", "overtake"),
    "meet-circle": _meeting("a robot crosses another one's circle", "crossed circle"),
    "meet-4-lost": _meeting("four through one point, 30 % of the plans lost", "crossing-4", "plans lost", (0.3, 0.3)),
    "meet-8-lost": _meeting("eight, 30 % of the plans lost", "crossing-8", "plans lost", (0.3, 0.3), path_s=100.0),
    "meet-2-adrift": _meeting("two through one point, one without thrust before it", "crossing-2", "thrustless", (1.0, 1.6)),
    "meet-4-adrift": _meeting("four through one point, one without thrust before it", "crossing-4", "thrustless", (1.0, 1.6)),
    "held-start": _trap("held fast from the start, up to 0.4 m off", "held at the start", start_m=(0.0, 0.4)),
    "held-path": _trap("held fast after 10 to 15 s", "held", (10.0, 15.0)),
    "held-meet": _meeting("held fast while two meet", "crossing-2", "held in an encounter", (1.0, 1.3)),
    "turned-20": _trap("marker turned by 20 degrees", "turned marker", (20.0, 20.0)),
    "turned-57": _trap("marker turned by 57 degrees", "turned marker", (57.0, 57.0)),
    "turned-90": _trap("marker turned by 90 degrees", "turned marker", (90.0, 90.0)),
    "turned-180": _trap("marker turned by 180 degrees", "turned marker", (180.0, 180.0)),
    "swept": _trap("after 10 s a current of 1.3 to 1.8 of the speed", "swept", (1.3, 1.8)),
}  # fmt: skip


@dataclass(frozen=True)
class FlightPlan:
    """One flight of a cell, drawn."""

    cell: str
    number: int
    scene: str
    rate_hz: int
    settings: tuple[str, ...]  # of the experiment `straight`
    fastest_mps: float  # the robot's true speed
    speed_mps: float  # of the path
    current_mps: tuple[float, float, float]
    amount: float

    @property
    def of(self) -> GridCell:
        """The flight's cell."""
        return CELLS[self.cell]


def draw(name: str, number: int, overrides: Sequence[str] = ()) -> FlightPlan:
    """The flight of a number in a cell, with settings laid over its own. Raises ConfigError for settings that do not exist."""
    cell = CELLS[name]
    random = np.random.default_rng([number, zlib.crc32(name.encode())])
    scene, rate_hz = cell.scenes[number % len(cell.scenes)], RATES_HZ[number % len(RATES_HZ)]
    noise, model = cell.noise, cell.settings
    if cell.vehicle == ANY_VEHICLE:
        noise, model = float(random.uniform(1.0, 10.0)), wrong_model(*np.round(random.uniform(-0.5, 1.0, 2), 3).tolist())
    build = any_build(random) if cell.vehicle == ANY_VEHICLE else VEHICLES.get(cell.vehicle)
    settings = [
        *WIDE,
        f"controller.period_s={1.0 / rate_hz:g}",
        f"seed={int(random.integers(1, 2**31))}",
        *_build(build),
        *model,
    ]
    settings += [
        f"sim.numeric.pose_noise_m={noise * POSE_NOISE_M:.5g}",
        f"sim.numeric.yaw_noise_rad={noise * YAW_NOISE_RAD:.5g}",
    ]
    plain = load_experiment("straight", settings)
    fastest = fastest_mps(plain.vehicle, plain.sim.plant.mass_error, plain.sim.plant.drag_error)
    strength, direction = random.uniform(*cell.current), random.uniform(-math.pi, math.pi)
    speed = min(random.uniform(*cell.speed), MOST_OF_SPEED - strength) * fastest
    current = strength * fastest * math.cos(direction), strength * fastest * math.sin(direction), 0.0
    settings += [f"sim.plant.current_mps=[{current[0]:.5g},{current[1]:.5g},0.0]", f"duration_s={cell.path_s:g}"]
    settings += _scene(cell, scene, float(f"{speed:.4g}"), random)
    amount = float(random.uniform(*cell.amount))
    return FlightPlan(name, number, scene, rate_hz, (*settings, *overrides), fastest, speed, current, amount)


def _build(build: ScaledVehicle | FileVehicle | None) -> list[str]:
    return build.settings() if build is not None else []


def _scene(cell: GridCell, scene: str, speed_mps: float, random: np.random.Generator) -> list[str]:
    """Settings: paths and robots of a scene, with the robots' starts."""
    if scene.startswith("crossing-"):
        paths = _through_one_point(int(scene.removeprefix("crossing-")), speed_mps, random)
    elif scene == "overtake":
        slow_mps = speed_mps * random.uniform(0.3, 0.5)
        aside_m = random.uniform(-0.2, 0.2)
        paths = [
            _line([(-3.0, aside_m), (9.0, aside_m)], speed_mps, "true"), _line([(-1.6, 0.0), (6.0, 0.0)], slow_mps, "true")
        ]  # fmt: skip
    elif scene == "crossed circle":
        aside_m = random.uniform(-1.0, 1.0)
        paths = [_line([(-4.0, aside_m), (4.0, aside_m)], speed_mps, "true"), _circle(2.4, speed_mps)]
    elif scene == "circle":
        paths = [_circle(random.uniform(0.6, 2.4), speed_mps)]
    elif scene == "eight":
        size = random.uniform(1.0, 1.5)
        points = ",".join(f"[{size * x:.4f},{size * y:.4f}]" for x, y in EIGHT_M)
        path = f'{{kind="waypoints",points_m=[{points}],laps={LAPS},speed_mps={speed_mps:.4g},depth_m=1.0,slow=true}}'
        paths = [path]
    else:  # the square's own corners are laid over a line: flights.py
        paths = [_line([(0.0, 0.0), (90.0, 0.0)], speed_mps, "false")]
    robots = []
    for k, path in enumerate(paths, start=1):
        off_m, bearing = random.uniform(*cell.start_m), random.uniform(-math.pi, math.pi)
        turn = random.uniform(-cell.start_turn_rad, cell.start_turn_rad)
        offset = f"[{off_m * math.cos(bearing):.4f},{off_m * math.sin(bearing):.4f},0.0,{turn:.4f}]"
        robots.append(f"{{id={k},node_m=[0.0,0.0,0.0],path={path},start_offset={offset}}}")
    return [f"path={paths[0]}", f"robots=[{','.join(robots)}]"]


def _circle(diameter_m: float, speed_mps: float) -> str:
    return f'{{kind="circle",diameter_m={diameter_m:.4f},lap_s={math.pi * diameter_m / speed_mps:.4f},depth_m=1.0,slow=true}}'


def _line(points_m: Sequence[tuple[float, float]], speed_mps: float, stop: str) -> str:
    points = ",".join(f"[{x:.4f},{y:.4f}]" for x, y in points_m)
    return f'{{kind="waypoints",points_m=[{points}],speed_mps={speed_mps:.4g},depth_m=1.0,slow=true,stop={stop}}}'


def _through_one_point(count: int, speed_mps: float, random: np.random.Generator) -> list[str]:
    """Straight paths through the origin that begin around it, within 0.3 m of one distance."""
    least_m, turn = (1.6 if count <= 4 else 2.4), random.uniform(-math.pi, math.pi)
    angles = (
        [turn, turn + random.uniform(1.0, 2.1)] if count == 2 else [turn + 2.0 * math.pi * k / count for k in range(count)]
    )
    paths = []
    for angle in angles:
        distance = least_m + random.uniform(0.0, 0.3)
        x, y = distance * math.cos(angle), distance * math.sin(angle)
        paths.append(_line([(x, y), (-x, -y)], speed_mps, "true"))
    return paths
