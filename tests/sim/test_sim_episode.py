"""From a recording to the device's time grid, through the real device core on a virtual wire."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from deal_hw.drivers.cartpole.description import DESCRIPTION, k9_space
from deal_hw.drivers.cartpole.plant.truth import nominal_truth
from deal_hw.errors import InsufficientDataError
from deal_hw.motions.excitation.behaviours import RichBehaviour, RichConfig, Segment
from deal_hw.sim.engine.batch import ServoBatch, StepCount
from deal_hw.sim.engine.model import load_model
from deal_hw.sim.recordings.episode import SampledEpisode, align, fill_gaps
from deal_hw.sim.recordings.windows import cut_windows, predict_windows, setpoints
from deal_hw.types import Trajectory
from deal_hw.workflows.emulation.virtual import VirtualCartpole, VirtualEpisode

SEGMENT = Segment(start=0.5, stop=1.0, effort_limit=0.4, speed_limit=2.0)


@pytest.fixture(scope="module")
def recorded() -> VirtualEpisode:
    """Two seconds of random set-points on a nominal robot with a latency of 7 + 4 ticks, ideal sensors."""
    truth = nominal_truth("ideal", 3, actuation_ticks=7, sensing_ticks=4)
    config = RichConfig(duration_s=2.0, balance_s=0.0, segments=(SEGMENT,))
    return VirtualCartpole(truth).run(RichBehaviour(DESCRIPTION, None, config, 5), 2.0)


def without(t: Trajectory, first: int, stop: int) -> Trajectory:
    """Return the recording without the state samples from ``first`` up to ``stop``."""
    keep = np.r_[0:first, stop : len(t.device_s)]
    fields = (
        "receive_s",
        "device_s",
        "position",
        "velocity",
        "effort",
        "status",
        "command_sequence",
        "command_age_s",
    )
    return dataclasses.replace(t, **{name: getattr(t, name)[keep] for name in fields})


@pytest.mark.parametrize("copies", [2, 4, 50])
def test_copies_of_the_members_simulate_windows_at_once(recorded: VirtualEpisode, copies: int) -> None:
    """To the last bit, with forces, through changes of gains and limits; idle copies count no step."""
    robot, space = load_model(DESCRIPTION), k9_space()
    episode = align(recorded.trajectory, DESCRIPTION)
    windows = cut_windows(episode, 20)
    rng, shape = np.random.default_rng(0), (2, len(windows), 20 * windows.stride, 2)
    theta = np.stack([space.nominal, 1.1 * space.nominal]).clip(space.low, space.high)
    x = episode.position[windows.start] + 0.01 * rng.standard_normal((2, len(windows), 2))
    v, force = episode.velocity[windows.start], rng.standard_normal(shape)
    found, steps = [], []
    for count in (2, 2 * copies):
        counted = StepCount()
        batch = ServoBatch(robot, space, count, threads=1, counted=counted)
        batch.set_parameters(np.tile(theta, (count // 2, 1)))
        path = setpoints(batch, episode, np.tile([0.011, 0.013], count // 2))[:2]
        found.append(predict_windows(batch, episode, windows, x, v, path, force))
        steps.append(counted.steps)
    np.testing.assert_array_equal(found[0][0], found[1][0])
    np.testing.assert_array_equal(found[0][1], found[1][1])
    assert steps[0] == steps[1] > 0


def test_simulation_explains_the_recording_to_the_wire_resolution(recorded: VirtualEpisode) -> None:
    """With the true parameters and the summed latency, windows predict the recording to a few micrometres.

    This is the equality that calibration rests on: driver, bytes, firmware, recorder, alignment and simulator
    agree on what acted when, through changes of gains and limits.
    """
    robot, space = load_model(DESCRIPTION), k9_space()
    episode = align(recorded.trajectory, DESCRIPTION)
    windows = cut_windows(episode, 20)
    batch = ServoBatch(robot, space, 2, threads=1)
    path = setpoints(batch, episode, np.array([0.011, 0.013]))
    x, v = episode.position[windows.start], episode.velocity[windows.start]
    predicted, _ = predict_windows(batch, episode, windows, x, v, path)
    error = np.abs(predicted - episode.position[windows.samples()])
    # Whole micrometres and microradians at the start grow over 0.1 s of a falling pole.
    assert error[0].max() < 2e-5
    assert error[1].max() > 1e-3


def test_windows_keep_clear_of_changes_of_what_is_sent(recorded: VirtualEpisode) -> None:
    """No window begins before and ends after the moment at which another effort limit came into force."""
    episode = align(recorded.trajectory, DESCRIPTION)
    change = int(np.flatnonzero(np.diff(episode.effort_limit[:, 0]))[0])
    windows = cut_windows(episode, 40)
    begin, end = episode.sample[windows.start], episode.sample[windows.start + 40]
    assert not np.any((begin <= change) & (end > change))
    assert len(windows) >= 6


def test_windows_leave_gaps_out(recorded: VirtualEpisode) -> None:
    """Ten lost frames end one window and another starts after them."""
    t = recorded.trajectory
    torn = without(t, 100, 110)
    episode = align(torn, DESCRIPTION)
    windows = cut_windows(episode, 10)
    spans = episode.sample[windows.start + 10] - episode.sample[windows.start]
    assert set(spans.tolist()) == {50}
    assert not np.any((windows.start < 99) & (windows.start + 10 > 99))


def test_recording_that_was_never_armed_is_refused(recorded: VirtualEpisode) -> None:
    """Without armed samples there is nothing to align, and the error says what to do."""
    t = recorded.trajectory
    idle = dataclasses.replace(t, status=np.zeros_like(t.status))
    with pytest.raises(InsufficientDataError, match="collect"):
        align(idle, DESCRIPTION)


def test_episode_shorter_than_one_window_is_refused(recorded: VirtualEpisode) -> None:
    """The error says how long a window is and how much there is."""
    episode = align(recorded.trajectory, DESCRIPTION)
    with pytest.raises(InsufficientDataError, match=r"no window of 1000 samples \(5\.00 s\)"):
        cut_windows(episode, 1000)


def test_short_gaps_are_filled_by_a_spline_and_long_ones_by_lines() -> None:
    """A sine of 3 Hz at 50 Hz: one lost sample within 3 mrad, where a line is 70 mrad off; 0.2 s by a line.

    A line is off by (omega h)^2 / 2 at a turning point: (18.85 * 0.02)^2 / 2 = 0.07 of the amplitude.
    """
    kept = np.delete(np.arange(200), [104, *range(150, 160)])  # 3 Hz * 104 * 0.02 s: a quarter turn past 6.
    time_s = 0.02 * np.arange(200)
    motion = np.sin(2 * np.pi * 3.0 * time_s)
    whole = SampledEpisode(
        step_s=0.02,
        sample=kept,
        position=motion[kept, None],
        velocity=motion[kept, None],
        target=np.zeros((200, 1)),
        stiffness=np.ones((200, 1)),
        damping=np.zeros((200, 1)),
        effort_limit=np.ones((200, 1)),
        speed_limit=np.ones((200, 1)),
        usable=np.ones(len(kept), dtype=bool),
        start_setpoint=np.zeros(1),
    )
    filled = fill_gaps(whole)
    assert filled.reported is not None and np.flatnonzero(~filled.reported).tolist() == [
        104,
        *range(150, 160),
    ]
    assert abs(filled.position[104, 0] - motion[104]) < 3e-3
    assert abs((motion[103] + motion[105]) / 2 - motion[104]) > 0.05
    line = np.linspace(motion[149], motion[160], 12)[1:-1]
    np.testing.assert_allclose(filled.position[150:160, 0], line, atol=1e-12)
    assert filled.usable[104] and not filled.usable[150:160].any()


def test_command_inside_a_gap_is_placed_by_the_clocks(recorded: VirtualEpisode) -> None:
    """With 12 frames lost, three commands are never reported; each is placed where it acted."""
    t = recorded.trajectory
    torn = without(t, 100, 112)
    whole, mended = align(t, DESCRIPTION), align(torn, DESCRIPTION)
    # Three commands, each at most one period from where it was.
    assert np.count_nonzero(whole.target != mended.target) <= 3


def test_command_that_never_arrived_is_not_placed(recorded: VirtualEpisode) -> None:
    """When the command with a new target is lost on the wire, the target acts one control period later."""
    t = recorded.trajectory
    i = int(np.flatnonzero(np.diff(t.position_target[:, 0]))[2]) + 1
    lost = int(t.sent_sequence[i])
    hit = t.command_sequence == lost
    silent = dataclasses.replace(
        t,
        command_sequence=np.where(hit, lost - 1, t.command_sequence),
        command_age_s=np.where(hit, t.command_age_s + 0.02, t.command_age_s),
    )
    new = t.position_target[i]
    begin = [int(np.flatnonzero(align(x, DESCRIPTION).target[:, 0] == new[0])[0]) for x in (t, silent)]
    assert begin[1] - begin[0] == DESCRIPTION.steps_per_control


def test_set_point_begins_where_the_servo_was_armed(recorded: VirtualEpisode) -> None:
    """Armed at 10 mm, 10.03 mm at the first sample that reports a command: the set-point began at 10 mm."""
    t = recorded.trajectory
    first = int(np.argmax(t.command_sequence >= 0))
    assert first == 1
    position = t.position.copy()
    position[:2, 0] = 0.01, 0.01003
    moved = dataclasses.replace(t, position=position)
    assert align(moved, DESCRIPTION).start_setpoint.tolist() == [0.01]
    # Where the recording begins under a command nothing earlier is known.
    assert align(without(moved, 0, 1), DESCRIPTION).start_setpoint.tolist() == [0.01003]
