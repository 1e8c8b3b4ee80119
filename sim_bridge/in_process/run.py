"""SHELL: `sim-bridge numeric`: the station's planner plans, fleet.py flies, the station's recorder writes the log."""

import secrets
import time
from collections import Counter
from pathlib import Path

import numpy as np
from rich.console import Console

from groundstation.logs.recorder import Recorder, run_metadata
from groundstation.planning import planner
from shoal.config.experiment import Experiment, dump_experiment
from shoal.frames import Array
from shoal.messages.codec import Header, encode
from shoal.messages.messages import Trajectory
from shoal.runtime.cli_options import DEFAULT_FLEET
from shoal.runtime.runtime import Stop
from sim_bridge import fault_schedule
from sim_bridge.in_process.fleet import AgentFleet, DirectPlant, fly
from sim_bridge.sil import launcher


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
    start_s, begin_s, begin_cpu_s = fleet.time_s, time.perf_counter(), time.thread_time()
    problem = _record(fleet, plant, run_dir, stop)
    took_s, took_cpu_s = time.perf_counter() - begin_s, time.thread_time() - begin_cpu_s
    if problem:
        console.print(f"{run_dir / 'run.mcap'}: {problem}", style="red", highlight=False, soft_wrap=True)
    if stop.requested:
        console.print("interrupted")
        return 130
    flown_s = fleet.time_s - start_s
    console.print(
        f"flew {flown_s:.1f} s in {took_s:.2f} s ({took_cpu_s:.2f} s of one core): {flown_s / took_cpu_s:.0f} x real time",
        soft_wrap=True,
    )
    passed = launcher.report(run_dir, console) and not problem
    console.print("passed" if passed else "failed", style="green" if passed else "red")
    return 0 if passed else 1


def _record(fleet: AgentFleet, plant: DirectPlant, run_dir: Path, stop: Stop) -> str:
    """Fly, and write `run.mcap`. Returns why the log is not whole; empty if it is."""
    experiment, session, sent = fleet.experiment, secrets.randbits(63) | 1, Counter[str]()
    recorder = Recorder(run_dir / "run.mcap", dump_experiment(experiment), run_metadata(experiment, "numeric"))
    try:
        for topic, robot, message, stamp_ns in fly(fleet, plant):
            key = f"{DEFAULT_FLEET}/{topic.key(robot)}"
            sent[key] += 1
            recorder.put(topic, key, Header(session, sent[key], stamp_ns), encode(message, stamp_ns), stamp_ns)
            if stop.requested:
                break
    finally:
        recorder.close()
    return recorder.error


def plan(experiment: Experiment) -> tuple[dict[int, Trajectory], dict[int, Array]]:
    """Trajectories and start poses as the station plans them. Raises ConfigError with its reasons if it refuses."""
    trajectories = planner.plan(experiment)
    return trajectories, planner.start_poses(experiment, trajectories)
