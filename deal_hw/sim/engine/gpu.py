"""Names of engines, and whether there is a GPU that CUDA can use, without loading a simulator."""

from __future__ import annotations

import ctypes
from typing import Any, Literal, TypeAlias

from deal_hw.errors import short

EngineName: TypeAlias = Literal["mujoco", "warp", "warp-cpu"]

WantedEngine: TypeAlias = Literal["auto", "mujoco", "warp", "warp-cpu"]

CUDA_ERRORS = {100: "it finds no GPU", 802: "the GPU is not ready", 803: "its version is not the kernel's"}
"""Codes of cuInit."""


def gpu_problem() -> str:
    """Return why no GPU can be used, in a few words; "" where CUDA's driver reports one."""
    try:
        driver: Any = ctypes.CDLL("libcuda.so.1")
    except OSError:
        return "no NVIDIA driver is installed (libcuda.so.1 is not found)"
    try:
        count = ctypes.c_int(0)
        code = int(driver.cuInit(0)) or int(driver.cuDeviceGetCount(ctypes.byref(count)))
    except (AttributeError, OSError) as err:
        return f"the NVIDIA driver cannot be read ({short(str(err))})"
    if code:
        return f"the NVIDIA driver answers with error {code} ({CUDA_ERRORS.get(code, 'see cuda.h')})"
    return "" if count.value else "the NVIDIA driver reports no GPU"
