"""The programs of a run in software, with their arguments, and the checks before they are started. Pure."""

from dataclasses import dataclass
from pathlib import Path

from shoal.config.experiment import Experiment
from shoal.config.fault_injection import KINDS, OF_PROCESSES
from shoal.config.perception import NamedCamera
from shoal.errors import ConfigError
from shoal.messages.topics import localizer_name
from sim_bridge import fault_schedule

LEAST_MARKER_PX = 16  # px, least side of a marker that can be read: two per cell and a margin
GIVE_UP_S = 300.0  # s of the run's own time without progress, of a run that nobody attends: a drifter crosses a pool in 120
NODES = {  # commands of programs, and those of sim_bridge.lockstep that run the same nodes
    ("groundstation", "run"): "station", ("robot_agent", "run"): "agent",
    ("localizer", "run"): "localizer", ("localizer", "fuse"): "fuse",
}  # fmt: skip
REAL_TIME_PACE = 1.0  # times real time: the most that a run gets without --lockstep, however fast the machine
BLIND = "Fly without the camera: --poses"


@dataclass(frozen=True)
class Program:
    """A process: its name in the fleet, its module, its arguments."""

    name: str
    module: str
    arguments: tuple[str, ...]
    inherits: tuple[int, ...] = ()  # descriptors of open files


@dataclass(frozen=True)
class RunOptions:
    """Options of a run: `page` is the address of the operator's page (host:port), `manual` leaves the mission to the
    operator, `poses` replaces camera and localizer by the simulator, `keys` is a ring with which all speak TLS,
    `signed` signs the boards' links, `one_process` runs all nodes in the launcher's process. In lockstep the simulator owns
    time, and `pace` is the most that it may be faster than the clock (None: as fast as it goes); otherwise all live by the
    wall clock."""

    lockstep: bool = False
    page: str | None = None
    manual: bool = False
    poses: bool = False
    keys: Path | None = None
    signed: bool = False
    one_process: bool = False
    pace: float | None = None


def pace_of(lockstep: bool, real_time: bool, one_process: bool, pace: float | None) -> float | None:
    """The pace of a run whose command line has these options: real time at most, with --lockstep as fast as it goes, unless
    --pace says otherwise. None: no limit, or the wall clock. Raises ConfigError for options that exclude each other."""
    if not real_time:
        return pace if pace is not None or lockstep else REAL_TIME_PACE
    for option, given, why in (
        ("--lockstep", lockstep, "the wall clock waits for nobody"),
        ("--pace", pace is not None, "the wall clock has a pace of its own"),
        ("--one-process", one_process, "one process cannot keep up with the wall clock"),
    ):
        if given:
            raise ConfigError(f"{option}: {why} (allowed: without --real-time)")
    return None


def time_in_words(options: RunOptions) -> str:
    """The timing of a run in words."""
    if not options.lockstep:
        return "by the wall clock"
    if options.pace is None:
        words = "in simulated time, as fast as the machine can"
    elif options.pace == REAL_TIME_PACE:
        words = "in real time, slower while the machine is busy"
    else:
        words = f"at {options.pace:g} x real time, slower while the machine is busy"
    return f"{words}, in one process" if options.one_process else words


def check(experiment: Experiment, options: RunOptions) -> None:
    """Raise ConfigError if the experiment cannot be flown with these options."""
    if not options.poses:
        if not experiment.localizer.uses_camera:
            raise ConfigError(f"localizer.uses_camera = false: no camera locates these robots. {BLIND}")
        check_sight(experiment)
    if options.one_process:
        _check_one_process(options)
    if options.lockstep:
        _ = experiment.plant_steps  # raises where they do not keep step
        fault_schedule.require_kinds(
            experiment,
            tuple(kind for kind in KINDS if kind not in OF_PROCESSES),
            f"{'--one-process has none to break' if options.one_process else 'processes break by the wall clock'}: it needs "
            "--real-time",
        )
    else:
        fault_schedule.require_kinds(
            experiment,
            tuple(kind for kind in KINDS if kind != "radio"),
            "radios are the simulated time's: without --real-time",
        )
    if options.poses:
        fault_schedule.require_kinds(
            experiment,
            ("water gust", *(kind for kind in KINDS if kind not in ("camera", "marker", "water"))),
            "--poses needs no camera",
        )


