"""What holds for all tests."""

from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

# How fast an example is found or runs is the machine's matter: a busy one must fail no test.
settings.register_profile("deal_hw", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("deal_hw")

REAL_TIME = {"cli", "contracts", "control", "drivers", "tools"}
"""Folders of tests with processes that run in real time; two of these at once would disturb each other."""


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Under pytest-xdist one worker gets all tests in real time, and others get whole files."""
    if not config.pluginmanager.hasplugin("xdist"):
        return
    tests = Path(__file__).parent
    for item in items:
        file = item.path.relative_to(tests)
        group = "real time" if file.parts[0] in REAL_TIME else str(file)
        item.add_marker(pytest.mark.xdist_group(group))
