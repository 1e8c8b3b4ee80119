"""The four command lines as a person and a script meet them: help with examples, completion, exit codes, JSON."""

import importlib
import json
import os
import re
import shlex
import socket
import subprocess
import sys
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from groundstation.__main__ import cli as groundstation
from groundstation.deploy import key_ring
from shoal.bus.bus import Bus
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.errors import ConfigError
from shoal.messages.codec import Header
from shoal.messages.messages import Command, CommandKind, Outcome, Progress, Reply
from shoal.runtime.cli_options import as_run, experiments
from sim_bridge.__main__ import cli as sim_bridge
from sim_bridge.sil.ports import free_port
from tests.forked import ended

pytestmark = pytest.mark.long

ROOT = Path(__file__).parents[1]
PROGRAMS = {
    "groundstation": "groundstation",
    "robot-agent": "robot_agent",
    "localizer": "localizer",
    "sim-bridge": "sim_bridge",
}


def commands(node: Any, path: tuple[str, ...], hidden: bool) -> Iterator[tuple[tuple[str, ...], Any]]:
    for name, below in getattr(node, "commands", {}).items():
        if hidden or not below.hidden:
            yield from commands(below, (*path, name), hidden)
    if not hasattr(node, "commands"):
        yield path, node


def all_commands(hidden: bool = False) -> list[tuple[tuple[str, ...], Any]]:
    """Every command that a person can see, or also those that only programs call."""
    leaves: list[tuple[tuple[str, ...], Any]] = []
    for program, module in PROGRAMS.items():
        root = typer.main.get_command(importlib.import_module(f"{module}.__main__").cli)
        leaves += commands(root, (program,), hidden)
    return leaves


each = pytest.mark.parametrize(
    ("path", "command"), all_commands(), ids=lambda part: " ".join(part) if isinstance(part, tuple) else ""
)


@each
def test_help_has_an_example_that_is_this_very_command(path: tuple[str, ...], command: Any) -> None:
    text = " ".join((command.help or "").split())
    assert "Example" in text
    assert " ".join(path) in text.partition("Example")[2]


