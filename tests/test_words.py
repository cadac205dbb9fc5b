"""Words that the glossary replaced do not come back."""

import re
from pathlib import Path

import pytest

from tests import prose

ROOT = Path(__file__).parents[1]
# Words that are refused in code too, in names and in comments of YAML files.
OLD = re.compile(
    r"luck|yardstick|told[ _]apart|\brungs?\b|ladder|\btwins?\b|slowest|\bfelt\b",
    re.IGNORECASE,
)
FOLDERS = (*prose.CODE, "docs", "tests", "datasets", "checkpoints")
# The table of renames, its test, and this.
NAME_THEM = {
    "benchnav/core/settings.py",
    "tests/eval/test_replay.py",
    "tests/test_words.py",
}
REFUSED = {
    '"""Return a mask of cells whose field is drawn anew."""': "anew",
    '"""Fields that hang together."""': "hang together",
    '"""Return the label; empty if there is none."""': "is none",
    '"""Return so many sequences."""': "so many",
    "# the port is not a number": "not a number",
    'raise ValueError(f"Expected {name}, as nobody gave it.")': "nobody",
    '"""Return the mean, as of `mean_std`."""': "as of ",
    '"""Return the rows of all trials."""': "trials",
    '"""Refuses a path that exists."""': "Refuses",
    'def f():\n    """How the cells are correlated."""': "How",
}
ACCEPTED = (
    '"""Read a file as of version 2."""',
    '"""Return the fraction `is none` of cells."""',
    '"""Return the exact McNemar test of binomial trials."""',
    "# Murray (1998), *Design of Trials that nobody told of*",
    'name = "so many"',
    '"""Return how cells are correlated."""',
)


def test_sentences_have_no_refused_words() -> None:
    assert len(list(prose.sentences())) > 10_000
    assert prose.breaches() == []


@pytest.mark.parametrize(("code", "word"), REFUSED.items(), ids=REFUSED.values())
def test_a_refused_word_in_code_is_found(
    code: str, word: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (breach,) = breaches_of({"benchnav/some.py": code}, tmp_path, monkeypatch)
    assert breach.endswith(f"[{word}]")


@pytest.mark.parametrize("code", ACCEPTED)
def test_quotations_and_terms_of_others_are_accepted(
    code: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert not breaches_of({"benchnav/some.py": code}, tmp_path, monkeypatch)


def test_a_refused_word_on_a_page_is_found_with_its_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = "# Worlds\n\n```sh\nbenchnav-eval list  # so many\n```\n\nλ is drawn anew.\n"
    (breach,) = breaches_of({"docs/worlds.md": page}, tmp_path, monkeypatch)
    assert breach == "docs/worlds.md:7: λ is drawn anew. [anew]"


def breaches_of(
    files: dict[str, str], root: Path, monkeypatch: pytest.MonkeyPatch
) -> list[str]:
    """Return the breaches of a repository that has only these files."""
    for name, text in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    monkeypatch.setattr(prose, "ROOT", root)
    return prose.breaches()


def test_old_words_are_gone() -> None:
    files = [
        path
        for folder in FOLDERS
        for path in (ROOT / folder).rglob("*")
        if path.suffix in (".py", ".md", ".yaml")
    ]
    assert len(files) > 400
    old_words = {}
    for path in [*files, ROOT / "README.md"]:
        name = path.relative_to(ROOT).as_posix()
        old_word = OLD.search(path.read_text())
        if old_word and name not in NAME_THEM:
            old_words[name] = old_word[0]
    assert not old_words
