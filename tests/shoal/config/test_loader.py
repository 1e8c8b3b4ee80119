"""Files that cannot be used, and settings on the command line: what the person who wrote them gets to read."""

import copy
import tracemalloc
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
import tomli_w
from hypothesis import given
from hypothesis import strategies as st
from pydantic import Field

from shoal.config.loader import MOST_BYTES, MOST_PARTS, Section, apply_setting, check, parse_toml, read_toml
from shoal.errors import ConfigError


class Tank(Section):
    kind: Literal["tank"]
    size_m: tuple[float, float]


class Lake(Section):
    kind: Literal["lake"]
    name: str = ""


class Net(Section):
    mesh_m: Annotated[float, Field(gt=0)]


class File(Section):
    water: Annotated[Tank | Lake, Field(discriminator="kind")]
    nets: tuple[Net, ...] = ()
    count: int = 1
    open: bool = False
    hz: float | tuple[float, ...] = 1.0


GOOD: dict[str, Any] = {"water": {"kind": "tank", "size_m": [3, 2.5]}, "nets": [{"mesh_m": 0.1}, {"mesh_m": 0.2}]}


def test_a_good_table_becomes_a_frozen_section() -> None:
    table = copy.deepcopy(GOOD)
    file = check(File, table, "a.toml")
    assert isinstance(file.water, Tank)
    assert file.water.size_m == (3.0, 2.5)
    assert [net.mesh_m for net in file.nets] == [0.1, 0.2]
    assert table == GOOD
    with pytest.raises(ValueError, match="frozen"):
        file.count = 2


@pytest.mark.parametrize(
    ("setting", "complaint"),
    [
        ('count="2"', "a.toml: count = '2': Input should be a valid integer"),
        ("count=2.0", "a.toml: count = 2.0: Input should be a valid integer"),
        ("count=true", "a.toml: count = True: Input should be a valid integer"),
        ("open=1", "a.toml: open = 1: Input should be a valid boolean"),
        ("colour=1", "a.toml: colour: unknown key (allowed here: count, hz, nets, open, water)"),
        ("water.size_m=[1, 2, 3]", "a.toml: water.size_m = [1, 2, 3]: must be a list of at most 2"),
        ("water.size_m=3", "a.toml: water.size_m = 3: must be a list"),
        ("water.size_m.1=nan", "a.toml: water.size_m.1 = nan: Input should be a finite number"),
        ("water.depth=3", "a.toml: water.depth: unknown key (allowed here: kind, size_m)"),
        ('water={kind="lake", size_m=[1, 2]}', "a.toml: water.size_m: unknown key (allowed here: kind, name)"),
        ('water={kind="pond"}', "a.toml: water.kind = 'pond': must be one of 'tank', 'lake'"),
        ("water={size_m=[1, 2]}", "a.toml: water.kind: missing, and it has no default"),
        ("water=4", "a.toml: water = 4: must be a table"),
        ("nets.1.mesh_m=0", "a.toml: nets.1.mesh_m = 0: Input should be greater than 0"),
        ("nets.1={}", "a.toml: nets.1.mesh_m: missing, and it has no default"),
        ("nets.0=5", "a.toml: nets.0 = 5: must be a table"),
        ("hz=x", "a.toml: hz = 'x': Input should be a valid number"),
        ('hz=[1, "y"]', "a.toml: hz.1 = 'y': Input should be a valid number"),
    ],
)
def test_an_error_names_file_key_value_and_allowed_values(setting: str, complaint: str) -> None:
    table = copy.deepcopy(GOOD)
    apply_setting(table, setting)
    with pytest.raises(ConfigError) as caught:
        check(File, table, "a.toml")
    assert complaint in str(caught.value).splitlines()


def test_a_byte_order_mark_is_skipped(tmp_path: Path) -> None:
    file = tmp_path / "notepad.toml"
    file.write_bytes(b'\xef\xbb\xbfname = "B\xc3\xa4cken"\r\n')
    assert read_toml(file) == {"name": "Bäcken"}


