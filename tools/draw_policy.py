"""Draw a policy at work in its environment: a strip of pictures, or an animation.

    MUJOCO_GL=osmesa python tools/draw_policy.py humanoid --out walk.png
    MUJOCO_GL=osmesa python tools/draw_policy.py allegro --policy FILE.onnx --out turn.gif

The physics is drawn under uniform domain randomisation, as in training. Without a GPU: apt-get install
libosmesa6. The hand's cube has a red arrow along its x axis; the green arrow beside it is the target's.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from deal_hw.policies.onnx_runtime import OnnxPolicy
from deal_hw.robots import recorded_description, training_task
from deal_hw.types import FloatArray
from deal_hw.workflows.train import udr_distribution

ASSETS = Path(__file__).parents[1] / "policies" / "assets"
SIZE: Final = (240, 240)
"""Width and height of a picture [px]."""
ANIMATED_HZ: Final = 12.5
_BACKGROUND: Final = (0.93, 0.95, 0.96)


@dataclass(frozen=True, slots=True, kw_only=True)
class View:
    """A robot's policy and where it is seen from.

    Attributes:
        file: Name of its shipped policy.
        distance: From the middle of the picture to the camera [m].
        azimuth: Of the camera [degrees].
        elevation: Of the camera [degrees].
        look_at: Point in the picture's middle [m]; where the camera follows, relative to the base's place.
        follows: Whether the camera follows the base along x and y.
    """

    file: str
    distance: float
    azimuth: float
    elevation: float
    look_at: tuple[float, float, float]
    follows: bool


VIEWS: Final = {
    "allegro": View(
        file="allegro_turn",
        distance=0.36,
        azimuth=200.0,
        elevation=-50.0,
        look_at=(0.02, 0.0, 0.065),
        follows=False,
    ),
    "ant": View(
        file="ant_udr", distance=3.5, azimuth=110.0, elevation=-20.0, look_at=(0.0, 0.0, 0.3), follows=True
    ),
    "humanoid": View(
        file="humanoid_walk",
        distance=2.5,
        azimuth=110.0,
        elevation=-8.0,
        look_at=(0.0, 0.0, 0.8),
        follows=True,
    ),
}


def scene(path: Path) -> Any:
    """Return a robot's model with light, a plain sky and tiles on the floor, which show its speed."""
    spec: Any = mujoco.MjSpec.from_file(str(path))
    spec.visual.global_.offwidth, spec.visual.global_.offheight = SIZE
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.45] * 3, [0.5] * 3
    sky, square = mujoco.mjtTexture.mjTEXTURE_SKYBOX, mujoco.mjtTexture.mjTEXTURE_2D
    flat, checker = mujoco.mjtBuiltin.mjBUILTIN_FLAT, mujoco.mjtBuiltin.mjBUILTIN_CHECKER
    spec.add_texture(
        name="sky", type=sky, builtin=flat, rgb1=_BACKGROUND, rgb2=_BACKGROUND, width=32, height=192
    )
    spec.add_texture(
        name="tiles", type=square, builtin=checker, rgb1=[0.8] * 3, rgb2=[0.65] * 3, width=128, height=128
    )
    tiles = spec.add_material(name="tiles", texrepeat=[1, 1], texuniform=True)
    tiles.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "tiles"
    for geom in spec.geoms:
        if geom.type == mujoco.mjtGeom.mjGEOM_PLANE:
            geom.material, geom.rgba = "tiles", [1, 1, 1, 1]
    for light in spec.lights:
        spec.delete(light)
    spec.worldbody.add_light(pos=[0, 0, 4], dir=[0, 0.2, -1], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
    return spec


def add_arrows(spec: Any, target: FloatArray) -> None:
    """Mark the cube's x axis, and that of its target orientation beside it."""
    look: dict[str, Any] = {
        "contype": 0,
        "conaffinity": 0,
        "mass": 0.0,
        "type": mujoco.mjtGeom.mjGEOM_CAPSULE,
    }
    top = 0.034
    spec.body("cube").add_geom(
        size=[0.003, 0, 0], fromto=[-0.025, 0, top, 0.025, 0, top], rgba=[0.9, 0, 0, 1], **look
    )
    spec.body("cube").add_geom(
        size=[0.006, 0, 0], fromto=[0.02, 0, top, 0.025, 0, top], rgba=[0.9, 0, 0, 1], **look
    )
    middle = np.array([0.02, 0.0, 0.11])
    ahead = Rotation.from_rotvec(target).apply([1.0, 0.0, 0.0])
    for size, start, end in ((0.003, -0.025, 0.025), (0.006, 0.02, 0.025)):
        ends = [*(middle + start * ahead), *(middle + end * ahead)]
        spec.worldbody.add_geom(size=[size, 0, 0], fromto=ends, rgba=[0, 0.6, 0.1, 1], **look)


def episode(robot: str, policy: OnnxPolicy, seed: int, seconds: float) -> tuple[FloatArray, FloatArray, str]:
    """Return a robot's MuJoCo positions after each control period, (T, nq), its target, and how it ended."""
    description = recorded_description(robot)
    env = training_task(robot).make(description, udr_distribution(robot), 1)
    env.observe_for(policy.spec)
    observation, _ = env.reset(seed=seed)
    target = env.wanted[0].copy() if robot == "allegro" else np.zeros(3)
    states, places = env.loop.batch.batch.bind("qpos"), []
    for tick in range(min(env.ticks, round(seconds * description.control_rate_hz))):
        places.append(np.array(states[0]))
        observation, _, terminated, _, _ = env.step(policy.act_batch(observation))
        if terminated[0]:
            return np.array(places), target, f"ended after {(tick + 1) / description.control_rate_hz:.2f} s"
    return np.array(places), target, "no fall"


def frames(robot: str, places: FloatArray, target: FloatArray) -> Iterator[Image.Image]:
    """Yield a picture of each of these positions, (T, nq)."""
    view, description = VIEWS[robot], recorded_description(robot)
    spec = scene(Path(str(description.mjcf)))
    if robot == "allegro":
        add_arrows(spec, target)
    model = spec.compile()
    data = mujoco.MjData(model)
    camera: Any = mujoco.MjvCamera()
    camera.distance, camera.azimuth, camera.elevation = view.distance, view.azimuth, view.elevation
    width, height = SIZE
    with mujoco.Renderer(model, height, width) as renderer:
        for place in places:
            data.qpos[:] = place
            mujoco.mj_forward(model, data)
            camera.lookat[:] = view.look_at
            if view.follows:
                camera.lookat[:2] += place[:2]
            renderer.update_scene(data, camera)
            yield Image.fromarray(renderer.render())


def main() -> None:
    """Draw as the command line says."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("robot", choices=sorted(VIEWS))
    parser.add_argument("--policy", type=Path, help="by default the shipped one")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--pictures", type=int, default=8, help="pictures of a strip")
    parser.add_argument("--out", type=Path, required=True, help="a .png strip or a .gif animation")
    args = parser.parse_args()
    policy = OnnxPolicy(args.policy or ASSETS / f"{VIEWS[args.robot].file}.onnx")
    places, target, end = episode(args.robot, policy, args.seed, args.seconds)
    if args.out.suffix == ".gif":
        chosen = places[:: round(50.0 / ANIMATED_HZ)]
        pictures = [p.quantize(64) for p in frames(args.robot, chosen, target)]
        pictures[0].save(
            args.out, save_all=True, append_images=pictures[1:], duration=1000 / ANIMATED_HZ, loop=0
        )
    else:
        chosen = places[np.linspace(0, len(places) - 1, args.pictures).astype(int)]
        strip = Image.new("RGB", (SIZE[0] * args.pictures, SIZE[1]))
        for k, picture in enumerate(frames(args.robot, chosen, target)):
            strip.paste(picture, (k * SIZE[0], 0))
        strip.quantize(128).save(args.out, optimize=True)
    print(f"{args.robot}: {end}, base moved {places[-1][:3] - places[0][:3]}; written: {args.out}")


if __name__ == "__main__":
    main()
