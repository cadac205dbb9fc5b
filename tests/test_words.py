"""Words that the glossary replaced do not come back."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
OLD = re.compile(
    r"luck|yardstick|told[ _]apart|\brungs?\b|ladder|\btwins?\b|slowest|\bfelt\b",
    re.IGNORECASE,
)
# Unmistakable parts of sentences that no reader understood.
RIDDLES = re.compile(
    r"so many maps show|told apart from it|does not tell from it|is told the truth|of the draws of λ [\d{]|joined "
    r"start and goal by no ground|shows from|has a way over ground|since which these|may leave 0 out|"
    r"randomization conditions|independent conditions|none for example|\(a (\w+), a \1\)|noise of λ, and what",
    re.IGNORECASE,
)
# The table of renames, its test, and this.
NAME_THEM = {
    "benchnav/core/settings.py",
    "tests/eval/test_replay.py",
    "tests/test_words.py",
}


def test_riddles_are_gone() -> None:
    files = [
        path for folder in ("benchnav", "docs") for path in (ROOT / folder).rglob("*")
    ]
    texts = {
        path.relative_to(ROOT).as_posix(): " ".join(_joined(path).split())
        for path in files
        if path.suffix in (".py", ".md", ".html", ".yaml")
    }
    assert len(texts) > 250
    assert not {
        f"{name}: {riddle[0]}"
        for name, text in texts.items()
        if (riddle := RIDDLES.search(text))
    }
    assert RIDDLES.search("So many maps show a difference from about 46 points on.")


def _joined(path: Path) -> str:
    """The text of a file, in which a sentence of several literals is one."""
    return re.sub(r'"\s*\n\s*f?"', "", path.read_text())


def test_old_words_are_gone() -> None:
    folders = (
        "benchnav",
        "benchmarks",
        "studies",
        "docs",
        "examples",
        "tests",
        "datasets",
        "checkpoints",
    )
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
        if path.relative_to(ROOT).as_posix() not in NAME_THEM
        and (old := OLD.search(path.read_text()))
    }
    assert not found