def test_all_problems_are_told_at_once() -> None:
    table = copy.deepcopy(GOOD) | {"count": "x", "open": 3, "colour": 1}
    with pytest.raises(ConfigError) as caught:
        check(File, table, "a.toml")
    assert len(str(caught.value).splitlines()) == 3


def test_a_long_value_is_cut_short() -> None:
    with pytest.raises(ConfigError) as caught:
        check(File, GOOD | {"count": "x" * 100_000}, "a.toml")
    assert len(str(caught.value)) < 200


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (b"a = ", "not valid TOML"),
        (b"a = 1\na = 2", "not valid TOML"),
        (b"\xff\xfe", "cannot be read"),
        (b"a = " + b"9" * 5000, "not valid TOML"),
        (b"a = " + b"[" * 5000, "not valid TOML"),
    ],
)
def test_a_file_that_is_no_toml(tmp_path: Path, content: bytes, complaint: str) -> None:
    path = tmp_path / "broken.toml"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=complaint) as caught:
        read_toml(path)
    assert str(path) in str(caught.value)


HARMFUL = {
    "a key of 20,000 parts": ".".join("a" * 20_000) + " = 1",
    "a table of 20,000 parts": "[" + " . ".join("a" * 20_000) + "]",
    "quoted parts": ".".join(['"a"'] * 20_000) + " = 1",
    "parts of both quotes": ".".join(["'a'", '"b"'] * 10_000) + " = 1",
    "in an inline table": "a = {" + ".".join("a" * 20_000) + " = 1}",
    "a megabyte": "a = 1 #" + "x" * MOST_BYTES,
}


@pytest.mark.parametrize("name", HARMFUL)
def test_a_file_that_would_take_all_memory_is_refused_before_it_is_parsed(tmp_path: Path, name: str) -> None:
    """A dotted key of 20,000 parts, 40 kB, took 2.45 GB."""
    path = tmp_path / "nest.toml"
    path.write_text(HARMFUL[name])
    tracemalloc.start()
    try:
        with pytest.raises(
            ConfigError,
            match=r"nest\.toml: (not valid TOML: a key of more than 16 parts .at line 1|cannot be read: is larger)",
        ):
            read_toml(path)
        assert tracemalloc.get_traced_memory()[1] < 10 * MOST_BYTES
    finally:
        tracemalloc.stop()


def test_long_lists_and_texts_with_dots_are_read(tmp_path: Path) -> None:
    path = tmp_path / "points.toml"
    text = f"title = 'A. B. C'\na.b.c.d.e = {[[0.1, 0.2]] * 2000}\n# v1.2.3 ......... and so on\r\n[x.y.z]\n"
    path.write_text(text, newline="")
    assert read_toml(path)["a"]["b"]["c"]["d"]["e"][-1] == [0.1, 0.2]


def test_a_setting_is_held_to_the_same() -> None:
    table: dict[str, Any] = {}
    text = "{" + ".".join("a" * 20_000) + " = 1}"
    apply_setting(table, f"a={text}")
    assert table == {"a": text}


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"nowhere\.toml: no such file"):
        read_toml(tmp_path / "nowhere.toml")
    with pytest.raises(ConfigError, match="cannot be read"):
        read_toml(tmp_path)


@given(st.binary(max_size=200))
def test_any_bytes_are_a_table_or_a_complaint(tmp_path_factory: pytest.TempPathFactory, content: bytes) -> None:
    path = tmp_path_factory.getbasetemp() / "any.toml"
    path.write_bytes(content)
    try:
        assert isinstance(read_toml(path), dict)
    except ConfigError as error:
        assert str(path) in str(error)


