"""SHELL: `sim-bridge numeric`: the station plans, fleet.py flies, the station records and reports.

The station's programs run as a user would start them. The messages of the flight go to the recorder through a pipe.
"""

import json
import secrets
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from shoal.config.experiment import Experiment, dump_experiment
from shoal.errors import ConfigError
from shoal.messages.messages import Trajectory
from shoal.messages.pipe import PipeWriter
from shoal.runtime.output_files import replace_text
from shoal.runtime.runtime import Failed, Stop
from shoal.system import programs
from sim_bridge import fault_schedule
from sim_bridge.in_process.fleet import AgentFleet, DirectPlant, fly
from sim_bridge.sil import launcher

REFUSED = 2  # exit code of `groundstation plan` for an experiment that cannot be flown


def prepared(experiment: Experiment) -> tuple[AgentFleet, DirectPlant]:
    """Fleet and plant at the beginning of the station's trajectories. Raises ConfigError, and leaves no files behind, if
    the experiment cannot be flown like this."""
    fault_schedule.require_kinds(experiment, fault_schedule.NUMERIC, "in a numeric flight there is none")
    trajectories, starts = plan(experiment)
    water = DirectPlant(experiment, experiment.seed, np.array([starts[robot] for robot in experiment.robot_ids]))
    fleet = AgentFleet(experiment, trajectories, water, experiment.seed, time.perf_counter_ns)
    fleet.start()
    return fleet, water


def run(fleet: AgentFleet, plant: DirectPlant, run_dir: Path, *, stop: Stop, console: Console) -> int:
    """Fly a fleet that has started to its end, and report. Returns the exit code: 0 passed, 1 failed, 130 interrupted."""
    launcher.write_experiment(fleet.experiment, run_dir)
    recording = programs.start(
        "groundstation", ["log", "record", str(run_dir)], stdin=subprocess.PIPE, stdout=subprocess.DEVNULL
    )
    assert recording.stdin is not None
    start_s = fleet.time_s
    begin_s, begin_cpu_s = time.perf_counter(), time.process_time()
    try:
        with recording.stdin as stream:
            pipe = PipeWriter(stream, secrets.randbits(63) | 1)
            for topic, robot, message, stamp_ns in fly(fleet, plant):
                pipe.publish(topic, message, stamp_ns, robot)
                if stop.requested:
                    break
    except BrokenPipeError:  # its own words are on stderr
        console.print("the recorder has ended", style="red")
    took_s, took_cpu_s = time.perf_counter() - begin_s, time.process_time() - begin_cpu_s
    recorded = recording.wait() == 0
    if stop.requested:
        console.print("interrupted")
        return 130
    flown_s = fleet.time_s - start_s
    console.print(
        f"flew {flown_s:.1f} s in {took_s:.2f} s ({took_cpu_s:.2f} s of one core): {flown_s / took_cpu_s:.0f} x real time",
        soft_wrap=True,
    )
    passed = launcher.report(run_dir, console) and recorded
    console.print("passed" if passed else "failed", style="green" if passed else "red")
    return 0 if passed else 1


def plan(experiment: Experiment) -> tuple[dict[int, Trajectory], dict[int, Any]]:
    """Trajectories and start poses by `groundstation plan`. Raises ConfigError with its reasons if it refuses, Failed if
    it ended otherwise, for example for want of memory."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "experiment.toml"
        replace_text(file, dump_experiment(experiment))
        planning = programs.ask("groundstation", ["plan", str(file)])
    said = planning.stderr.strip().replace(f"{file}: ", "")
    if planning.returncode == REFUSED:
        raise ConfigError(said)
    if planning.returncode != 0:
        raise Failed(f"groundstation plan ended with exit code {planning.returncode}: {said or 'without a word'}")
    robots = {int(robot): planned for robot, planned in json.loads(planning.stdout)["robots"].items()}
    trajectories = {
        robot: Trajectory(p["id"], p["period_s"], np.array(p["eta"]), np.array(p["velocity"]), np.array(p["acceleration"]))
        for robot, p in robots.items()
    }
    return trajectories, {robot: p["start"] for robot, p in robots.items()}
