"""SHELL: software in the loop: starts every process of an experiment on this machine, watches, ends and reports.

The processes are the ones that run in the pool, started as a user would start them; only the pool is simulated.
"""

import contextlib
import json
import os
import resource
import shlex
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from pathlib import Path

from rich.console import Console

from shoal.bus import frame_ring
from shoal.bus.bus import Bus
from shoal.bus.endpoint import parse_address
from shoal.bus.network import endpoint
from shoal.bus.zenoh_transport import ZenohTransport
from shoal.config.experiment import Experiment, dump_experiment
from shoal.config.fault_injection import KINDS
from shoal.errors import ConfigError, Unreached
from shoal.mavlink.signing_key import new_key
from shoal.messages.topics import Role, process_name
from shoal.runtime.output_files import PAGE_OPEN, replace_text
from shoal.runtime.runtime import Stop
from shoal.system import programs
from sim_bridge import fault_schedule
from sim_bridge.sil import commands
from sim_bridge.sil.commands import Program, RunOptions, time_in_words
from sim_bridge.sil.fault_injector import ProcessFaultInjector
from sim_bridge.sil.monitor import Monitor
from sim_bridge.sil.ports import free_base_port, free_port
from sim_bridge.sil.processes import Child, Children

START_WITHIN_S = 180.0  # s for the station to listen; on a starved machine a program takes a minute to load
LOOK_EVERY_S = 0.2
SECRETS = "shoal-links-"  # begins the names of folders with the keys of a run's links; then the launcher's process
STALLED_S = 180.0  # s without a new heartbeat of the station after which the run is ended as stuck
VERDICTS = {"passed": "green", "failed": "red", "not judged": "yellow"}  # their colours
INTERRUPTED_WITHIN_S = 15.0  # s for the station to close its log after a Ctrl-C, also on a starved machine
SAFE_WITHIN_S = 1.0  # s in which robots bring themselves to rest when the station has gone


def run(experiment: Experiment, run_dir: Path, options: RunOptions, stop: Stop, console: Console) -> int:
    """Run an experiment with all its processes, after `commands.check`. Returns the exit code: 0 passed, 1 failed or not
    judged, 2 refused by the station, 130 interrupted."""
    write_experiment(experiment, run_dir)
    if not hasattr(resource, "prlimit"):
        fault_schedule.require_kinds(
            experiment, tuple(kind for kind in KINDS if kind != "disk"), "only Linux can feign a full disk"
        )
    clocks = frozenset(fault.broken.process for fault in experiment.sim.faults if fault.broken.kind == "clock")
    children = Children(run_dir / "logs", clocks)
    problems: list[str] = []
    secrets = _secret_folder() if options.signed else None  # a run's folder all may read
    boards = _link_keys(Path(secrets.name), experiment.robot_ids) if secrets is not None else None
    try:
        address, ports = f"tcp/127.0.0.1:{free_port()}", free_base_port(experiment.robot_ids)
        ring = None if options.poses else frame_ring.create(tuple(camera.size_px for camera in experiment.all_cameras))
        started = commands.programs(
            experiment.robot_ids, options, run_dir, address, ports, boards, ring, experiment.camera_names
        )
        console.print(
            f"station: {address} (groundstation stop, mission, gains and end find it)", soft_wrap=True, highlight=False
        )
        station, came_up = _start_all(children, started, address, stop)
        if came_up and options.page is not None and _listens(f"tcp/{options.page}", station, stop):
            tell_page(options.page, console)
        if ring is not None:
            os.close(ring)  # the processes have it; it is gone with the last of them
        if came_up:
            where = endpoint(address, process_name(Role.SIMULATOR), options.keys, lossless=options.lockstep)
            try:
                with Bus(ZenohTransport(where, lambda: stop.requested or station.exit_code is not None)) as bus:
                    injector = ProcessFaultInjector(experiment, children, bus)
                    monitor = Monitor(experiment, bus, options.pace)
                    problems = _watch(children, station, monitor, injector, options.lockstep, stop, console)
            except Unreached:  # interrupted, or the station is gone: both are told below
                came_up = False
        if stop.interrupted:
            _interrupt(station)
        mission_failed = not came_up or station.exit_code != 0
        refused = station.exit_code == 2 and not (run_dir / "run.mcap").exists()
        if not stop.requested and (not came_up or station.exit_code not in (None, 0, 1)):
            problems.append(station.log.read_text(encoding="utf-8").strip() if refused else station.explain())
            print_error(console, problems[-1])
            (run_dir / PAGE_OPEN).touch()  # it cannot say any more whether its page was open
    finally:
        children.stop()
        if secrets is not None:
            secrets.cleanup()
    if stop.requested and not (run_dir / "run.mcap").exists():
        shutil.rmtree(run_dir)
        console.print("interrupted: nothing was flown, and no folder is left")
        return 130
    if refused and not stop.requested:
        return nothing_flown(run_dir, console)
    code = conclude(run_dir, came_up, not mission_failed and not problems, stop, console)
    return 2 if code == 1 and station.exit_code == 2 else code