def commands_of(page: Path) -> list[list[str]]:
    """Our programs' commands in the shell blocks of a page, as words."""
    blocks = re.findall(r"^```sh\n(.*?)^```", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    lines_of_words = [shlex.split(line, comments=True) for line in lines]
    return [words for words in lines_of_words if words and words[0] in PROGRAMS and "..." not in words]


def make_run(folder: Path) -> None:
    """Make a folder that counts as a run's, with an empty log."""
    folder.mkdir()
    (folder / "run.mcap").touch()


BY_HAND = ("certificates", "deploy", "hardware", "hil", "missions", "runs")  # pages whose commands no other test runs


@pytest.mark.parametrize(
    "words", [words for page in BY_HAND for words in commands_of(ROOT / "docs" / f"{page}.md")], ids=" ".join
)
def test_commands_of_the_page_parse(words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every command and option exists, and takes such a value. What they do is tested where they are."""
    make_run(tmp_path / "RUN")
    monkeypatch.chdir(tmp_path)
    program, *arguments = words
    node: Any = typer.main.get_command(importlib.import_module(f"{PROGRAMS[program]}.__main__").cli)
    while hasattr(node, "commands"):
        node = node.commands[arguments.pop(0)]
    node.make_context(program, arguments)


@each
def test_help_shows_every_word_of_its_text(path: tuple[str, ...], command: Any) -> None:
    """Rich takes [a word] for a style, and leaves it out."""
    texts = [command.help, *(getattr(parameter, "help", None) for parameter in command.params)]
    assert [tag for text in texts for tag in re.findall(r"(?<!\\)\[[a-z#/@][^\[]*?\]", text or "")] == []


@each
def test_every_option_says_what_it_is_for(path: tuple[str, ...], command: Any) -> None:
    unexplained = [p.name for p in command.params if getattr(p, "help", "unused") is None]
    assert not unexplained


ON: dict[tuple[str, ...], set[str]] = {
    ("groundstation", "deploy"): {"restart"},
    ("localizer", "evaluate"): {"marker"},
}  # switches with a --no- beside them


def test_a_switch_is_off_until_a_person_sets_it() -> None:
    """An open network, above all, and a file that is written over."""
    switches = [
        (path, p) for path, command in all_commands(hidden=True) for p in command.params if getattr(p, "is_flag", False)
    ]
    assert {"insecure", "link_insecure", "force"} <= {p.name for _, p in switches}
    assert [(path, p.name) for path, p in switches if p.default is not (p.name in ON.get(path, ()))] == []
    assert all(p.secondary_opts for path, p in switches if p.name in ON.get(path, ()))


def numbers_of(command: Any) -> list[Any]:
    return [p for p in command.params if p.type_descriptor.annotation in (float, list[float])]


@pytest.mark.parametrize(
    ("command", "number"),
    [
        pytest.param(command, p, id=" ".join([*path, p.name]))
        for path, command in all_commands(hidden=True)
        for p in numbers_of(command)
    ],
)
@pytest.mark.parametrize("value", ["nan", "inf", "-inf"])
def test_no_number_of_a_command_is_infinite_or_none(command: Any, number: Any, value: str) -> None:
    """With NaN each comparison is false: a limit that is checked so lets it pass, and a loop waits for ever."""
    context = command.make_context("it", [], resilient_parsing=True)
    context.resilient_parsing = False
    with pytest.raises(typer.BadParameter) as refused:
        number.process_value(context, [value] if number.nargs == -1 or number.multiple else value)
    assert value.lstrip("-") in str(refused.value) or "input" in str(refused.value).lower()


@each
def test_the_page_of_commands_names_it(path: tuple[str, ...], command: Any) -> None:
    page = (ROOT / "docs" / "commands.md").read_text()
    row = next(line for line in page.splitlines() if line.startswith(f"| `{path[0]}`"))
    assert f"`{path[1]}`" in row


def completed(words: str, program: str = "groundstation") -> set[str]:
    """The completions that bash would offer for a line that ends here."""
    variable = f"_{program.replace('-', '_').upper()}_COMPLETE"
    environment = {**os.environ, variable: "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(len(words.split(" ")) - 1)}
    script = f"from {PROGRAMS[program]}.__main__ import cli; cli(prog_name={program!r})"
    done = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=False)
    return set(done.stdout.split())


@pytest.mark.parametrize("page", [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))], ids=lambda page: page.name)
def test_command_lines_on_pages_are_ones_that_there_are(page: Path) -> None:
    options = {
        path: {word for p in command.params for word in (*p.opts, *p.secondary_opts)}
        for path, command in all_commands(hidden=True)
    }
    text = page.read_text(encoding="utf-8")
    blocks = re.findall(r"```\w*\n(.*?)```", text, re.DOTALL)
    for line in [*re.findall(r"`([^`\n]+)`", text), *"\n".join(blocks).split("\n")]:
        words = line.partition("  #")[0].removeprefix(".venv/bin/").split()
        if len(words) < 2 or words[0] not in PROGRAMS or words[1].startswith("-"):
            continue
        if any(option[: len(words)] == tuple(words) for option in options):
            continue
        path = next((tuple(words[:k]) for k in (3, 2) if tuple(words[:k]) in options), None)
        assert path is not None, f"no such command: {line}"
        for word in words:
            assert not word.startswith("--") or word.partition("=")[0] in {*options[path], "--"}, f"no {word}: {line}"


def test_a_shell_completes_commands_options_experiments_and_orders() -> None:
    assert completed("groundstation log re") == {"repair", "replay", "report"}
    assert {"--set", "--robot", "--json"} <= completed("sim-bridge rerun --", "sim-bridge")
    assert completed("groundstation mission s") == {"start", "states"}
    assert completed("sim-bridge sil open", "sim-bridge") == {"open-water"}


def test_an_experiments_name_completes_to_files_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "poolside.toml").touch()
    (tmp_path / "notes.txt").touch()
    (tmp_path / "polo").mkdir()
    monkeypatch.chdir(tmp_path)
    assert experiments("po") == ["pool", "polo/", "poolside.toml"]
    assert experiments(f"{tmp_path}/po") == [f"{tmp_path}/polo/", f"{tmp_path}/poolside.toml"]
    assert experiments("nowhere/") == []


def test_codes_for_what_cannot_be_done() -> None:
    for arguments in (
        ["log", "replay"],
        ["mission", "fly"],
        ["mission", "go", "nan", "1"],
        ["run", "pool", "--warp"],
        ["nonsense"],
    ):
        assert CliRunner().invoke(groundstation, arguments).exit_code == 2
    assert CliRunner().invoke(sim_bridge, ["compare", "pool", "--scatter", "-1"]).exit_code == 2


@pytest.mark.parametrize(
    ("words", "named"),
    [
        ("sil pool --duration -5", "--duration"),
        ("numeric pool --seed -1", "--seed"),
        ("compare pool --duration 0", "--duration"),
        ("numeric pool --set vehicle=submarine", "--set vehicle=submarine: vehicle = 'submarine': no such vehicle"),
    ],
)
def test_an_error_names_the_argument_that_was_typed(words: str, named: str) -> None:
    code, _, reason = ended("sim-bridge", *words.split())
    assert code == 2 and named in reason and ("--set" in reason) is ("--set" in words)


@pytest.mark.parametrize(
    ("module", "words"),
    [
        *(("groundstation", words) for words in ("log report", "log compare", "log replay", "log label", "log delete --yes")),
        ("groundstation", "log export --out tables"),
        ("sim-bridge", "rerun"),
        ("sim-bridge", "sil --from"),
    ],
)
def test_a_folder_without_a_run_is_refused(tmp_path: Path, module: str, words: str) -> None:
    (tmp_path / "video.mcap").touch()
    code, _, reason = ended(module, *words.split(), str(tmp_path / "video.mcap"))
    assert code == 2 and reason.startswith(f"{tmp_path / 'video.mcap'}: is no folder (allowed: a run's folder")
    code, _, reason = ended(module, *words.split(), str(tmp_path))
    assert code == 2 and reason.startswith(f"{tmp_path}: run.mcap and experiment.toml are missing there")


def test_a_run_may_be_named_by_its_log(tmp_path: Path) -> None:
    (tmp_path / "run.mcap").touch()
    assert as_run(tmp_path / "run.mcap") == as_run(tmp_path) == tmp_path


def test_a_comparison_that_cannot_be_flown_leaves_no_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for out in ([], ["--out", "mine"]):
        assert CliRunner().invoke(sim_bridge, ["compare", "pool", "--laws", "nowhere:Law", "--seeds", "1", *out]).exit_code
    assert not list(tmp_path.iterdir())


def test_a_dry_run_says_what_would_be_flown_and_leaves_nothing(tmp_path: Path) -> None:
    code, output, _ = ended("groundstation", "run", "pool", "--dry-run", "--out", str(tmp_path))
    assert code == 0
    assert re.search(r"120 s, experiment [0-9a-f]{8}, into", output)
    assert output.count("starts at x") == 2
    assert not list(tmp_path.iterdir())


def test_a_dry_run_of_what_cannot_be_flown_says_why(tmp_path: Path) -> None:
    code, _, output = ended("groundstation", "run", "pool", "--dry-run", "--out", str(tmp_path), "--set", "path.lap_s=1")
    assert code == 2
    assert "robot 1" in output and "Traceback" not in output


def test_a_dry_run_looks_at_the_way_to_the_robots_too(tmp_path: Path) -> None:
    empty = tmp_path / "token"
    empty.touch()
    for wrong, why in (
        (["--listen", "nowhere"], "'nowhere': not a place where a station can be"),
        (["--listen", "tcp/0.0.0.0:7447"], "other machines could command the robots"),
        (["--keys", str(tmp_path)], f"--keys {tmp_path}: "),
        (["--web-token-file", str(empty)], f"--web-token-file {empty}: is empty"),
    ):
        refused = CliRunner().invoke(groundstation, ["run", "pool", "--dry-run", *wrong]).exception
        assert isinstance(refused, ConfigError) and why in str(refused)
    wide = CliRunner(env={"COLUMNS": "400"})
    absent = wide.invoke(groundstation, ["run", "pool", "--dry-run", "--web-certificate", str(tmp_path / "none")])
    assert absent.exit_code == 2 and "does not exist" in absent.output


def test_a_run_that_is_none_is_named(tmp_path: Path) -> None:
    for program, *words in (
        ("sim-bridge", "rerun", str(tmp_path)),
        ("groundstation", "log", "replay", str(tmp_path)),
        ("groundstation", "log", "export", str(tmp_path), "--out", str(tmp_path / "out"), "--foxglove"),
    ):
        code, _, output = ended(program, *words)
        assert (code, "Traceback" in output) == (2, False)
        assert str(tmp_path) in output


def test_unwritable_output_is_told_in_one_line(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.touch()
    for place in (file / "layout.json", tmp_path):
        code, output, why = ended("groundstation", "foxglove", "layout", "pool", "--out", str(place))
        assert (code, output, why.splitlines()) == (2, "", [why.strip()])
        assert why.startswith(f"{place}: ")


def test_file_that_is_no_log_is_named_and_left_unchanged(tmp_path: Path) -> None:
    file, out = tmp_path / "run.mcap", tmp_path / "tables"
    for content, command, reason in (
        (b"name = 'pool'", ["log", "repair", str(file)], "is no log"),
        (b"", ["log", "export", str(tmp_path), "--out", str(out)], "holds no messages"),
    ):
        file.write_bytes(content)
        code, _, why = ended("groundstation", *command)
        assert (code, why.splitlines()) == (2, [why.strip()])
        assert why.startswith(f"{file}: {reason}")
        assert file.read_bytes() == content and list(tmp_path.iterdir()) == [file]
    code, _, why = ended("groundstation", "log", "repair", str(tmp_path))
    assert (code, why) == (2, f"{tmp_path}: is no regular file\n")


def test_json_is_json_and_nothing_else(tmp_path: Path) -> None:
    from tests.groundstation.synthetic import Script, write_run

    runs = [tmp_path / name for name in ("one", "two")]
    for run, settings in zip(runs, ((), ("safety.radius_m=0.31",)), strict=True):
        run.mkdir()
        write_run(run, Script(duration_s=2.0, settings=settings))
    code, output, _ = ended("groundstation", "log", "report", str(runs[0]), "--json")
    assert code == 0 and json.loads(output) == json.loads((runs[0] / "result.json").read_text())
    page = tmp_path / "compare.html"
    code, output, _ = ended("groundstation", "log", "compare", *map(str, runs), "--json", "--out", str(page))
    compared = json.loads(output)
    assert compared["runs"] == ["one", "two"] and page.is_file()
    assert {"key": "safety.radius_m", "values": ["0.3", "0.31"]} in compared["differences"]


def test_repair_and_export_print_json_for_a_script(tmp_path: Path) -> None:
    from tests.groundstation.synthetic import Script, write_run

    write_run(tmp_path, Script(duration_s=1.0))
    log = tmp_path / "run.mcap"
    done = CliRunner().invoke(groundstation, ["log", "repair", str(log), "--json"])
    assert (done.exit_code, json.loads(done.stdout)) == (0, {"file": str(log), "mended": False})
    done = CliRunner().invoke(groundstation, ["log", "export", str(tmp_path), "--out", str(tmp_path / "tables"), "--json"])
    files = json.loads(done.stdout)
    assert done.exit_code == 0 and files
    for entry in files:
        assert len(Path(entry["file"]).read_text().splitlines()) == entry["rows"] + 1  # a line of names


def test_an_order_for_a_script_is_json(monkeypatch: pytest.MonkeyPatch) -> None:
    """The outcome as JSON, of a station that refuses and of one that does not."""
    hub = MemoryHub()
    station = Bus(MemoryTransport(hub))
    done_by_one = Outcome(1, CommandKind.START, Progress.DONE, "", "RUNNING", (1,), (2,), ("not heard",))
    replies = {CommandKind.START: Reply(0, True, outcome=done_by_one), CommandKind.HOLD: Reply(0, False, "no")}
    station.serve(0, lambda header, command: replies[command.order])
    monkeypatch.setattr("groundstation.client.ZenohTransport", lambda *_, **__: MemoryTransport(hub))
    for order, accepted in (("start", True), ("hold", False)):
        done = CliRunner().invoke(groundstation, ["mission", order, "--json"])
        robots = {"1": "confirmed", "2": "not heard"} if accepted else {}
        assert json.loads(done.stdout) == {
            "order": order,
            "accepted": accepted,
            "done": accepted,
            "text": "confirmed by 1" if accepted else "refused: no",
            "reason": "" if accepted else "no",
            "robots": robots,
        }
        assert done.exit_code == (0 if accepted else 1)


def test_a_terminals_request_for_one_robot_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    hub, commands = MemoryHub(), list[Command]()

    def refuse(header: Header, command: Command) -> Reply:
        commands.append(command)
        return Reply(0, False, "no")

    station = Bus(MemoryTransport(hub))
    station.serve(0, refuse)
    monkeypatch.setattr("groundstation.client.ZenohTransport", lambda *_, **__: MemoryTransport(hub))
    for order in (["arm"], ["hold"], ["disarm"], ["go", "0.5", "-1.0"]):
        assert CliRunner().invoke(groundstation, ["mission", *order, "--robot", "2"]).exit_code == 1
        assert (commands[-1].order.name.lower(), commands[-1].robot) == (order[0], 2)
    assert commands[-1].via.tolist() == [[0.5, -1.0]]
    assert CliRunner().invoke(groundstation, ["mission", "start", "--robot", "2"]).exit_code == 2


def test_a_dry_run_of_all_processes_says_what_it_would_start(tmp_path: Path) -> None:
    def dry(*more: str) -> Any:
        fault = ["--fault", "t=6 process agent-2 killed"]
        return CliRunner().invoke(sim_bridge, ["sil", "blocked-path", "--dry-run", "--out", str(tmp_path), *fault, *more])

    output = dry("--poses", "--real-time").stdout
    assert [line.split()[0] for line in output.splitlines() if "python -m" in line] == [
        "groundstation", "sim-bridge", "agent-1", "agent-2", "agent-3",
    ]  # fmt: skip
    assert "75 s" in output and output.count("starts at x") == 3
    assert "at 6 s: process agent-2 killed" in output
    for wrong, why in (
        (["--real-time", "--set", "localizer.uses_camera=true"], "Fly without the camera"),
        (["--poses"], "processes break by the wall clock: it needs --real-time"),
        (["--poses", "--lockstep"], "processes break by the wall clock: it needs --real-time"),
        (
            ["--poses", "--lockstep", "--real-time"],
            "--lockstep: the wall clock waits for nobody",
        ),
        (["--poses", "--real-time", "--set", "path.speed_mps=9", "--set", "path.slow=false"], "robot 1: speed"),
        (["--poses", "--real-time", "--web", "nowhere"], "--web 'nowhere': must be HOST:PORT"),
        (["--poses", "--real-time", "--keys", str(tmp_path)], f"--keys {tmp_path}: "),
    ):
        refused = dry(*wrong).exception
        assert isinstance(refused, ConfigError) and why in str(refused)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("program", "arguments", "says"),
    [
        ("groundstation", ["--help"], ""),
        ("groundstation", ["mission", "start", "--station", "nowhere"], "not a place where a station can be"),
        ("groundstation", ["log", "report", "RUN"], "pip install 'shoal[station]'"),
        (
            "localizer",
            ["run", "pool"],
            "the package cv2 is not installed; what this needs comes with: pip install 'shoal[localizer]'",
        ),
        ("sim-bridge", ["pool", "pool"], "pip install 'shoal[all]'"),
    ],
)
def test_a_role_that_is_not_installed_says_what_installs_it(
    program: str, arguments: list[str], says: str, tmp_path: Path
) -> None:
    """The base installation, as on a robot's board: all four commands are there."""
    lacking = ("cv2", "mcap", "mcap_protobuf", "starlette", "uvicorn", "websockets", "matplotlib", "msgspec", "pyarrow", "av")
    script = f"import sys; sys.modules.update(dict.fromkeys({lacking})); from {PROGRAMS[program]}.__main__ import app; app()"
    make_run(tmp_path / "RUN")
    command = [sys.executable, "-c", script, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert (done.returncode, "Traceback" in done.stderr) == (2 if says else 0, False)
    assert says in done.stderr


def test_a_station_that_does_not_come_up_says_why(tmp_path: Path) -> None:
    hidden = "import sys\nsys.modules['matplotlib'] = None\n"  # as where it is not installed
    (tmp_path / "sitecustomize.py").write_text(hidden)  # Python reads it in each process
    done = subprocess.run(
        [sys.executable, "-m", "sim_bridge", "sil", "pool", "--no-web", "--out", str(tmp_path / "runs")],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)])},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert "the package matplotlib is not installed" in done.stdout
    assert "refused: nothing was flown" in done.stdout and not list((tmp_path / "runs").iterdir())
    assert "pip install 'shoal[station]'" in done.stdout


