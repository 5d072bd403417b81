"""What holds for all tests."""

import os
import signal
from collections import Counter
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

# How fast an example is found or runs is the machine's matter: a busy one must fail no test.
settings.register_profile("deal_hw", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("deal_hw")

# A shell starts background jobs with SIGINT ignored, nohup with SIGHUP. Tests would wait for them.
for number, handler in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, handler)

REAL_TIME = (
    "cli/",
    "contracts/",
    "control/",
    "data/test_data_recorder_process",
    "drivers/",
    "house/test_robot_computer",
    "tools/",
    "workflows/",
)
"""Folders and files of tests with processes that run in real time; two at once would disturb each other."""

COMPUTING = (
    "test_can_errors",
    "test_cartpole_avr",
    "test_cartpole_can_firmware",
    "test_cartpole_can_link",
    "test_cartpole_can_robot",
    "test_cartpole_device",
    "test_cartpole_firmware",
    "test_cartpole_odrive",
    "test_cartpole_pole_encoder",
    "test_cartpole_protocol",
    "test_cartpole_robot",
    "test_cartpole_stm32",
    "test_cartpole_truth",
    "test_cli_calibrate",
    "test_cli_design_excitation",
    "test_cli_every_",
    "test_cli_go2_calibration",
    "test_cli_keys",
    "test_cli_options",
    "test_cli_piped",
    "test_cli_policy_refused",
    "test_cli_refusals",
    "test_clock_check",
    "test_contracts_parameters",
    "test_contracts_policy",
    "test_control_behaviours",
    "test_control_excitation",
    "test_control_exit_passive",
    "test_control_loop",
    "test_control_posture",
    "test_control_repeater",
    "test_control_replay_error",
    "test_control_safety",
    "test_control_velocity",
    "test_control_waveforms",
    "test_dds_types",
    "test_driver_descriptions",
    "test_dynamixel_packets",
    "test_dynamixel_robot",
    "test_go2_bridge_admission",
    "test_go2_descriptions",
    "test_go2_device",
    "test_go2_doctor",
    "test_go2_emulator",
    "test_go2_load",
    "test_go2_messages",
    "test_go2_motors",
    "test_go2_odometry",
    "test_go2_oracle",
    "test_go2_protocol",
    "test_go2_robot",
    "test_go2_support",
    "test_go2_takeover",
    "test_go2_unitree_mujoco",
    "test_go2_vendor_programs",
    "test_interfaces",
    "test_refused_calls",
    "test_tools_check_readers",
    "test_tools_compare_rows",
    "test_tools_convert_cartpole",
    "test_tools_convert_so101",
    "test_tools_draw_bench",
    "test_tools_draw_demo_end",
    "test_tools_measure_bridge",
    "test_tools_measure_go2_long_walk",
    "test_tools_measure_go2_walk",
    "test_tools_measure_size",
    "test_tools_measure_wire_calibration",
    "test_tools_structure",
    "test_tools_try_diffusion_regression",
    "test_virtual_topics",
    "test_virtual_transport",
    "test_workflows_calibrate",
    "test_workflows_environments",
    "test_workflows_examples.py::test_a_script_runs[calibrate_from_arrays]",
    "test_workflows_examples.py::test_a_script_runs[make_crane]",
    "test_workflows_examples.py::test_the_notebook_runs",
    "test_workflows_passive",
    "test_workflows_refusals",
    "test_workflows_robot",
    "test_workflows_run_",
)
"""Tests of these that compute and nothing else, by how their names begin: they go to any worker."""

WITH_PROCESSES = (
    "test_cartpole_avr.py::test_the_emulator_runs_the_chip_behind_a_port",
    "test_cartpole_can_robot.py::test_collect_records_a_whole_run",
    "test_cartpole_can_robot.py::test_python_can_",
    "test_cartpole_odrive.py::test_another_encoder_number_is_refused_over_the_adapter",
    "test_go2_emulator.py::test_its_own_faults_do_not_end_it",
    "test_go2_emulator.py::test_over_zenoh_as_a_process",
    "test_tools_measure_wire_calibration.py::test_a_row_holds_what_calibration_found",
)
"""Tests in files of ``COMPUTING`` that run a process in real time all the same."""

NICE = 10
"""Added to the niceness of a worker that computes: tests in real time get their cores at once."""


def real_time(nodeid: str) -> bool:
    """Return whether a test runs processes in real time."""
    path = nodeid.removeprefix("tests/")
    name = path.partition("/")[2]
    computes = name.startswith(COMPUTING) and not name.startswith(WITH_PROCESSES)
    return path.startswith(REAL_TIME) and not computes


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Under pytest-xdist one worker gets all tests in real time, and others get whole files."""
    from xdist.scheduler import LoadScopeScheduling

    class Scheduling(LoadScopeScheduling):  # type: ignore[misc, unused-ignore]
        def _split_scope(self, nodeid: str) -> str:
            return "real time" if real_time(nodeid) else nodeid.partition("::")[0]

    config.option.loadscopereorder = False  # the order is that of pytest_collection_modifyitems
    return Scheduling(config, log)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Begin with what lasts longest: tests in real time, then the files with the most slow tests."""
    if hasattr(config, "workerinput"):
        slow = Counter(item.path for item in items if item.get_closest_marker("slow"))
        items.sort(key=lambda item: (not real_time(item.nodeid), -slow[item.path]))


computing = False
"""Whether this worker has begun to compute. Tests in real time come first: it is given no more of them."""


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Give the cores to the worker with the tests in real time, if that wants them."""
    global computing
    if hasattr(item.config, "workerinput") and not computing and not real_time(item.nodeid):
        computing = True
        os.nice(NICE)
