"""Workers import nothing from the working folder, and what this process starts afterwards is free again."""

import os

import pytest

from sim_bridge.studies.worker_pool import worker_pool


def test_workers_import_nothing_from_the_working_folder_and_the_environment_is_restored(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
    with worker_pool(1) as pool:
        assert pool.submit(os.getenv, "PYTHONSAFEPATH").result() == "1"
    assert "PYTHONSAFEPATH" not in os.environ