@pytest.mark.parametrize("fleet", ["", "lab/*", "a#b", "-x", "x" * 33, "replay/lab", 'a"b', "a b", "Bö"])
def test_invalid_fleet_is_refused(fleet: str, tmp_path: Path) -> None:
    done = CliRunner().invoke(groundstation, ["keys", "init", "--keys", str(tmp_path / "keys"), f"--fleet={fleet}"])
    assert (done.exit_code, list(tmp_path.iterdir())) == (2, [])
    assert "fleet's name" in done.output or "recorded run" in done.output


def test_a_port_that_is_taken_is_told_before_the_station_is_waited_for() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        refused = CliRunner().invoke(sim_bridge, ["pool", "pool", "--ports", str(port - 1)]).exception
    assert f"UDP port {port}, of robot 1's board: Address already in use" in str(refused)
    assert "65536" in str(CliRunner().invoke(sim_bridge, ["pool", "pool", "--ports", "65535"]).exception)


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    listen = f"tcp/127.0.0.1:{free_port()}"
    code, _, output = ended(
        "groundstation", "run", "pool", "--run-dir", str(tmp_path / "file" / "run"), "--no-web", "--listen", listen
    )
    assert (code, output) == (2, f"{tmp_path}/file/run: Not a directory\n")
    for command in (["sil", "pool", "--no-web"], ["numeric", "pool"]):
        refused = CliRunner().invoke(sim_bridge, [*command, "--out", str(tmp_path / "file")]).exception
        assert isinstance(refused, ConfigError) and "Not a directory" in str(refused)


