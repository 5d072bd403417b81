"""A column map to start from: printed where the channels are not guessed, read back as a column map."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deal_hw.data.importing.columns import read_column_map
from deal_hw.data.importing.load import load_tables
from deal_hw.errors import DatasetError

JOINTS = ("boom", "stick")


def printed(path: Path, joints: tuple[str, ...] | None = JOINTS) -> list[str]:
    """Return the lines of the column map that reading a file prints."""
    output: list[str] = []
    try:
        load_tables(path, joints=joints, say=output.append)
    except DatasetError as error:
        output.append(str(error))
    (start,) = (at for at, text in enumerate(output) if "a column map to start from" in text)
    return [text for text in output[start + 1 :] if text.startswith("  ")]


def test_unknown_channels_give_a_map_that_is_read_once_its_columns_are_named(tmp_path: Path) -> None:
    """Time is filled in where it is known; each joint of the model has its entry."""
    path = tmp_path / "a.csv"
    path.write_text("time,a,b,c,d\n0,1,2,3,4\n0.1,5,6,7,8\n", encoding="utf-8")
    lines = printed(path)
    assert lines[0].strip() == 'time: {column: "time", unit: s}'
    text = "\n".join(lines)
    assert text.count("COLUMN") == 4
    for name in "abcd":
        text = text.replace("COLUMN", name, 1)
    (tmp_path / "columns.yaml").write_text(text, encoding="utf-8")
    (table,) = load_tables(path, read_column_map(tmp_path / "columns.yaml"), JOINTS)
    assert table.position.tolist() == [[1, 3], [5, 7]] and table.target.tolist() == [[2, 4], [6, 8]]


def test_an_unknown_time_and_no_model_leave_their_places_open(tmp_path: Path) -> None:
    """Neither is invented. The joints are filled in although the time is unknown."""
    path = tmp_path / "a.csv"
    path.write_text("zeit,b\n0,1\n1,5\n", encoding="utf-8")
    assert printed(path, None) == [
        "  time: {column: COLUMN, unit: s}",
        "  joints:",
        '    - {name: "JOINT", position: COLUMN, target: COLUMN, unit: rad}',
    ]
    path.write_text("zeit,boom_pos,boom_cmd\n0,1,2\n1,5,6\n", encoding="utf-8")
    assert printed(path)[2:] == [
        '    - {name: "boom", position: "boom_pos", target: "boom_cmd", unit: "rad"}',
        '    - {name: "stick", position: COLUMN, target: COLUMN, unit: rad}',
    ]


@pytest.mark.parametrize("header", ["t_ms,boom_pos_deg,boom_cmd,x", 't_ms,"boom pos deg",boom_cmd,x'])
def test_a_joint_that_was_not_found_is_added_to_the_guessed_ones(header: str, tmp_path: Path) -> None:
    """The guessed entries are kept, with their units, and quoted where YAML needs it."""
    path = tmp_path / "a.csv"
    path.write_text(f"{header}\n0,180,2,3\n10,90,6,7\n", encoding="utf-8")
    text = "\n".join(printed(path)).replace("position: COLUMN", "position: x").replace(", target: COLUMN", "")
    (tmp_path / "columns.yaml").write_text(text, encoding="utf-8")
    (guessed,), (table,) = load_tables(path), load_tables(path, read_column_map(tmp_path / "columns.yaml"))
    assert table.position[:, 0].tolist() == guessed.position[:, 0].tolist()
    assert table.position[:, 0] == pytest.approx([3.14159265, 1.57079633])
    assert table.position[:, 1].tolist() == [3, 7] and table.time_s.tolist() == [0, 0.01]


def test_a_guess_that_was_printed_is_not_printed_again(tmp_path: Path) -> None:
    """Twenty recordings of one robot give one map and nineteen lines; another header gives its own map."""
    one, other = "time,boom_pos,boom_cmd\n0,1,2\n1,1,2\n", "time,boom_pos\n0,1\n1,1\n"
    reported: list[str] = []
    known: dict[str, str] = {}
    for name, text in (("a.csv", one), ("b.csv", one), ("c.csv", other)):
        (tmp_path / name).write_text(text)
        load_tables(tmp_path / name, joints=("boom",), say=reported.append, printed=known)
    assert reported.count("b.csv: the same column map as a.csv") == 1
    assert [line.partition(":")[0] for line in reported if "was guessed" in line] == ["a.csv", "c.csv"]


@pytest.mark.parametrize(
    "header",
    [
        "t_ms,boom_pos_deg,boom_cmd_deg,stick_pos,stick_cmd_deg,boom_vel",
        "time,stick,boom_actual_deg,boom_cmd_rad,stick_cmd,x",
    ],
)
def test_a_guess_is_printed_as_the_map_that_says_the_same(header: str, tmp_path: Path) -> None:
    """A user who has to turn one sign saves the lines and changes one entry; units of targets stay."""
    path = tmp_path / "a.csv"
    path.write_text(f"{header}\n0,1,2,3,4,5\n10,6,8,7,9,10\n", encoding="utf-8")
    output: list[str] = []
    (guessed,) = load_tables(path, joints=JOINTS, say=output.append)
    assert "no column map given; this one was guessed" in output[0] and "in Python by columns=" in output[0]
    text = "\n".join(line for line in output if line.startswith("  "))
    (tmp_path / "columns.yaml").write_text(text, encoding="utf-8")
    (read,) = load_tables(path, read_column_map(tmp_path / "columns.yaml"), JOINTS)
    np.testing.assert_array_equal(read.position, guessed.position)
    np.testing.assert_array_equal(read.target, guessed.target)
    np.testing.assert_array_equal(read.time_s, guessed.time_s)
    assert (read.velocity is None) == (guessed.velocity is None)


def test_a_channel_that_is_in_the_file_is_filled_in(tmp_path: Path) -> None:
    """The stick's position has a name of its own, its target not: only the position was not found."""
    path = tmp_path / "a.csv"
    path.write_text("time,boom_pos,boom_cmd,s7,stick_cmd\n0,1,2,3,4\n0.1,5,6,7,8\n", encoding="utf-8")
    assert printed(path)[2:] == [
        '    - {name: "boom", position: "boom_pos", target: "boom_cmd", unit: "rad"}',
        '    - {name: "stick", position: COLUMN, target: "stick_cmd", unit: rad}',
    ]
