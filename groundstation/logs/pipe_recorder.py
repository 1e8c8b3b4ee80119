"""SHELL: records a run that another program flies and hands over through a pipe (wire/messages/pipe.py)."""

from pathlib import Path
from typing import IO

from groundstation.logs.recorder import Recorder, run_metadata
from wire.config.experiment import Experiment, dump_experiment
from wire.messages.codec import DecodeError
from wire.messages.pipe import read_pipe
from wire.process.cli_options import DEFAULT_FLEET


def record(experiment: Experiment, run_dir: Path, mode: str, stream: IO[bytes]) -> str:
    """Write `run.mcap` from a pipe until it ends. Returns why the log is not whole; empty if it is."""
    recorder = Recorder(run_dir / "run.mcap", dump_experiment(experiment), run_metadata(experiment, mode))
    problem = ""
    try:
        for topic, robot, header, payload in read_pipe(stream):
            recorder.put(topic, f"{DEFAULT_FLEET}/{topic.key(robot)}", header, payload, header.stamp_ns)
    except DecodeError as error:  # whoever flies has died in the middle of a message; what came before counts
        problem = str(error)
    finally:
        recorder.close()
    return problem or recorder.error