@pytest.mark.parametrize(
    ("setting", "key", "value"),
    [
        ("a=3", "a", 3),
        ("a = 3.5", "a", 3.5),
        ("a=true", "a", True),
        ("a=[1, 2]", "a", [1, 2]),
        ('a="3"', "a", "3"),
        ("a=translate", "a", "translate"),
        ("a=it's", "a", "it's"),
        ("a=x=y", "a", "x=y"),
        ("a=", "a", ""),
        ("a=" + "9" * 5000, "a", "9" * 5000),
    ],
)
def test_the_value_of_a_setting_is_toml_or_else_text(setting: str, key: str, value: object) -> None:
    table: dict[str, Any] = {}
    apply_setting(table, setting)
    assert table == {key: value}
    assert type(table[key]) is type(value)


def test_a_setting_reaches_into_tables_and_lists() -> None:
    table: dict[str, Any] = {"robots": [{"id": 1}, {"id": 2, "at": [0, 0]}]}
    apply_setting(table, "robots.1.at.0=7")
    apply_setting(table, "sim.plant.sway=false")
    assert table == {"robots": [{"id": 1}, {"id": 2, "at": [7, 0]}], "sim": {"plant": {"sway": False}}}


@pytest.mark.parametrize(
    ("setting", "complaint"),
    [
        ("a", "write it as key=value"),
        ("=3", "write it as key=value"),
        ("robots.2.id=3", "'2' is no index of a list of 2 .allowed: 0 to 1."),
        ("robots.-1.id=3", "no index"),
        ("robots.²=3", "no index"),
        ("robots.x=3", "no index"),
        ("empty.0=3", "allowed: none, the list is empty"),
        ("robots.0.id.x=3", "robots.0.id is a value, not a table"),
        ("robots.0.id.x.y=3", "robots.0.id is a value, not a table"),
        ("seed=3\nduration_s=5", "more than one key"),
        ("seed=3\n[sim]", "more than one key"),
    ],
)
def test_a_setting_that_leads_nowhere(setting: str, complaint: str) -> None:
    table: dict[str, Any] = {"robots": [{"id": 1}, {"id": 2}], "empty": []}
    with pytest.raises(ConfigError, match=complaint) as caught:
        apply_setting(table, setting)
    assert str(caught.value).startswith((setting, repr(setting)))


def test_a_table_nested_too_deep_is_refused_with_a_message() -> None:
    table: dict[str, Any] = {}
    apply_setting(table, ".".join("a" * 3000) + "=1")
    with pytest.raises(ConfigError, match=r"^lab: a value is nested too deep"):
        check(File, table, "lab")


@given(st.text(max_size=40))
def test_any_setting_is_applied_or_refused(setting: str) -> None:
    table = copy.deepcopy(GOOD)
    try:
        apply_setting(table, setting)
    except ConfigError as error:
        assert setting in str(error) or repr(setting) in str(error)


@given(st.dictionaries(st.text("abc", min_size=1), st.integers() | st.floats(allow_nan=False) | st.text() | st.booleans()))
def test_a_written_toml_table_is_read_back(tmp_path_factory: pytest.TempPathFactory, table: dict[str, Any]) -> None:
    path = tmp_path_factory.getbasetemp() / "round.toml"
    path.write_text(tomli_w.dumps(table), encoding="utf-8", newline="")
    assert read_toml(path) == table


def test_text_that_came_over_the_network_is_no_longer_than_a_file_may_be() -> None:
    line = "a = 1\n"
    longest = line + "#" * (MOST_BYTES - len(line))
    assert parse_toml(longest, "a message") == {"a": 1}
    with pytest.raises(ConfigError, match=f"a message: cannot be read: larger than {MOST_BYTES} bytes"):
        parse_toml(longest + "#", "a message")


def test_a_key_has_so_many_parts_and_no_more() -> None:
    parse_toml(".".join("k" * MOST_PARTS) + " = 1", "a message")
    with pytest.raises(ConfigError, match=rf"a message: not valid TOML: a key of more than {MOST_PARTS} parts \(at line 2\)"):
        parse_toml("\n" + ".".join("k" * (MOST_PARTS + 1)) + " = 1", "a message")