def write_experiment(experiment: Experiment, run_dir: Path) -> None:
    """Begin a run's folder with the experiment's file."""
    run_dir.mkdir(parents=True, exist_ok=True)
    replace_text(run_dir / "experiment.toml", dump_experiment(experiment))


def nothing_flown(run_dir: Path, console: Console) -> int:
    """Remove the folder of a run that the station has refused. Returns the exit code."""
    shutil.rmtree(run_dir)
    console.print("refused: nothing was flown, and no folder is left", style="red")
    return 2


def conclude(run_dir: Path, came_up: bool, succeeded: bool, stop: Stop, console: Console) -> int:
    """Report, and print the verdict. `came_up`: the station made a log. Returns the exit code: 0 passed, 1 failed or not
    judged, 130 interrupted."""
    if stop.requested:
        console.print("interrupted: every process is stopped")
    passed = came_up and report(run_dir, console) and succeeded
    if stop.requested:
        return 130
    sentence = verdict(run_dir, passed)
    where = "" if passed else f" (what each process said: {run_dir / 'logs'})"
    console.print(sentence + where, style=VERDICTS[sentence], highlight=False, soft_wrap=True)
    return 0 if passed else 1


def verdict(run_dir: Path, passed: bool) -> str:
    """The verdict in words: "failed" also for a run whose result passed, but not all of its processes."""
    result = json.loads((run_dir / "result.json").read_text(encoding="utf-8")) if (run_dir / "result.json").exists() else {}
    return "passed" if passed else "not judged" if result.get("verdict") == "not judged" else "failed"


def dry_run(experiment: Experiment, run_dir: Path, options: RunOptions, console: Console) -> int:
    """Print what a run would fly and start, and leave no files behind. Returns 0; raises ConfigError if it cannot be
    flown. The station's own dry run checks the plan."""
    address, ports = f"tcp/127.0.0.1:{free_port()}", free_base_port(experiment.robot_ids)
    keys = Path("LINK-KEYS") if options.signed else None
    started = commands.programs(experiment.robot_ids, options, run_dir, address, ports, keys, cameras=experiment.camera_names)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "experiment.toml"
        replace_text(file, dump_experiment(experiment))
        ring = ["--keys", str(options.keys)] if options.keys is not None else []
        words = ["run", str(file), "--run-dir", str(run_dir), "--listen", address, "--no-web", *ring, "--dry-run"]
        result = programs.ask("groundstation", words)
    if result.returncode != 0:
        raise ConfigError(result.stderr.strip().replace(f"{file}: ", ""))
    console.print(result.stdout.strip(), soft_wrap=True, highlight=False)
    how = time_in_words(options)
    console.print(
        f"{experiment.duration_s:g} s {how}; seed {experiment.seed}; it would start:", soft_wrap=True, highlight=False
    )
    if options.one_process:
        console.print(f"  nothing: {', '.join(program.name for program in started)} run in this process", soft_wrap=True)
        started = []
    for program in started:
        command = shlex.join(["python", "-m", program.module, *program.arguments])
        console.print(f"  {program.name:13} {command}", soft_wrap=True, highlight=False)
    for fault in experiment.sim.faults:
        console.print(f"it would break, at {fault.at_s:g} s: {fault.what}", soft_wrap=True, highlight=False)
    return 0


def tell_page(address: str, console: Console) -> None:
    """Print where the operator's page is. To be called when it answers there: people click at once."""
    console.print(f"operator page: http://{address}/", soft_wrap=True)


def print_error(console: Console, text: str) -> None:
    console.print(text, style="red", highlight=False, soft_wrap=True)