def test_a_run_does_not_write_over_another_ones_log(tmp_path: Path) -> None:
    (tmp_path / "run.mcap").write_text("flown")
    code, _, output = ended("groundstation", "run", "pool", "--run-dir", str(tmp_path), "--no-web")
    assert code == 2 and output.startswith(f"{tmp_path}/run.mcap: is there already")
    assert [file.name for file in tmp_path.iterdir()] == ["run.mcap"]
    assert (tmp_path / "run.mcap").read_text() == "flown"


def test_a_start_that_fails_leaves_no_folder(tmp_path: Path) -> None:
    key_ring.init(tmp_path / "keys", [], "shoal", datetime.now(UTC))
    with socket.create_server(("127.0.0.1", 0)) as taken:
        place = f"127.0.0.1:{taken.getsockname()[1]}"
        for how in (["--listen", f"tcp/{place}"], ["--listen", f"tls/{place}", "--keys", str(tmp_path / "keys")]):
            code, _, output = ended("groundstation", "run", "pool", "--out", str(tmp_path / "runs"), "--no-web", *how)
            assert (code, output) == (2, f"cannot listen at {how[1]}: Address already in use\n")
    assert not (tmp_path / "runs").exists()


def test_a_token_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    (tmp_path / "token").write_bytes(b"\xff")
    (tmp_path / "empty").write_text(" \n")
    (tmp_path / "shared").write_text("a token of many characters\n")
    (tmp_path / "shared").chmod(0o644)
    for name, says in (
        ("shared", "shared: mode 0644 lets others read the page's token (allowed: 0600"),
        ("nowhere", "nowhere: No such file"),
        ("token", "token: not a text"),
        ("empty", "empty: is empty: an empty token protects nothing"),
    ):
        refused = CliRunner().invoke(groundstation, ["run", "pool", "--web-token-file", str(tmp_path / name)]).exception
        assert isinstance(refused, ConfigError) and says in str(refused)


