"""Words that the glossary replaced do not come back."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
OLD = re.compile(r"luck|yardstick|told[ _]apart|\brungs?\b|ladder|\btwins?\b|slowest|\bfelt\b", re.IGNORECASE)
# The table of renames, its test, and this.
NAME_THEM = {"benchnav/core/settings.py", "tests/eval/test_replay.py", "tests/test_words.py"}


def test_old_words_are_gone() -> None:
    folders = ("benchnav", "benchmarks", "docs", "examples", "tests", "datasets", "checkpoints")
    files = [
        path
        for folder in folders
        for path in (ROOT / folder).rglob("*")
        if path.suffix in (".py", ".md", ".yaml")
    ]
    assert len(files) > 400
    found = {
        f"{path.relative_to(ROOT).as_posix()}: {old[0]}"
        for path in [*files, ROOT / "README.md"]
        if path.relative_to(ROOT).as_posix() not in NAME_THEM and (old := OLD.search(path.read_text()))
    }
    assert not found
