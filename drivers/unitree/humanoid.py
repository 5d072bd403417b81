"""Tables of a humanoid's parts, and values of its joints from them."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence


def part_of(joint: str) -> str:
    """Return a joint's part without side and ending, such as ``hip_roll``."""
    return joint.removesuffix("_joint").removeprefix("left_").removeprefix("right_")


def per_joint(table: Mapping[str, float], joints: Sequence[str]) -> tuple[float, ...]:
    """Return a value for each joint from one for each part."""
    return tuple(table[part_of(joint)] for joint in joints)


def is_mirrored(joint: str, parts: Collection[str]) -> bool:
    """Return whether a joint is on the right side, and its part has the other sign there."""
    return joint.startswith("right_") and part_of(joint) in parts


def mirrored_ranges(
    table: Mapping[str, tuple[float, float]], mirrored: Collection[str], joints: Sequence[str]
) -> tuple[tuple[float, float], ...]:
    """Return a range for each joint from those of the parts on the left side.

    Args:
        table: Range of each part on the left side [rad].
        mirrored: Parts with the other sign on the right side.
        joints: The joints.
    """
    found = []
    for joint in joints:
        low, high = table[part_of(joint)]
        found.append((-high, -low) if is_mirrored(joint, mirrored) else (low, high))
    return tuple(found)


def mirrored_pose(
    table: Mapping[str, float], mirrored: Collection[str], joints: Sequence[str]
) -> tuple[float, ...]:
    """Return a position for each joint from those of the parts on the left side; see mirrored_ranges."""
    return tuple(
        -table[part_of(joint)] if is_mirrored(joint, mirrored) else table[part_of(joint)] for joint in joints
    )
