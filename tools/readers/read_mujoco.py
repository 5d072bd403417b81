"""Loads a calibrated model with plain MuJoCo, steps it and reads its marks."""

from __future__ import annotations

import sys
from pathlib import Path

import mujoco
import numpy as np


def main(path: Path) -> None:
    """Step for a second; print latency and parameters without a value."""
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    for _ in range(round(1.0 / model.opt.timestep)):
        mujoco.mj_step(model, data)
    if not np.all(np.isfinite(data.qpos)):
        raise AssertionError(f"qpos {data.qpos}")
    latency = model.numeric("deal_hw.latency_s").data[0]
    found = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_TEXT, "deal_hw.without_value")
    begin = model.text_adr[found]
    text = bytes(model.text_data[begin : begin + model.text_size[found]]).rstrip(b"\0").decode()
    print(f"{model.nv} coordinates, 1 s stepped; latency {latency:g} s; without value: {text}")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
