"""What holds for all tests."""

from pathlib import PurePosixPath
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

# How fast an example is found or runs is the machine's matter: a busy one must fail no test.
settings.register_profile("deal_hw", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("deal_hw")

REAL_TIME = {"cli", "contracts", "control", "drivers", "tools", "workflows"}
"""Folders of tests with processes that run in real time; two of these at once would disturb each other."""

COMPUTING = (
    "test_cli_calibrate_",
    "test_tools_check_readers",
    "test_tools_compare_rows",
    "test_tools_convert_so101",
    "test_tools_measure_size",
    "test_tools_structure",
)
"""Files of these folders that compute and nothing else, by how their names begin: they go to any worker."""


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Under pytest-xdist one worker gets all tests in real time, and others get whole files."""
    from xdist.scheduler import LoadScopeScheduling

    class Scheduling(LoadScopeScheduling):  # type: ignore[misc, unused-ignore]
        def _split_scope(self, nodeid: str) -> str:
            file = nodeid.partition("::")[0]
            path = PurePosixPath(file)
            real_time = path.parts[1] in REAL_TIME and not path.name.startswith(COMPUTING)
            return "real time" if real_time else file

    return Scheduling(config, log)
