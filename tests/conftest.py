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
    "test_cartpole_can_firmware",
    "test_cartpole_protocol",
    "test_cartpole_stm32",
    "test_cartpole_truth",
    "test_cli_calibrate_",
    "test_cli_every_",
    "test_cli_keys",
    "test_contracts_parameters",
    "test_contracts_policy",
    "test_control_excitation",
    "test_control_posture",
    "test_control_replay_error",
    "test_control_safety",
    "test_control_velocity",
    "test_control_waveforms",
    "test_dds_types",
    "test_dynamixel_packets",
    "test_go2_descriptions",
    "test_go2_device",
    "test_go2_load",
    "test_go2_messages",
    "test_go2_motors",
    "test_go2_odometry",
    "test_go2_oracle",
    "test_go2_protocol",
    "test_tools_check_readers",
    "test_tools_compare_rows",
    "test_tools_convert_so101",
    "test_tools_measure_size",
    "test_tools_structure",
    "test_workflows_environments",
    "test_workflows_refusals",
    "test_workflows_robot",
    "test_workflows_run_",
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