def _start_all(children: Children, programs: list[Program], address: str, stop: Stop) -> tuple[Child, bool]:
    """Start the station, and the others when it listens. Returns the station, and True if it listens."""
    first, *others = programs
    station = children.start(first.name, first.module, first.arguments)
    if not _listens(address, station, stop):
        return station, False
    for program in others:
        children.start(program.name, program.module, program.arguments, inherits=program.inherits)
    return station, True


def _interrupt(station: Child) -> None:
    """Let the station end by a person's Ctrl-C before the others: it writes that into the log, and tells its page."""
    if station.exit_code is None:
        station.process.send_signal(signal.SIGINT)
        with contextlib.suppress(subprocess.TimeoutExpired):
            station.process.wait(INTERRUPTED_WITHIN_S)


def _secret_folder() -> "tempfile.TemporaryDirectory[str]":
    """A folder for secrets that goes with this process; those of launchers that were killed go now."""
    for left in Path(tempfile.gettempdir()).glob(f"{SECRETS}*"):
        pid = left.name.removeprefix(SECRETS).partition("-")[0]
        if pid.isdecimal() and not _runs(int(pid)):
            shutil.rmtree(left, ignore_errors=True)  # of another user: it stays
    return tempfile.TemporaryDirectory(prefix=f"{SECRETS}{os.getpid()}-")


def _runs(pid: int) -> bool:
    """True if a process with this number runs, of whatever user."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        pass
    return True


def _link_keys(folder: Path, robots: tuple[int, ...]) -> Path:
    """Make a new key for each robot and its board, as `sim-bridge pool --boards` and `robot-agent run --link-key` take
    them."""
    for robot in robots:
        new_key(folder / f"robot-{robot}.key")
    return folder


def _watch(
    children: Children,
    station: Child,
    monitor: Monitor,
    injector: ProcessFaultInjector,
    lockstep: bool,
    stop: Stop,
    console: Console,
) -> list[str]:
    """Show the run until the station has ended it. Returns the problems of processes."""
    problems: dict[str, str] = {}
    moved_s = time.monotonic()
    heartbeats = 0
    with monitor.shown(console) as say:
        while station.exit_code is None and not stop.requested:
            injector.act(monitor.began_ns, monitor.time_s)
            for child in children.ended():
                if child.name not in problems and child is not station and child.name not in injector.killed:
                    problems[child.name] = child.explain()
                    print_error(console, problems[child.name])
            if problems and lockstep:
                break  # the others would wait for it for ever
            if monitor.heartbeats != heartbeats:
                heartbeats, moved_s = monitor.heartbeats, time.monotonic()
            elif time.monotonic() - moved_s > STALLED_S:
                problems["all"] = f"nothing has moved for {STALLED_S:.0f} s"
                print_error(console, problems["all"])
                break
            say()
            time.sleep(LOOK_EVERY_S)
        if station.exit_code not in (None, 0, 1):
            time.sleep(SAFE_WITHIN_S)  # the others still fly: let them bring themselves to rest, and say so in their logs
    return list(problems.values())


def report(run_dir: Path, console: Console) -> bool:
    """Have the station's command write the report, and print what it says. Returns True if the result in its file passed: a
    program that was cut off while it printed has written its files."""
    result, page = run_dir / "result.json", run_dir / "report.html"
    before = _written(result), _written(page)
    writing = programs.ask("groundstation", ["log", "report", str(run_dir)])
    if _written(result) == before[0] or _written(page) == before[1]:
        print_error(console, f"no report: {writing.stderr.strip() or writing.stdout.strip()}")
        return False
    lines = [line for line in writing.stdout.strip().splitlines() if not line.startswith("report: ")]
    console.print("\n".join(lines), highlight=False, soft_wrap=True)
    console.print(f"report: {page}", soft_wrap=True)
    return bool(json.loads(result.read_text(encoding="utf-8"))["passed"])


def _written(file: Path) -> tuple[int, int] | None:
    """Identity of a file's version, which changes when it is written anew; None if it does not exist."""
    return (file.stat().st_ino, file.stat().st_mtime_ns) if file.exists() else None


def _listens(address: str, station: Child, stop: Stop) -> bool:
    """Wait until something listens at an address of the station's. False if its program ends, or none does in time."""
    _, host, port = parse_address(address)
    deadline = time.monotonic() + START_WITHIN_S
    while time.monotonic() < deadline and station.exit_code is None and not stop.requested:
        try:
            socket.create_connection((host, port), timeout=1.0).close()
            return True
        except OSError:
            time.sleep(0.05)
    return False
