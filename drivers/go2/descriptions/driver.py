"""The driver's description of a Go2: the floor robot, with the rates of its wire and limits for legs.

Simulation uses ``floor.DESCRIPTION``, which has one state for each control step. The shipped policies were
trained with it. Name, joints, poses, gains and control rate are the same here.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Final

from deal_hw.description import LegLimits, RobotDescription, SafetyLimits
from deal_hw.drivers.go2.descriptions import floor
from deal_hw.drivers.unitree.supply import Supply

WIRE_HZ: Final = 500.0
RESTING_RAD: Final[Mapping[str, float]] = {"hip": 0.0, "thigh": 1.36, "calf": -2.65}
PASSIVE_DAMPING_NMS_RAD: Final = 5.0
TRIP_MARGIN_RAD: Final = 0.15
EFFORT_NM: Final = 23.5
TARGET_STEP_RAD: Final = 0.6
HELD_TILT_RAD: Final = 0.35
"""Largest tilt of a body on a stand; there a third of a leg's weight pulls it aside [rad]."""
SUPPLY: Final = Supply(
    kind="Go2",
    lowest=0.0,
    highest=40.0,
    other="it may be a B2, which has the same messages; take robot `b2` if it is one",
)
"""Data sheets: 8 cells, at most 33.6 V; a B2 has 14, at least 42 V. A simulator in place of a Go2 says 0."""
FLAIL_RAD_S: Final[Mapping[str, float]] = {"hip": 20.0, "thigh": 20.0, "calf": 10.5}

LEG_LIMITS: Final = LegLimits(
    effort=(EFFORT_NM,) * 12,
    tilt=0.8,
    tumble=6.0,
    free_fall=2.0,
    free_fall_s=0.15,
    flail_velocity=floor.per_joint(FLAIL_RAD_S),
    flail_s=0.1,
    temperature=85.0,
    lost_rate=20.0,
    battery=0.2,
    battery_low=0.1,
    voltage=25.0,
    arm_voltage=28.0,
    command_age_s=0.05,
)
CLIMB_LIMITS: Final = dataclasses.replace(LEG_LIMITS, tumble=8.0)
LEG_SOURCES: Final[Mapping[str, str]] = {
    "legs.effort": (
        "unitree_rl_lab @ e72a072, Go2: effort limit 23.5 N·m for every joint; the calves could give 45.43"
    ),
    "legs.tilt": "walk-these-ways-go2 @ 1c2a074 damps beyond 0.8 rad of roll or pitch",
    "legs.tumble": (
        "unitree_rl_lab @ e72a072, protections of the G1: 6 rad/s; a Go2 that falls over from standing "
        "passes 0.8 rad of tilt at 4.5 rad/s"
    ),
    "legs.free_fall": "assumed: a fifth of gravity; a standing or trotting robot is pressed harder",
    "legs.free_fall_s": "a fall of 0.11 m takes 0.15 s; flight phases of a trot are shorter than 0.1 s",
    "legs.flail_velocity": "two thirds of the motors' speed",
    "legs.flail_s": "at that speed a joint crosses half its range in this time",
    "legs.temperature": "unitree_rl_lab @ e72a072, protections of the G1: 85 °C at the motor's casing",
    "legs.lost_rate": "assumed: 4 % of the commands at 500 Hz",
    "legs.battery": "unitree_rl_lab @ e72a072, protections of the G1: 20 %",
    "legs.battery_low": "assumed: half of that",
    "legs.voltage": "8 cells at 3.1 V, under load",
    "legs.arm_voltage": "manufacturer's data sheet of the Go2: supply 28 V to 33.6 V",
    "legs.command_age_s": "assumed: 25 repeats that were not sent",
}


def driver_limits(
    limits: SafetyLimits, legs: LegLimits = LEG_LIMITS, climbing: LegLimits | None = None
) -> SafetyLimits:
    """Return limits with those for legs, and with a margin for a robot that lies on its stops.

    The calves of a lying robot were seen at -2.81 rad, 0.09 beyond the mechanical range of the models. The
    wire has no effort limit, so no limit below the motors' own is requested: the filter limits the predicted
    effort instead.
    """
    trip = tuple((low - TRIP_MARGIN_RAD, high + TRIP_MARGIN_RAD) for low, high in limits.trip_position)
    return dataclasses.replace(
        limits,
        trip_position=trip,
        effort=floor.per_joint(floor.EFFORT_LIMIT_NM),
        target_step=(TARGET_STEP_RAD,) * 12,
        silence_s=0.2,
        legs=legs,
        climbing=climbing,
    )


DRIVER: Final[RobotDescription] = dataclasses.replace(
    floor.DESCRIPTION,
    state_rate_hz=WIRE_HZ,
    repeat_rate_hz=WIRE_HZ,
    passive_damping=(PASSIVE_DAMPING_NMS_RAD,) * 12,
    rest_position=floor.per_joint(RESTING_RAD),
    feet=tuple(f"{leg}_foot" for leg in floor.LEGS),
    limits=driver_limits(floor.DESCRIPTION.limits, climbing=CLIMB_LIMITS),
    sources={
        **floor.DESCRIPTION.sources,
        "state_rate_hz": "rt/lowstate comes at 500 Hz, its tick counts 2 ms",
        "repeat_rate_hz": "low-level examples of unitree_sdk2_python @ 37116c5: a command every 2 ms",
        "passive_damping": "walk-these-ways-go2 @ 1c2a074: 5; unitree_rl_lab 3, rl_sar and unitree_rl_gym 8",
        "rest_position": "unitree_sdk2_python @ 37116c5, low-level example: hip 0, thigh 1.36, calf -2.65",
        "limits": (
            floor.DESCRIPTION.sources["limits"]
            + "; measured positions may be 0.15 rad outside: lying calves at -2.81 rad in "
            "motor_state_data_example_sit.py of hanlinniu/unitree_sdk2_python @ 4becdb1"
        ),
        "target_step": "motion of a hip or thigh at its top speed, 30.1 rad/s, in a control period of 20 ms",
        "silence_s": "assumed: ten control periods; the robot holds its last target meanwhile",
        **LEG_SOURCES,
    },
)


def legs_on_stand() -> LegLimits:
    """Return the limits for a robot whose base is on a stand: level, and it cannot fall."""
    return dataclasses.replace(LEG_LIMITS, tilt=HELD_TILT_RAD, free_fall=0.0)
