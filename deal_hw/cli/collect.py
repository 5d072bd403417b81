"""``deal-hw collect``: record the robot during an informative motion."""

from __future__ import annotations

from deal_hw.cli.piped import Quiet, is_quiet
from deal_hw.cli.show import Terminal
from deal_hw.control.process.channel import Outcome
from deal_hw.workflows.collect import COLLECT, CollectSettings, CollectSimulatedSettings, run
from deal_hw.workflows.running.report import RunReport
from deal_hw.workflows.say import to_stderr

KINDS = COLLECT.with_options(Quiet)


def collect(config: CollectSettings | CollectSimulatedSettings) -> RunReport:
    """Run the verb; see :func:`deal_hw.workflows.collect.collect`."""
    return run(config, Terminal(is_quiet(config)))


def collect_and_say_next(config: CollectSettings | CollectSimulatedSettings) -> RunReport:
    """Run the verb, and print the line that calibrates from the recordings, or what they still lack."""
    report = collect(config)
    if report.outcome is Outcome.FINISHED and report.dataset is not None and not is_quiet(config):
        from deal_hw.data.recording.dataset import Dataset
        from deal_hw.workflows.calibration.episodes import refusal

        if refused := refusal(Dataset.open(report.dataset, to_stderr)):
            print(f"not enough for a calibration: {refused}")
        else:
            print(f"next: deal-hw calibrate {report.dataset}")
    return report
