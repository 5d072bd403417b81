"""Files that appear together, interrupts that wait for them, and files that are read in parts."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest
from mcap.writer import MCAP0_MAGIC

from deal_hw.data import files
from deal_hw.data.files import interrupts_deferred, opened_episode, published_together
from deal_hw.errors import DatasetError


def test_files_appear_together(tmp_path: Path) -> None:
    """While the block runs the folder is as it was; afterwards all is there, and what was beside it stays."""
    folder = tmp_path / "results"
    folder.mkdir()
    (folder / "a").write_text("old")
    (folder / "own").write_text("kept")
    with published_together(folder) as waiting:
        (waiting / "a").write_text("new")
        (waiting / "b").write_text("new")
        assert waiting.parent == folder.parent
        assert {f.name: f.read_text() for f in folder.iterdir()} == {"a": "old", "own": "kept"}
    assert {f.name: f.read_text() for f in folder.iterdir()} == {"a": "new", "b": "new", "own": "kept"}
    assert list(tmp_path.iterdir()) == [folder]


def test_an_error_changes_nothing(tmp_path: Path) -> None:
    """Half of the files is none of them."""
    with pytest.raises(ZeroDivisionError), published_together(tmp_path / "results") as waiting:
        (waiting / "a").write_text("new")
        raise ZeroDivisionError
    assert [list(folder.iterdir()) for folder in tmp_path.iterdir()] == [[]]


def test_a_link_is_followed(tmp_path: Path) -> None:
    """Beside the folder is where the folder really is."""
    (tmp_path / "disk" / "real").mkdir(parents=True)
    (tmp_path / "link").symlink_to(tmp_path / "disk" / "real")
    with published_together(tmp_path / "link") as waiting:
        (waiting / "a").write_text("new")
        assert waiting.parent == tmp_path / "disk"
    assert (tmp_path / "disk" / "real" / "a").read_text() == "new"


def test_an_interrupt_waits_for_the_outermost_block() -> None:
    """One SIGINT, two blocks: both finish, then it takes effect, once."""
    done = []
    with pytest.raises(KeyboardInterrupt), interrupts_deferred():
        with interrupts_deferred():
            os.kill(os.getpid(), signal.SIGINT)
            done.append("inner")
        done.append("outer")
    assert done == ["inner", "outer"]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_an_episode_file_finds_what_its_bytes_do(tmp_path: Path) -> None:
    """Marks close together, across the parts that are kept, and at both ends; slices as of bytes."""
    mark, gap = b"\x04\0\0\0zstd", files._WINDOW_BYTES
    content = MCAP0_MAGIC + mark * 3 + bytes(gap - 36) + mark + bytes(gap) + mark
    path = tmp_path / "a.mcap"
    path.write_bytes(content)
    with opened_episode(path) as data:
        starts = [*range(40), gap - 40, gap + 4, len(content) - 8, len(content) - 7, len(content) + 5]
        assert [data.find(mark, at) for at in starts] == [content.find(mark, at) for at in starts]
        for part in (slice(3, 20), slice(20, 3), slice(len(content) - 3, len(content) + 9)):
            assert data[part] == content[part]
        os.truncate(path, 100)
        with pytest.raises(DatasetError, match=r"a\.mcap became shorter while it was read"):
            data[90:110]
