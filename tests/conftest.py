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


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Under pytest-xdist one worker gets all tests in real time, and others get whole files."""
    from xdist.scheduler import LoadScopeScheduling

    class Scheduling(LoadScopeScheduling):  # type: ignore[misc, unused-ignore]
        def _split_scope(self, nodeid: str) -> str:
            file = nodeid.partition("::")[0]
            return "real time" if PurePosixPath(file).parts[1] in REAL_TIME else file

    return Scheduling(config, log)
