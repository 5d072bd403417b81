"""Draw the robots of the start page from their MuJoCo models, as this package ships them.

    MUJOCO_GL=osmesa python tools/draw_robots.py --out docs/images/robots.png

Without a GPU: apt-get install libosmesa6. From left to right: the Go2 in its default pose, the cart-pole, the
SO-101.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from PIL import Image

from deal_hw.description import RobotDescription
from deal_hw.drivers.cartpole.description import DESCRIPTION as CARTPOLE
from deal_hw.drivers.go2.descriptions.floor import DESCRIPTION as GO2
from deal_hw.drivers.so101.description import DESCRIPTION as SO101

SIZE = (400, 340)
"""Width and height of a robot [px]."""
SAMPLES = 2
"""Rendered this many times larger, then reduced, to smooth edges."""
BACKGROUND = (0.93, 0.95, 0.96)
FLOOR = (0.6, 0.62, 0.65)


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """A robot and where it is seen from.

    Attributes:
        robot: Its description, with its model.
        pose: Positions of its joints in the description's order [rad or m].
        look_at: Point in the picture's middle [m].
        distance: From there to the camera [m].
        azimuth: Of the camera [degrees].
        elevation: Of the camera [degrees].
        floor_m: Height of the drawn floor, for a model without one [m].
    """

    robot: RobotDescription
    pose: tuple[float, ...]
    look_at: tuple[float, float, float]
    distance: float
    azimuth: float
    elevation: float
    floor_m: float = 0.0


SCENES = (
    Scene(
        robot=GO2,
        pose=GO2.default_position,
        look_at=(0.02, 0.0, 0.2),
        distance=1.15,
        azimuth=125.0,
        elevation=-14.0,
    ),
    Scene(
        robot=CARTPOLE,
        pose=(0.12, 0.25),
        look_at=(0.0, 0.0, 0.1),
        distance=1.15,
        azimuth=110.0,
        elevation=-14.0,
        floor_m=-0.12,
    ),
    Scene(
        robot=SO101,
        pose=(0.4, -0.5, 0.6, 0.5, 0.0, 0.3),
        look_at=(0.14, 0.03, 0.11),
        distance=0.6,
        azimuth=125.0,
        elevation=-16.0,
    ),
)


def draw(scene: Scene) -> Image.Image:
    """Return a picture of a robot."""
    width, height = (SAMPLES * length for length in SIZE)
    spec: Any = mujoco.MjSpec.from_file(str(scene.robot.mjcf))
    spec.visual.global_.offwidth, spec.visual.global_.offheight = width, height
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.45] * 3, [0.5] * 3
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        rgb1=BACKGROUND,
        rgb2=BACKGROUND,
        width=32,
        height=192,
    )
    for light in spec.lights:
        spec.delete(light)
    spec.worldbody.add_light(
        pos=[0, 0, 2.5], dir=[0, 0, -1], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, castshadow=True
    )
    if not scene.robot.floating_base:
        # A model without a floor gets one, so that it does not float in the picture.
        plane = mujoco.mjtGeom.mjGEOM_PLANE
        spec.worldbody.add_geom(
            type=plane,
            size=[0, 0, 0.05],
            pos=[0, 0, scene.floor_m],
            rgba=[*FLOOR, 1.0],
            contype=0,
            conaffinity=0,
        )
    model = spec.compile()
    data = mujoco.MjData(model)
    for name, value in zip(scene.robot.joint_names, scene.pose, strict=True):
        data.joint(name).qpos = value
    mujoco.mj_forward(model, data)
    if scene.robot.floating_base:
        # The lowest point of the robot touches the floor.
        feet = [model.geom(k).id for k in range(model.ngeom) if model.geom(k).name.endswith("_foot")]
        data.qpos[2] -= min(data.geom_xpos[foot, 2] - model.geom_size[foot, 0] for foot in feet)
        mujoco.mj_forward(model, data)
    camera: Any = mujoco.MjvCamera()
    camera.lookat[:] = np.array(scene.look_at)
    camera.distance, camera.azimuth, camera.elevation = scene.distance, scene.azimuth, scene.elevation
    with mujoco.Renderer(model, height, width) as renderer:
        renderer.update_scene(data, camera)
        return Image.fromarray(renderer.render()).resize(SIZE, Image.Resampling.LANCZOS)


def main() -> None:
    """Draw all robots side by side."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("docs/images/robots.png"))
    out = parser.parse_args().out
    picture = Image.new("RGB", (SIZE[0] * len(SCENES), SIZE[1]))
    for k, scene in enumerate(SCENES):
        picture.paste(draw(scene), (k * SIZE[0], 0))
    picture.quantize(192).save(out, optimize=True)
    print(f"written: {out}, {out.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
