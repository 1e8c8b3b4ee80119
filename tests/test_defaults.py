"""A record that nobody has filled in says nothing, and a switch that nobody has set is off, in every program."""

import ast
from collections.abc import Iterator

from tests.source_tree import nodes, sources, tree_of

NOTHING = {"0", "0.0", "''", "()", "frozenset()", "None", "False"}
FACTORIES = ("field(", "array(", "wrench_array(", "row_numbers(")  # of empty things, each time new

# class, field -> its default where that is something: nothing known yet, the usual kind, or what a person would take
SOMETHING = {
    ("AgedMessage", "age_ms"): "NEVER_MS",
    ("BoardReading", "board_ms"): "-1",
    ("Break", "place_m"): "(0.0, 0.0)",
    ("CameraControl", "usable"): "True",
    ("CapturedFrame", "stamped"): "True",
    ("Client", "shown_ns"): "-1",
    ("Command", "time_to_live_s"): "1.0",
    ("Control", "solve"): "Solve.NONE",
    ("ControlOutput", "flow_moment"): "NO_FLOW",
    ("Curve", "style"): "'-'",
    ("DeployRequest", "restart"): "True",
    ("DeployRequest", "ssh"): "('ssh',)",
    ("Endpoint", "address"): "'tcp/127.0.0.1:7447'",
    ("FilterShape", "regularisation"): "0.01",
    ("FlownLaps", "end_s"): "math.inf",
    ("Follow", "rate"): "1.0",
    ("GainStatus", "stage"): "GainStage.IDLE",
    ("LocalizerStatus", "camera"): "CameraHealth.ABSENT",
    ("LocalizerStatus", "obstacles_ns"): "-1",
    ("MarkerPose", "size"): "1.0",
    ("Neighbour", "formation"): "True",
    ("NodeOptions", "source"): "BUS",
    ("Outcome", "order"): "CommandKind.NONE",
    ("Outcome", "progress"): "Progress.UNDER_WAY",
    ("Panel", "least"): "0.01",
    ("Pose", "track"): "Track.LOST",
    ("ProvisionalMatch", "count"): "1",
    ("Ratios", "drag"): "1.0",
    ("Ratios", "moment"): "1.0",
    ("Ratios", "thrust"): "1.0",
    ("Reaction", "detail"): "lambda h: ''",
    ("Reply", "mode"): "Mode.DISARMED",
    ("Result", "commit"): "'unknown'",
    ("Result", "evaluated_by"): "'unknown'",
    ("Result", "version"): "'unknown'",
    ("RobotResult", "end"): "RobotEnd()",
    ("RobotState", "guidance"): "Guidance.NONE",
    ("RobotState", "mode"): "Mode.DISARMED",
    ("RobotState", "timing"): "StepTiming()",
    ("RobotState", "track"): "Track.LOST",
    ("RobotTask", "progress"): "Progress.UNDER_WAY",
    ("RobotTrack", "state"): "Track.LOST",
    ("RobotView", "plan_age_s"): "float('inf')",
    ("RobotView", "pose_age_s"): "float('inf')",
    ("RobotView", "state_age_s"): "float('inf')",
    ("RunLog", "exists"): "True",
    ("StationStop", "trouble"): "'no answer'",
    ("StationView", "age_s"): "float('inf')",
    ("StayLimits", "path_s"): "float('inf')",
    ("TimePlot", "height_in"): "1.35",
    ("TimelineEvent", "times"): "1",
    ("Tokens", "at_s"): "float('-inf')",
    ("Topic", "readers"): "EVERYONE",
    ("Validity", "asked_s"): "math.inf",
    ("Validity", "until_s"): "math.inf",
    ("WebOptions", "host"): "'127.0.0.1'",
    ("WebOptions", "port"): "8000",
    ("_Request", "only"): "WHOLE_FLEET",
    ("_RunData", "ended_by"): "MissionEvent.ALL_CONFIRMED",
    ("_Sender", "sequence"): "-1",
}


# function, parameter -> a number or a switch that is something by default
SET = {
    ("_at_most", "is_whole"): "True",
    ("_rerouted", "longer"): "0.4",
    ("_axis_rows", "top_in"): "0.15",
    ("_split", "percent"): "50.0",
    ("add", "days"): "397.0",
    ("deploy", "restart"): "True",
    ("discs_to_avoid", "obstacles"): "True",
    ("find_route", "smooth_m"): "0.5",
    ("inboxes", "wakes"): "True",
    ("opened", "over"): "True",
    ("rate_weight", "arm_m"): "1.0",
    ("read_request", "uses_camera"): "True",
    ("read_rows", "lever"): "1.0",
    ("replace_text", "durable"): "True",
    ("replace_text", "over"): "True",
    ("replacing", "durable"): "True",
    ("replacing", "over"): "True",
    ("replacing_together", "durable"): "True",
    ("replay", "rate"): "1.0",
    ("three", "factor"): "1.0",
    ("thrust", "lever"): "1.0",
    ("thrust", "still_g"): "3.0",
    ("wait_event", "timeout_s"): "60.0",
    ("wait_mission", "timeout_s"): "60.0",
    ("wait_ready", "timeout_s"): "60.0",
    ("Model", "lag"): "True",
    ("Model", "sway"): "True",
    ("Stop", "install"): "True",
}


def _is_record(node: ast.ClassDef) -> bool:
    made = any("dataclass" in ast.unparse(decorator) for decorator in node.decorator_list)
    return made or any(ast.unparse(base) == "NamedTuple" for base in node.bases)


def _defaults() -> Iterator[tuple[tuple[str, str], str]]:
    """Class, field and default of every record's field that has one."""
    for file in sources("shoal", "groundstation", "robot_agent", "localizer"):
        for node in nodes(tree_of(file)):
            if isinstance(node, ast.ClassDef) and _is_record(node):
                for line in node.body:
                    if isinstance(line, ast.AnnAssign) and line.value is not None:
                        yield (node.name, ast.unparse(line.target)), ast.unparse(line.value)


def test_a_record_that_nobody_has_filled_in_says_nothing() -> None:
    defaults = list(_defaults())
    assert len(defaults) > 500
    something = {field: text for field, text in defaults if text not in NOTHING and not text.startswith(FACTORIES)}
    assert something == SOMETHING


def _parameters() -> Iterator[tuple[tuple[str, str], str]]:
    """Function, or class for what makes it, parameter and default of every parameter that has one."""
    for file in sources("shoal", "groundstation", "robot_agent"):
        makers = {way: node.name for node in nodes(tree_of(file)) if isinstance(node, ast.ClassDef) for way in node.body}
        for node in nodes(tree_of(file)):
            if isinstance(node, ast.FunctionDef):
                name = makers.get(node, node.name) if node.name == "__init__" else node.name
                positional = [*node.args.posonlyargs, *node.args.args]
                given = [*zip(reversed(positional), reversed(node.args.defaults), strict=False)]
                given += [(a, d) for a, d in zip(node.args.kwonlyargs, node.args.kw_defaults, strict=True) if d is not None]
                yield from (((name, argument.arg), ast.unparse(default)) for argument, default in given)


def test_a_switch_that_nobody_has_set_is_off_and_a_number_is_zero() -> None:
    defaults = list(_parameters())
    assert len(defaults) > 400
    is_set = {at: text for at, text in defaults if text == "True" or (text[0].isdigit() and text not in ("0", "0.0", "0j"))}
    assert is_set == SET
