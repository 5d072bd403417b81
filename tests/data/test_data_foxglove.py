"""Episodes with the robot in 3D, decoded by another program."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from deal_hw.cli.data import Export, data
from deal_hw.clock import VirtualClock
from deal_hw.data.export.foxglove import SCENE_NAME, SCENE_TEXT, scene_update
from deal_hw.data.recording import recorder as recorder_module
from deal_hw.data.recording.reader import read_episode
from deal_hw.data.recording.recorder import EpisodeRecorder
from deal_hw.data.recording.repair import verify
from deal_hw.drivers.cartpole.description import DESCRIPTION
from deal_hw.errors import ConfigurationError, DatasetError
from deal_hw.sim.engine.model import load_model
from deal_hw.sim.engine.scene import Shape, ShapeKind, body_poses, read_scene

WriteEpisode = Callable[..., Path]


def decoded(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """Return log time and message of each topic."""
    found: dict[str, list[tuple[int, Any]]] = {}
    with open(path, "rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _, channel, raw, message in reader.iter_decoded_messages():
            found.setdefault(channel.topic, []).append((raw.log_time, message))
    return found


def test_links_and_shapes(write_episode: WriteEpisode, tmp_path: Path) -> None:
    """Each link's transform at 50 Hz is MuJoCo's, each visible shape is drawn in its link's frame."""
    path = write_episode()
    assert data(Export(path=path, out=tmp_path / "out", format="foxglove")) == 0
    found = decoded(tmp_path / "out" / path.name)
    robot, episode = load_model(DESCRIPTION), read_episode(path)
    scene = read_scene(robot)
    where, turned = body_poses(robot, episode.trajectory.position)
    transforms = [(at, message.transforms[0]) for at, message in found["/tf"]]
    # 600 samples at 200 Hz, one in four.
    assert len(transforms) == 150 * (len(scene.bodies) - 1)
    states = found["/state"]
    for number, (at, transform) in enumerate(transforms[: 3 * (len(scene.bodies) - 1)]):
        moment, body = divmod(number, len(scene.bodies) - 1)
        assert at == states[4 * moment][0] and transform.child_frame_id == scene.bodies[body + 1]
        place, turn = transform.transform.translation, transform.transform.rotation
        np.testing.assert_allclose([place.x, place.y, place.z], where[4 * moment, body + 1])
        np.testing.assert_allclose([turn.w, turn.x, turn.y, turn.z], turned[4 * moment, body + 1])
    entities = [message.entities[0] for _, message in found["/scene"]]
    assert [entity.id for entity in entities] == [shape.name for shape in scene.shapes]
    frames = ["world", *scene.bodies[1:]]
    assert [entity.frame_id for entity in entities] == [frames[shape.body] for shape in scene.shapes]
    assert all(entity.frame_locked for entity in entities)


def test_the_copy_is_an_episode(write_episode: WriteEpisode, tmp_path: Path) -> None:
    """Sound, with the same samples; a file that is there is never overwritten, a setting never ignored."""
    path = write_episode()
    data(Export(path=path, out=tmp_path / "out", format="foxglove"))
    copy = tmp_path / "out" / path.name
    assert verify(copy).sound
    before, after = read_episode(path).trajectory, read_episode(copy).trajectory
    np.testing.assert_array_equal(before.position, after.position)
    np.testing.assert_array_equal(before.sent_s, after.sent_s)
    with pytest.raises(DatasetError, match="File exists; name another file"):
        data(Export(path=path, out=tmp_path / "out", format="foxglove"))
    with pytest.raises(ConfigurationError, match="task would have no effect"):
        data(Export(path=path, out=tmp_path / "other", format="foxglove", task="wave"))


def test_old_recordings_get_the_wall_clock(
    tmp_path: Path, make_cycle: Callable[[int], Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Version 1 logged on the host's clock; its preamble says what time that was."""
    wall_ns = 1_760_000_000_000_000_000
    clock = VirtualClock(7_000_000_000_000)
    monkeypatch.setattr(recorder_module, "FORMAT_VERSION", 1)
    path = tmp_path / "old.mcap"
    recorder = EpisodeRecorder(path, DESCRIPTION.to_json(), {}, clock, wall_ns=lambda: wall_ns)
    with recorder:
        recorder._wall_minus_host_ns = 0
        for number in range(5):
            recorder.write(make_cycle(number))
    data(Export(path=path, out=tmp_path / "out", format="foxglove"))
    found = decoded(tmp_path / "out" / "old.mcap")
    for at, state in found["/state"]:
        assert at - state.receive_ns == wall_ns - 7_000_000_000_000
    assert found["/tf"][0][0] == found["/state"][0][0]


@pytest.mark.parametrize("kind", ["box", "sphere", "ellipsoid", "capsule", "cylinder", "mesh"])
def test_every_kind_of_shape_decodes(kind: ShapeKind) -> None:
    """Sizes are whole ones, a capsule is a cylinder with two balls along its own axis, turned with it."""
    half = np.sqrt(0.5)
    shape = Shape(
        name="it",
        body=1,
        kind=kind,
        size=np.array([0.1, 0.2, 0.3]),
        position=np.array([1.0, 2.0, 3.0]),
        quaternion=np.array([half, 0.0, half, 0.0]),  # A quarter turn about y: z becomes x.
        color=np.array([0.1, 0.2, 0.3, 1.0]),
        vertices=np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]) if kind == "mesh" else np.zeros((0, 3)),
        faces=np.array([[0, 1, 2]]) if kind == "mesh" else np.zeros((0, 3), dtype=np.int64),
    )
    schema = dataclasses.make_dataclass("Schema", ["id", "name", "encoding", "data"])(
        1, SCENE_NAME, "ros2msg", SCENE_TEXT.encode()
    )
    decode = DecoderFactory().decoder_for("cdr", schema)
    assert decode is not None
    entity = decode(scene_update(shape, "link", 1_500_000_000)).entities[0]
    assert (entity.timestamp.sec, entity.timestamp.nanosec) == (1, 500_000_000)
    assert (entity.frame_id, entity.id) == ("link", "it")
    drawn = [*entity.cubes, *entity.spheres, *entity.cylinders, *entity.triangles]
    assert len(drawn) == (3 if kind == "capsule" else 1)
    for part in drawn:
        assert [part.color.r, part.color.g, part.color.b, part.color.a] == [0.1, 0.2, 0.3, 1.0]
    if kind == "capsule":
        ends = [[ball.pose.position.x, ball.pose.position.z] for ball in entity.spheres]
        np.testing.assert_allclose(ends, [[1.2, 3.0], [0.8, 3.0]], atol=1e-12)
    if kind == "mesh":
        (mesh,) = entity.triangles
        assert mesh.indices == [0, 1, 2] and mesh.points[1].x == 1.0
    else:
        whole = {"box": [0.2, 0.4, 0.6], "ellipsoid": [0.2, 0.4, 0.6], "sphere": [0.2] * 3}
        size = drawn[-1].size
        np.testing.assert_allclose([size.x, size.y, size.z], whole.get(kind, [0.2, 0.2, 0.4]))