def _site(folder: Path) -> Path:
    """A folder with one file of each kind that commands read, each with its own name as content."""
    run = folder / "run"
    run.mkdir()
    for name in ("picture.png", "video.mp4", "truth.txt", "run/run.mcap", "run/report.html", "run/experiment.toml"):
        (folder / name).write_text(name)
    (folder / "lab.toml").write_text((ROOT / "shoal" / "config" / "experiments" / "pool.toml").read_text())
    (folder / "campaign.toml").write_text('name = "two"\nexperiment = "pool"\nseeds = 2\n')
    (folder / "out").mkdir()
    (folder / "out" / "comparison.html").symlink_to(folder / "lab.toml")
    return folder


@pytest.mark.parametrize(
    ("line", "lost"),
    [
        ("localizer latency lab.toml --source video:video.mp4 --json video.mp4", "video.mp4"),
        ("localizer latency lab.toml --json lab.toml", "lab.toml"),
        ("localizer evaluate video.mp4 --truth truth.txt --json truth.txt", "truth.txt"),
        ("localizer evaluate video.mp4 --truth truth.txt --experiment lab.toml --json lab.toml", "lab.toml"),
        ("localizer check lab.toml --out lab.toml", "lab.toml"),
        ("localizer check lab.toml --image picture.png --out picture.png", "picture.png"),
        ("groundstation log compare run run --out run/report.html", "run/report.html"),
        ("groundstation foxglove layout lab.toml --out lab.toml", "lab.toml"),
        ("sim-bridge campaign campaign.toml --out run", "run/report.html"),
        ("sim-bridge compare lab.toml --out out", "lab.toml"),
        ("robot-agent init --robot 1 --station tcp/127.0.0.1:7447 --experiment lab.toml --out lab.toml --force", "lab.toml"),
    ],
)
def test_output_that_would_replace_an_input_is_refused(
    line: str, lost: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(_site(tmp_path))
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    program, *arguments = line.split()
    cli = importlib.import_module(f"{PROGRAMS[program]}.__main__").cli
    result = CliRunner().invoke(cli, arguments)
    assert isinstance(result.exception, ConfigError), result.output
    assert "would be lost" in str(result.exception)
    assert (tmp_path / lost).read_bytes() == before[tmp_path / lost]
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_table_in_the_place_of_a_runs_file_is_refused(tmp_path: Path) -> None:
    from tests.groundstation.small_log import record_poses

    log = tmp_path / "run.mcap"
    record_poses(log, 5)
    before = log.read_bytes()
    (tmp_path / "robot-1-pose.csv").symlink_to(log)
    result = CliRunner().invoke(groundstation, ["log", "export", str(tmp_path), "--out", str(tmp_path)])
    assert isinstance(result.exception, ConfigError) and "would be lost" in str(result.exception)
    assert log.read_bytes() == before
