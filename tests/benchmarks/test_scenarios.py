"""The tables of docs/studies/scenarios.md are written where they stand."""

import shutil
from pathlib import Path

import pytest

from benchmarks.scenarios import DOCS, rewrite

PAGE = DOCS / "studies" / "scenarios.md"
NAMES = ("ground", "model", "calibration", "pairs", "slopes", "colours")


def test_each_table_has_its_place_on_the_page(tmp_path: Path) -> None:
    page = Path(shutil.copy(PAGE, tmp_path))
    rewrite(page, {name: f"| {name} |\n| --- |" for name in NAMES})
    text = page.read_text()
    for name in NAMES:
        assert f"| {name} |" in text
    assert text.count("<!-- end -->") == PAGE.read_text().count("<!-- end -->") == len(NAMES)


def test_a_table_is_as_far_in_as_its_markers(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("<!-- a -->\nold\n<!-- end -->\n    <!-- b -->\n\n    old\n\n    <!-- end -->\nC\n")
    for _ in range(2):
        rewrite(page, {"a": "| 1 |", "b": "| 2 |\n| 3 |"})
        assert page.read_text() == (
            "<!-- a -->\n| 1 |\n<!-- end -->\n    <!-- b -->\n\n    | 2 |\n    | 3 |\n\n    <!-- end -->\nC\n"
        )


def test_a_table_without_a_place_is_an_error(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("A\n")
    with pytest.raises(ValueError, match="Expected `<!-- a -->`"):
        rewrite(page, {"a": "| 1 |"})
