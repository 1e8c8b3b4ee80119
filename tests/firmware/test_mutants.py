"""Each rule broken once in the C code is found, by the comparison with the reference or by the conformance run."""

import shutil
import subprocess
from pathlib import Path

import pytest

from shoal.mavlink.signing import Key
from tests.firmware.bench import first_failure
from tests.firmware.equivalents import EQUIVALENTS
from tests.firmware.library import FIRMWARE, FirmwareBoard, built, load
from tests.firmware.mutants import FILES, mutants_of

SLOW = pytest.mark.slow
pytestmark = pytest.mark.long

KEY = Key(bytes(range(1, 33)))
CORE = ("board", "link", "messages", "parameters", "rules", "sha256", "signing", "store", "text", "zero")
MUTANTS = [  # rule, file, what it says, what it says instead
    ("disarmed is neutral", "rules.c", "rules->echo_us[i] = value[THR_NEUTRAL_US];\n}", "(void)value[i];\n}"),
    ("silence", "rules.c", "if (rules->armed && is_stale(rules, now_us)) {", "if (false) {"),
    (
        "arming: young override",
        "rules.c",
        "    if (is_stale(rules, now_us))\n        return",
        "    if (false)\n        return",
    ),
    ("arming: neutral", "rules.c", "if (!is_neutral_command(rules))", "if (false)"),
    ("arming: battery", "rules.c", "if (rules->charge >= CHARGE_NO_ARM)", "if (false)"),
    (
        "disarming",
        "rules.c",
        "if (rules->armed)\n            disarm(rules, SAY_INFO",
        "if (false)\n            disarm(rules, SAY_INFO",
    ),
    ("overrides: sender", "rules.c", "!same_peer(sender, rules->computer) || ", ""),
    ("range: thrusters", "rules.c", "pulses_us[i] <= pin->highest_us))", "pulses_us[i] <= pin->highest_us + (i < 4)))"),
    ("range: ankles", "rules.c", "pulses_us[i] <= pin->highest_us))", "pulses_us[i] <= pin->highest_us + (i >= 4)))"),
    ("slew", "rules.c", "fminf(fmaxf(way_us, -reach_us), reach_us)", "way_us + 0.0f * reach_us"),
    ("parameters: armed", "rules.c", "if (parameter >= 0 && rules->armed)", "if (false)"),
    ("parameters: range", "parameters.c", "if (!in_range(index, value))", "if (false)"),
    (
        "signing: unsigned",
        "link.c",
        "return link->gate.has_key ? SIGNATURE_UNSIGNED : SIGNATURE_GOOD;",
        "return SIGNATURE_GOOD;",
    ),
    ("signing: forged", "link.c", "return difference ? SIGNATURE_FORGED :", "return false ? SIGNATURE_FORGED :"),
    (
        "signing: replayed",
        "signing.c",
        "return SIGNATURE_REPLAYED;\n    if (stream == end)",
        "return SIGNATURE_GOOD;\n    if (stream == end)",
    ),
    ("repeated", "link.c", "if ((step == 0 || step >= 128) &&", "if (false &&"),
    ("checksum", "link.c", "if (checksum(frame, kind.crc_extra) != (uint16_t)(sum[0] | sum[1] << 8))", "if (sum == NULL)"),
    ("target", "messages.c", "if (!is_for(frame, system, target_at, read != read_override))", "if (false)"),
    ("resynchronisation", "link.h", "FRAME_TIMEOUT_US 50000", "FRAME_TIMEOUT_US 5000000"),
    ("hil: measurements", "board.c", "reading = &board->simulated.reading;", "board->simulated.has_motion = true;"),
    ("hil: heartbeat", "messages.c", "(rules_hil(rules) ? MAV_MODE_FLAG_HIL_ENABLED : 0)", "0"),
    ("hil: age", "board.c", "simulated->has_motion = false;", "(void)now_us;"),
    ("hil: sender", "messages.c", "hil && same_peer(frame->peer, (struct peer){system, SIMULATOR_COMPONENT})", "hil"),
    ("hil: battery", "board.c", "        simulate_battery(&board->simulated, event->battery_v, now_us);\n", ""),
    ("hil: outputs", "parameters.c", " && value[HIL_OUTPUTS] <= value[HIL_MODE];", ";"),
    ("echo", "messages.c", ".servo1_raw = rules_echo_us(rules, 0),", ".servo1_raw = rules->command_us[0],"),
]


def test_each_equivalent_change_is_one_that_is_tried() -> None:
    tried = {(m.file, m.text.strip()) for file in FILES for m in mutants_of(file) if m.is_equivalent}
    assert tried == {(file, changed) for file, _, changed, _ in EQUIVALENTS}


@SLOW
@pytest.mark.parametrize(("rule", "file", "rule_text", "instead"), MUTANTS, ids=[row[0] for row in MUTANTS])
def test_a_broken_rule_is_found(tmp_path: Path, rule: str, file: str, rule_text: str, instead: str) -> None:
    built("build/libboard.so")
    tree = tmp_path / "firmware"
    shutil.copytree(FIRMWARE, tree, ignore=shutil.ignore_patterns("*.so", "*.elf", "corpus"))
    text = (tree / file).read_text()
    assert text.count(rule_text) == 1, f"{file} no longer says {rule_text!r} once"
    (tree / file).write_text(text.replace(rule_text, instead))
    sources = [*(tree / f"{name}.c" for name in CORE), tree / "posix" / "library.c"]
    library = tmp_path / "mutant.so"
    include = ["-isystem", str(tree / "build"), f"-I{tree / 'build'}"]
    subprocess.run(["gcc", "-std=c99", "-O1", "-shared", "-fPIC", "-o", library, *sources, *include, "-lm"], check=True)
    key = KEY if rule.startswith("signing") else None  # a signature would hide that a frame is damaged or repeated
    assert first_failure(FirmwareBoard(load(library), key), key) is not None, rule
