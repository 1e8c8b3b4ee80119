"""The fault timeline's language: what it understands, and what it answers to what it does not."""

import re
from typing import Any

import pytest

from shoal.config.experiment import load_experiment
from shoal.config.fault_injection import KINDS, Break, fault_table, read_request, read_what
from shoal.errors import ConfigError
from sim_bridge.fault_schedule import FaultSchedule


@pytest.mark.parametrize(
    ("text", "meaning"),
    [
        ("thruster 2/3 dead", Break("thruster", "dead", robot=2, thruster=3)),
        ("thruster 1/4 weak 0.3", Break("thruster", "weak", 0.3, robot=1, thruster=4)),
        ("thruster 1/4 weak", Break("thruster", "weak", 0.5, robot=1, thruster=4)),
        ("marker 2 lost", Break("marker", "lost", robot=2)),
        ("camera frozen", Break("camera", "frozen")),
        ("camera occluded 0.7", Break("camera", "occluded", 0.7)),
        ("imu 1 gyro -0.2", Break("imu", "gyro", -0.2, robot=1)),
        ("battery 1 sag 3", Break("battery", "sag", 3.0, robot=1)),
        ("link 2 noisy 0.2", Break("link", "noisy", 0.2, robot=2)),
        ("process agent-1 stopped", Break("process", "stopped", process="agent-1")),
        ("disk full", Break("disk", "full")),
        ("clock localizer step -3600", Break("clock", "step", -3600.0, process="localizer")),
    ],
)
def test_fault_texts_that_are_understood(text: str, meaning: Break) -> None:
    assert read_what(text) == meaning
    assert load_experiment("pool", faults=[f"t=3 {text}"]).sim.faults[0].broken == meaning


def test_each_thruster_of_a_vehicle_with_eight_can_break_and_no_ninth() -> None:
    experiment = load_experiment("pool", ["vehicle=vectored"], ["t=1 thruster 1/7 dead"])
    schedule = FaultSchedule(experiment)
    schedule.advance(2.0)
    assert schedule.actuators.thrust[0].tolist() == [1.0] * 6 + [0.0, 1.0]
    with pytest.raises(ConfigError, match="allowed: 1 to 8"):
        load_experiment("pool", ["vehicle=vectored"], ["t=1 thruster 1/9 dead"])


