"""Where pages and notebooks are run."""

import os
import stat
import sys
from pathlib import Path

import pytest

from tests.docs.pages import ROOT

TAKEN = ("examples", "datasets", "checkpoints", "docs")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder to work in, with what a checkout has."""
    for taken in TAKEN:
        (tmp_path / taken).mkdir()
        for own in (ROOT / taken).iterdir():
            (tmp_path / taken / own.name).symlink_to(own)
    commands = tmp_path / ".commands"
    commands.mkdir()
    for program in ("datagen", "train", "eval"):
        path = commands / f"benchnav-{program}"
        path.write_text(
            f'#!/bin/sh\nexec "{sys.executable}" -m tests.docs.smaller {program} "$@"\n'
        )
        path.chmod(path.stat().st_mode | stat.S_IEXEC)
    return tmp_path


@pytest.fixture
def environment(folder: Path) -> dict[str, str]:
    """The variables of processes that run there: commands are the smaller ones."""
    before = f"{folder / '.commands'}{os.pathsep}{Path(sys.executable).parent}"
    return {
        "BENCHNAV_DOCS_MAPS": "2",
        **os.environ,
        "PATH": f"{before}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": f"{ROOT}{os.pathsep}{folder}",
        "MPLBACKEND": "agg",
    }
