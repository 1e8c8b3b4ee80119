"""A flight from a moment of a run: what the log's reader says, however much that is."""

import sys
from pathlib import Path

import pytest

from shoal.config.experiment import load_experiment
from shoal.errors import ConfigError
from shoal.system import programs
from sim_bridge.in_process.resume import prepared

SAYS_MUCH = "import sys; sys.stderr.write('damaged\\n' * 30_000); sys.stdout.write(''); sys.exit(1)"


@pytest.mark.timeout(30)
def test_a_reader_that_complains_at_length_is_heard_to_its_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """More than a pipe holds, before a byte on the other stream."""
    monkeypatch.setattr(programs, "command", lambda *_: [sys.executable, "-c", SAYS_MUCH])
    with pytest.raises(ConfigError) as refused:
        prepared(load_experiment("numeric"), tmp_path, 1.0)
    assert str(refused.value).count("damaged") == 30_000
