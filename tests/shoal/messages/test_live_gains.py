"""The bounds of the gains that change in flight, against the experiment file's own checks."""

import math
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shoal.config.experiment import load_experiment
from shoal.errors import ConfigError
from shoal.messages.live_gains import TunableParameter, of_message, tunable_parameters, tuned, tuning, values_of
from shoal.messages.messages import Tuning

POOL = load_experiment("pool")
PARAMETERS = tunable_parameters(POOL.controller)

each_parameter = pytest.mark.parametrize("parameter", PARAMETERS, ids=lambda parameter: parameter.key)


def written(key: str, value: float) -> str:
    """The `--set` that changes one number; a list is written whole."""
    name, _, index = key.rpartition(".")
    if not index.isdecimal():
        return f"{key}={value!r}"
    entries = [parameter.value for parameter in PARAMETERS if parameter.key.rpartition(".")[0] == name]
    entries[int(index)] = value
    return f"{name}={entries!r}"


def loads(key: str, value: float) -> bool:
    try:
        load_experiment("pool", [written(key, value)])
    except ConfigError:
        return False
    return True


@each_parameter
def test_bounds_are_those_of_the_experiment_file(parameter: TunableParameter) -> None:
    assert loads(parameter.key, math.nextafter(parameter.least, math.inf)) and loads(
        parameter.key, math.nextafter(parameter.most, -math.inf)
    )
    assert loads(parameter.key, parameter.least) is not parameter.above
    assert loads(parameter.key, parameter.most) is not parameter.below
    assert not loads(parameter.key, math.nextafter(parameter.least, -math.inf))
    assert not loads(parameter.key, math.nextafter(parameter.most, math.inf))


@each_parameter
def test_a_change_is_what_the_file_would_have_given(parameter: TunableParameter) -> None:
    value = 0.5 * (parameter.value + min(parameter.most, parameter.value + 1.0))
    changed = tuned(POOL.controller, {parameter.key: value})
    assert changed == load_experiment("pool", [written(parameter.key, value)]).controller
    assert tuning(changed).id != tuning(POOL.controller).id
    assert tuning(tuned(changed, {parameter.key: parameter.value})).id == tuning(POOL.controller).id


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        (
            "controller.mpc.q_formation.0",
            -1.0,
            "controller.mpc.q_formation.0 = -1.0: Input should be greater than or equal to 0",
        ),
        ("controller.estimator.bandwidth_radps", 0.0, "greater than 0"),
        ("controller.nmpc.arm_m", math.nan, "finite"),
        ("controller.period_s", 0.1, "controller.period_s: cannot be changed in flight (allowed: controller.estimator.band"),
        ("controller.mpc.q_formation.4", 1.0, "cannot be changed in flight"),
        ("vehicle.radius_m", 1.0, "cannot be changed in flight"),
    ],
)
def test_a_gain_out_of_bounds_is_refused_with_the_reason(key: str, value: float, says: str) -> None:
    with pytest.raises(ConfigError) as refused:
        tuned(POOL.controller, {key: value})
    assert says in str(refused.value)


def test_a_message_stands_for_exactly_its_values() -> None:
    wanted = tuned(POOL.controller, {"controller.nmpc.turning_m": 0.3})
    message = tuning(wanted)
    assert of_message(POOL.controller, message) == wanted
    count = len(message.keys)
    for wrong, says in (
        (Tuning("00000000", message.keys, message.values), f"tuning 00000000: with these values it is {message.id}"),
        (Tuning(message.id, message.keys[1:], message.values), f"{count - 1} keys and {count} values do not fit together"),
        (Tuning(message.id, (message.keys[1], *message.keys[1:]), message.values), "values do not fit together"),
        (Tuning(message.id, message.keys, -message.values), "gains: controller."),
    ):
        with pytest.raises(ConfigError) as refused:
            of_message(POOL.controller, wrong)
        assert says in str(refused.value)


@pytest.mark.parametrize(
    ("setting", "says"),
    [
        ("controller.nmpc.arm_m=slow", "controller.nmpc.arm_m = 'slow': must be a number"),
        ("controller.nmpc.arm_m=true", "controller.nmpc.arm_m = True: must be a number"),
        ("controller.mpc.q_formation=[1, 'x']", "controller.mpc.q_formation.1 = 'x': must be a number"),
        ("controller.mpc.q_formation", "write it as key=value"),
    ],
)
def test_a_change_that_is_no_number_is_refused_with_its_key(setting: str, says: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(says)):
        values_of([setting])


@given(st.builds(Tuning, st.text(), st.lists(st.sampled_from([k.key for k in PARAMETERS]) | st.text()).map(tuple)))
def test_no_message_gets_further_than_a_refusal(message: Tuning) -> None:
    with pytest.raises(ConfigError):
        of_message(POOL.controller, message)


@pytest.mark.parametrize(
    ("law", "has", "has_not"),
    [
        ("nmpc", {"nmpc.arm_m", "mpc.q_formation.0"}, {"mpc.q.0", "mpc.r.0", "estimator.yaw_bandwidth_radps"}),
        ("eso-mpc-article", {"mpc.q.0", "mpc.r.2", "mpc.q_formation.0", "estimator.yaw_bandwidth_radps"}, {"nmpc.arm_m"}),
        ("pid", {"estimator.bandwidth_radps"}, {"mpc.q.0", "mpc.q_formation.0", "nmpc.arm_m"}),
    ],
)
def test_a_law_has_the_gains_that_it_acts_by(law: str, has: set[str], has_not: set[str]) -> None:
    controller = load_experiment("pool", [f"controller.law={law}"]).controller
    keys = {parameter.key.removeprefix("controller.") for parameter in tunable_parameters(controller)}
    assert has <= keys and not keys & has_not


def test_settings_of_lists_go_by_entries() -> None:
    assert values_of(["controller.mpc.q_formation=[2,2,1,1.5]", "controller.nmpc.arm_m=2"]) == {
        "controller.mpc.q_formation.0": 2.0,
        "controller.mpc.q_formation.1": 2.0,
        "controller.mpc.q_formation.2": 1.0,
        "controller.mpc.q_formation.3": 1.5,
        "controller.nmpc.arm_m": 2.0,
    }
    for wrong in ("controller.mpc.q_formation=[true]", "controller.mpc.q_formation=high", "controller.mpc.q_formation"):
        with pytest.raises(ConfigError):
            values_of([wrong])


@pytest.mark.parametrize("value", ["[9,9,1]", "[1,1,1,1,1]", "2"])
def test_a_list_is_given_as_a_whole(value: str) -> None:
    with pytest.raises(ConfigError, match=r"must be 4 numbers, or one of them by its place: controller\.mpc\.q_formation\.0"):
        values_of([f"controller.mpc.q_formation={value}"])


def test_a_key_of_another_section_is_no_list_of_the_controller() -> None:
    assert values_of(["controller.mpc.nothing=[1, 2]"]) == {"controller.mpc.nothing.0": 1.0, "controller.mpc.nothing.1": 2.0}
