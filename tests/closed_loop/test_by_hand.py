"""The programs of a run, each started as a person starts it: without a launcher that judges the run."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from shoal.config.experiment import dump_experiment, load_experiment
from sim_bridge.sil.commands import RunOptions, programs
from sim_bridge.sil.ports import free_base_port, free_port


@pytest.mark.real_time
@pytest.mark.timeout(400)
def test_a_station_whose_run_met_not_every_limit_says_so_in_its_exit_code(tmp_path: Path) -> None:
    experiment = load_experiment(
        "pool", ["duration_s=1", "limits.rms_m=1e-9", "limits.exposure_to_pwm_p99_ms=1e4"]
    )  # however busy the machine, which may miss deadlines too
    (tmp_path / "experiment.toml").write_text(dump_experiment(experiment))
    address, ports = f"tcp/127.0.0.1:{free_port()}", free_base_port(experiment.robot_ids)
    station, *others = programs(experiment.robot_ids, RunOptions(poses=True), tmp_path, address, ports)
    words = [word for word in station.arguments if word != "--no-report"]
    started = [
        subprocess.Popen([sys.executable, "-m", program.module, *program.arguments], stderr=subprocess.DEVNULL)
        for program in others
    ]
    try:
        ended = subprocess.run([sys.executable, "-m", station.module, *words], stdout=subprocess.PIPE, text=True, timeout=300)
    finally:
        for process in started:
            process.terminate()
        for process in started:
            process.wait(60.0)
    result = tmp_path / "result.json"
    failed = {check["name"] for check in json.loads(result.read_text())["checks"] if check["passed"] is False}
    assert failed - {"missed deadlines"} == {"rms_m"}  # the mission itself succeeded
    assert ended.stdout.endswith(f"report: {result.parent / 'report.html'} (failed)\n")
    assert ended.returncode == 1