def _check_one_process(options: RunOptions) -> None:
    """Raise ConfigError for options that mean nothing without processes, or without a network between them."""
    if options.keys is not None or options.signed:
        option = "--keys" if options.keys is not None else "--signed"
        raise ConfigError(f"{option}: with --one-process there is no link that could be listened to (allowed: one of them)")
    if options.manual and options.page is None:
        raise ConfigError("--manual: with --one-process only the page reaches the station (allowed: without --no-web)")


def check_sight(experiment: Experiment) -> None:
    """Raise ConfigError if the localizer could read no marker. The station's plan checks that robots stay in the picture."""
    camera = min(experiment.all_cameras, key=lambda camera: camera.px_per_m)
    where = f"cameras.{experiment.cameras.index(camera)}" if isinstance(camera, NamedCamera) else "camera"
    wide_px = camera.px_per_m * experiment.vehicle.marker.side_m
    if experiment.localizer.markers and wide_px < LEAST_MARKER_PX:
        raise ConfigError(
            f"{where}.position_m.2 = {camera.position_m[2]:g}: from there markers are {wide_px:.0f} pixels wide, and none "
            f"can be read (allowed: from {LEAST_MARKER_PX} pixels on). {BLIND}"
        )


def programs(
    robots: tuple[int, ...],
    options: RunOptions,
    run_dir: Path,
    address: str,
    ports: int,
    boards: Path | None = None,
    frame_ring: int | None = None,
    cameras: tuple[str, ...] = (),
) -> list[Program]:
    """The programs to start, the station first: it is the router at `address`, and the others wait for it.

    The experiment is in `run_dir`; the board of robot N is at UDP port `ports` + N. The folder `boards` holds the keys of
    their links. `frame_ring` is the descriptor of the ring of frames that simulator and localizer share; without one frames
    go over the network. `cameras` are the names of several.
    """
    common = [str(run_dir / "experiment.toml"), *(["--keys", str(options.keys)] if options.keys is not None else [])]
    client = [*common, "--station", address]
    station = [*common, "--run-dir", str(run_dir), "--listen", address]
    station += ["--no-web"] if options.page is None else ["--web", options.page]
    station += [] if options.manual else ["--auto", "--give-up", f"{GIVE_UP_S:g}"]
    pool = ["pool", *client, "--ports", str(ports), *(["--poses"] if options.poses else [])]
    pool += ["--lockstep"] if options.lockstep else []
    pool += ["--pace", str(options.pace)] if options.pace is not None else []
    pool += ["--boards", str(boards)] if boards is not None else []
    inherits = () if frame_ring is None else (frame_ring,)
    ring = [part for descriptor in inherits for part in ("--frame-ring", str(descriptor))]

    def program(name: str, module: str, command: str, words: list[str], inherits: tuple[int, ...] = ()) -> Program:
        """A program by the wall clock, or its node by the simulator's."""
        if options.lockstep:
            return Program(name, "sim_bridge.lockstep", (NODES[module, command], *words), inherits)
        return Program(name, module, (command, *words), inherits)

    no_report = [] if options.lockstep else ["--no-report"]  # the launcher writes it
    programs = [
        program("groundstation", "groundstation", "run", [*station, *no_report]),
        Program("sim-bridge", "sim_bridge", (*pool, *ring), inherits),
    ]
    if not options.poses:
        for camera in cameras or ("",):
            own = ("--camera", camera) if camera else ()
            programs.append(program(localizer_name(camera), "localizer", "run", [*client, *own, *ring], inherits))
        if cameras:
            programs.append(program(localizer_name(""), "localizer", "fuse", client))
    for robot in robots:
        link = ["--robot", str(robot), "--link", f"udp:127.0.0.1:{ports + robot}"]
        link += ["--link-key", str(boards / f"robot-{robot}.key")] if boards is not None else []
        programs.append(program(f"agent-{robot}", "robot_agent", "run", [*client, *link]))
    return programs