@pytest.mark.parametrize(
    ("line", "complaint"),
    [
        ("thruster 2/3 dead", '--fault thruster 2/3 dead: write it as "t=SECONDS'),
        ("t=soon camera dark", "write it as"),
        ("t=-1 camera dark", "sim.faults.0.at_s = -1.0: "),
        ("t=nan camera dark", "sim.faults.0.at_s = nan"),
        ("t=1 for=0 camera dark", "sim.faults.0.for_s = 0.0: "),
        (
            "t=1 rudder 2 lost",
            "'rudder' cannot be broken (allowed: thruster, marker, camera, water, ball, imu, battery, link, ",
        ),
        ("t=1 thruster 2 dead", "must read: thruster ROBOT/THRUSTER dead|stuck|reversed|weak [fraction of its thrust]"),
        ("t=1 thruster 2/3", "must read: thruster"),
        ("t=1 thruster 2/5 dead", "thruster 5 of robot 2: no such thruster (allowed: 1, 2, 3, 4)"),
        ("t=1 thruster 0/2 dead", "robot 0: no robot has this number"),
        ("t=1 link 0 cut", "robot 0: no robot has this number"),
        ("t=1 thruster 2/3 dead 4", "must read: thruster"),
        ("t=1 thruster 2/3 weak 1.5", "1.5: must be the fraction of its thrust, 0 to 1"),
        ("t=1 link 1 slow fast", "fast: must be the delay in s, 0 to 5"),
        ("t=1 thruster 7/3 dead", "sim.faults.0.what = 'thruster 7/3 dead': no robot 7 (allowed: 1, 2)"),
        ("t=1 process agent-9 killed", "no such process (allowed: groundstation, sim-bridge, localizer, agent-1, agent-2)"),
        ("t=1 for=2 process agent-1 killed", "what is killed does not come back"),
    ],
)
def test_fault_texts_that_are_refused(line: str, complaint: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_experiment("pool", faults=[line])
    assert complaint in str(caught.value)


def test_lines_are_added_to_the_file_s_own() -> None:
    settings = ['sim.faults=[{at_s=1.0, what="camera dark"}]']
    experiment = load_experiment("pool", settings, ["t=20 for=5 thruster 2/3 dead", "t=9 marker 1 lost"])
    assert [(f.at_s, f.for_s, f.what) for f in experiment.sim.faults] == [
        (1.0, None, "camera dark"),
        (20.0, 5.0, "thruster 2/3 dead"),
        (9.0, None, "marker 1 lost"),
    ]
    assert fault_table("t=20 for=5 thruster 2/3 dead") == {"at_s": 20.0, "for_s": 5.0, "what": "thruster 2/3 dead"}


def test_a_fault_holds_for_its_time() -> None:
    (fault,) = load_experiment("pool", faults=["t=20 for=5 camera dark"]).sim.faults
    assert [fault.holds(t) for t in (-1.0, 19.99, 20.0, 24.99, 25.0)] == [False, False, True, True, False]


# a target of each kind, as a person writes it, and its meaning
TARGETS: dict[str, tuple[str, dict[str, Any]]] = {
    "ROBOT/THRUSTER": ("2/8", {"robot": 2, "thruster": 8}),
    "ROBOT": ("2", {"robot": 2}),
    "[CAMERA]": ("east", {"camera": "east"}),
    "X,Y": ("-1.5,0.25", {"place_m": (-1.5, 0.25)}),
    "NAME": ("agent-2", {"process": "agent-2"}),
    "": ("", {}),
}


@pytest.mark.parametrize(("kind", "effect"), [(kind, effect) for kind, (_, effects) in KINDS.items() for effect in effects])
def test_every_fault_has_its_target_and_a_number_in_its_range_or_none(kind: str, effect: str) -> None:
    target, effects = KINDS[kind]
    text, meaning = TARGETS[target]
    words, limits = " ".join(filter(None, (kind, text, effect))), effects[effect]
    assert read_what(words) == Break(kind, effect, limits.default, **meaning)
    if not limits.meaning:
        with pytest.raises(ValueError, match=f"must read: {kind}"):
            read_what(f"{words} 1")
        return
    assert limits.low <= limits.default <= limits.high
    for number in (limits.low, limits.high):
        assert read_what(f"{words} {number!r}") == Break(kind, effect, number, **meaning)
    for number in (limits.low - 1e-3, limits.high + 1e-3):
        with pytest.raises(ValueError, match=re.escape(f"must be the {limits.meaning}, {limits.low:g} to {limits.high:g}")):
            read_what(f"{words} {number!r}")
    for wrong in ("much", "nan", "1 1"):
        with pytest.raises(ValueError, match="must "):
            read_what(f"{words} {wrong}")


@pytest.mark.parametrize(("target", "text"), [(target, text) for target, (text, _) in TARGETS.items() if text])
def test_a_fault_without_its_target_or_with_a_wrong_one_is_refused(target: str, text: str) -> None:
    for kind, (wanted, effects) in KINDS.items():
        effect = next(iter(effects))
        if wanted == target != "[CAMERA]":
            for words in (f"{kind} {effect}", kind, f"{kind} {text}", f"{kind} {text} {text} {effect}"):
                with pytest.raises(ValueError, match=f"must read: {kind}"):
                    read_what(words)
    assert read_what("camera dark") == Break("camera", "dark")


def test_thrusters_are_counted_from_one_to_eight_and_robots_from_one() -> None:
    assert read_what("thruster 1/1 dead") == Break("thruster", "dead", robot=1, thruster=1)
    for text, why in (("1/0", "thruster 0 of robot 1: no such"), ("1/9", "allowed: 1 to 8"), ("0/1", "robot 0: no robot")):
        with pytest.raises(ValueError, match=why):
            read_what(f"thruster {text} dead")


def test_a_persons_fault_lasts_up_to_a_day() -> None:
    assert read_request("link 1 cut for 86400", (1, 2), (1,)) == ("link 1 cut", 86400.0)
    assert read_request(" link 1 cut ", (1, 2), (1,)) == ("link 1 cut", 0.0)
    assert read_request("repair", (1,), (1,)) == ("", 0.0)
    assert read_request("camera dark for 5", (1,), (1,)) == ("camera dark", 5.0)
    assert read_request("water gust", (1,), (1,)) == ("water gust", 0.0)
    for text, why in (
        ("link 1 cut for 86401", "for 86401: must be seconds"),
        ("link 1 cut for 0", "for 0: must be seconds"),
        ("link 3 cut", r"no robot 3 \(allowed: 1, 2\)"),
        ("camera east dark", "no camera 'east' .allowed: no name: there is one camera"),
        *(
            (text, "only by the timeline")
            for text in ("process agent-1 killed", "disk full", "clock agent-1 step", "water low")
        ),
    ):
        with pytest.raises(ValueError, match=why):
            read_request(text, (1, 2), (1,))
    for text in ("camera dark", "marker 1 lost"):
        with pytest.raises(ValueError, match="no camera sees it"):
            read_request(text, (1, 2), (1,), uses_camera=False)
    assert read_request("link 1 cut", (1, 2), (1,), uses_camera=False) == ("link 1 cut", 0.0)
