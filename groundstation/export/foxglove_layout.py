"""A layout for Foxglove-family viewers: the pool in 3-D, the camera, errors, inputs, timing, and the log's lines. Pure."""

from collections.abc import Iterable
from typing import Any

from groundstation.export.foxglove_scene import MOVING, STANDING, UPRIGHT_FRAME
from groundstation.palette import colour
from shoal.config.experiment import Experiment
from shoal.messages import topics

Layout = dict[str, Any]

_SEEN = {"none": topics.PREVIEW, "h264": topics.VIDEO, "jpeg": topics.PICTURE}  # what shows the camera, by `recording.video`


def layout(experiment: Experiment, fleet: str) -> Layout:
    """The layout's file, for the robots of an experiment."""
    length, width, _ = experiment.pool.size_m
    pictures = _pictures(experiment, fleet)
    panels: Layout = {
        "3D!pool": {
            "cameraState": {
                "perspective": True,
                "distance": 1.2 * max(length, width),
                "phi": 35.0,
                "thetaOffset": 0.0,
                "targetOffset": [0.0, 0.0, 0.0],
                "target": [0.0, 0.0, 0.0],
                "targetOrientation": [0.0, 0.0, 0.0, 1.0],
                "fovy": 45.0,
                "near": 0.01,
                "far": 1000.0,
            },
            "followMode": "follow-none",
            "followTf": UPRIGHT_FRAME,
            "scene": {"enableStats": False, "transforms": {"visible": False}},
            "topics": {f"{fleet}/{name}": {"visible": True} for name in (MOVING, STANDING)},
            "layers": {},
        },
        **pictures,
        "Plot!error": _plot(
            "distance from the reference [m]", _plotted_values(experiment, fleet, topics.PLAN, ".tracking_error_m")
        ),
        "Plot!wrench": _plot(
            "surge [N], yaw [N m]",
            [
                *_plotted_values(experiment, fleet, topics.STATE, ".control.wrench[0]"),
                *_plotted_values(experiment, fleet, topics.STATE, ".control.wrench[2]"),
            ],
        ),
        "Plot!timing": _plot(
            "exposure to PWM [ms]", _plotted_values(experiment, fleet, topics.STATE, ".timing.exposure_to_pwm_ms")
        ),
        "StateTransitions!mode": {
            "paths": [
                {
                    "value": f"{fleet}/{topics.STATE.key(robot)}.{field}",
                    "label": f"robot {robot}: {field}",
                    "timestampMethod": "receiveTime",
                }
                for robot in experiment.robot_ids
                for field in ("mode", "guidance")
            ],
            "isSynced": True,
        },
        "RosOut!log": {"topicToRender": f"{fleet}/{topics.EVENT.name}", "searchTerms": [], "minLogLevel": 2},
    }
    arranged = _split("row", "3D!pool", _split("column", _stack(tuple(pictures)), "RosOut!log", 60), 62)
    plots = _split("row", _split("row", "Plot!error", "Plot!wrench"), _split("row", "Plot!timing", "StateTransitions!mode"))
    return {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": _split("column", arranged, plots, 65),
    }


def _pictures(experiment: Experiment, fleet: str) -> Layout:
    """A panel for the picture of each camera."""
    topic = _SEEN[experiment.recording.video]
    return {
        f"Image!camera-{name}" if name else "Image!camera": {
            "imageMode": {"imageTopic": f"{fleet}/{topic.of_camera(name).name}"},
            "foxglovePanelTitle": f"camera {name}".rstrip(),
        }
        for name in experiment.camera_names or ("",)
    }


def _plotted_values(experiment: Experiment, fleet: str, topic: topics.Topic, path: str) -> list[Layout]:
    """A value of one topic as a plot has it: a line for each robot, in its colour."""
    return [
        {
            "value": f"{fleet}/{topic.key(robot)}{path}",
            "label": f"robot {robot}{path}",
            "color": colour(index),
            "enabled": True,
            "timestampMethod": "receiveTime",
        }
        for index, robot in enumerate(experiment.robot_ids)
    ]


def _plot(title: str, paths: Iterable[Layout]) -> Layout:
    """A plot panel over time."""
    return {
        "foxglovePanelTitle": title,
        "paths": list(paths),
        "showXAxisLabels": True,
        "showYAxisLabels": True,
        "showLegend": True,
        "legendDisplay": "floating",
        "showPlotValuesInLegend": True,
        "isSynced": True,
        "xAxisVal": "timestamp",
        "sidebarDimension": 240,
    }


def _stack(panels: tuple[str, ...]) -> Any:
    """Panels below each other, all of one height."""
    first, *rest = panels
    return _split("column", first, _stack(tuple(rest)), 100.0 / len(panels)) if rest else first


def _split(direction: str, first: Any, second: Any, percent: float = 50.0) -> Layout:
    return {"direction": direction, "first": first, "second": second, "splitPercentage": percent}
