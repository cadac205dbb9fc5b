"""A study of two maps, from its maps to the tables and figures of its page."""

from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import yaml
from matplotlib.figure import Figure

import studies.__main__ as command
from studies import page, runs
from studies.study import Study, Work

PAGE = """# Tiny

<!-- settings tiny-primary -->
old
<!-- end -->

    <!-- hypotheses tiny-primary -->

    old

    <!-- end -->

<!-- settings tiny-later -->
kept
<!-- end -->

<!-- settings other-primary -->
of another study
<!-- end -->
"""
SUITE = {
    "data": "maps",
    "model": "oracle",
    "scenarios": ["std"],
    "maps": 2,
    "record": "none",
    "planners": ["straight", "astar_dwa"],
    "risks": ["mean", "cvar"],
    "world": {"preset": "paper", "time_budget_s": 5.0},
    "hypotheses": [
        {
            "one": {"planner": "astar_dwa", "risk": "cvar"},
            "other": {"planner": "astar_dwa", "risk": "mean"},
            "metric": "success",
        }
    ],
}


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A study of two maps, which is run once."""
    folder = tmp_path_factory.mktemp("home") / "tiny"
    folder.mkdir()
    (folder / "page.md").write_text(PAGE)
    study = {
        "page": str(folder / "page.md"),
        "develop": "maps",
        "maps": {"maps": {"create": ["tiny-v1", "id=maps", "splits.test/std.maps=2"]}},
        "parts": {"primary": None, "later": {"suite": "primary", "maps": 1}},
        "figures": {
            "copied.png": {"copy": "tiny-primary/figures/success.png"},
            "kept.png": {"copy": "tiny-later/figures/a.png"},
        },
    }
    (folder / "study.yaml").write_text(yaml.safe_dump(study))
    (folder / "primary.yaml").write_text(yaml.safe_dump(SUITE))
    assert do(folder, "maps") == do(folder, "run", "primary") == 0
    return folder


@pytest.fixture(autouse=True)
def figures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where figures go, in place of docs/figures."""
    monkeypatch.setattr(page, "FIGURES", tmp_path)
    return tmp_path


def do(folder: Path, *words: str) -> int:
    places = [
        "--out",
        str(folder.parent / "runs"),
        "--maps_in",
        str(folder.parent / "maps"),
        "--jobs",
        "1",
    ]
    return command.main([str(folder), *words, *places])


def work_of(folder: Path) -> Work:
    return Work(out=folder.parent / "runs", maps_in=folder.parent / "maps", jobs=1)


def test_a_report_writes_the_tables_and_figures_of_finished_runs_alone_and_twice_the_same(
    tiny: Path, figures: Path
) -> None:
    assert do(tiny, "report") == 0
    once = (tiny / "page.md").read_text()
    picture = (figures / "copied.png").read_bytes()
    assert do(tiny, "report") == 0
    assert (tiny / "page.md").read_text() == once
    assert (figures / "copied.png").read_bytes() == picture
    assert not (figures / "kept.png").exists()
    first, second, third, fourth = once.split("<!-- end -->")[:4]
    assert "| planner | mean | cvar |" in first
    assert "old" not in first + second
    # A table in a fold is indented, between empty lines.
    assert (
        "    <!-- hypotheses tiny-primary -->\n\n    |  | hypothesis | maps |" in second
    )
    assert second.endswith("\n\n    ")
    assert third == "\n\n<!-- settings tiny-later -->\nkept\n"
    assert fourth == "\n\n<!-- settings other-primary -->\nof another study\n"


def test_maps_of_another_digest_are_rejected_in_one_line(
    tiny: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tiny / "study.yaml"
    text = path.read_text()
    assert do(tiny, "maps") == 0
    digest = capsys.readouterr().out.split()[-1]
    assert len(digest) == 64
    try:
        for given, status in ((digest, 0), ("0" * 64, 2)):
            content = yaml.safe_load(text)
            content["maps"]["maps"]["digest"] = given
            path.write_text(yaml.safe_dump(content))
            assert do(tiny, "maps") == status
    finally:
        path.write_text(text)
    (line,) = capsys.readouterr().err.splitlines()
    assert f"Expected maps of digest {'0' * 64} in" in line
    assert f"got {digest}." in line


def test_kept_rows_take_the_place_of_a_run(tiny: Path, tmp_path: Path) -> None:
    assert do(tiny, "report") == do(tiny, "keep") == 0
    rows = pd.read_parquet(tiny / "rows" / "tiny-primary" / "episodes.parquet")
    assert len(rows) == 2 * 3
    assert set(rows["data"]) == {"maps.h5"}
    assert not (tiny / "rows" / "tiny-later").exists()
    text = (tiny / "page.md").read_text()
    elsewhere = Work(out=tmp_path / "none", maps_in=tmp_path)
    # What is made of the summary alone is the same, and other tables stay as they are.
    assert page.with_tables(text, Study.load(str(tiny)), elsewhere) == text
    emptied = text.replace("| planner |", "| old |")
    assert page.with_tables(emptied, Study.load(str(tiny)), elsewhere) == text


def test_developing_runs_the_suite_on_other_maps(
    tiny: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    driven = {}

    def drive(suite: dict[str, Any], folder: Path, jobs: int) -> None:
        driven[folder.name] = suite

    monkeypatch.setattr(runs, "drive", drive)
    monkeypatch.setattr(command, "power", lambda study, work: "its power")
    assert do(tiny, "develop") == 0
    primary = Study.load(str(tiny)).suite("primary", work_of(tiny))
    assert driven == {"tiny-developed": primary | {"seed": 1}}
    assert "its power" in capsys.readouterr().out


def test_the_first_maps_of_a_part_alone_are_driven(tiny: Path) -> None:
    study = Study.load(str(tiny))
    assert study.suite("later", work_of(tiny))["maps"] == 1
    assert study.suite("primary", Work(out=tiny, maps_in=tiny, maps=7))["maps"] == 7


def test_what_a_script_returns_is_stored_by_its_kind(
    tiny: Path, figures: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def script(
        work: Work, folder: Path, maps: int = 5, word: str = ""
    ) -> dict[str, object]:
        assert Path.cwd() == runs.ROOT
        rows = pd.DataFrame({"name": [word], "value": [maps / 3]})
        return {
            "table": [{"a": 1, "b": "2"}],
            "rows": rows,
            "text": "| c |",
            "figure": Figure(figsize=(1, 1)),
        }

    (tiny / "page.md").write_text(
        PAGE
        + "<!-- table tiny-made -->\n<!-- end -->\n<!-- text tiny-made -->\n<!-- end -->\n"
    )
    monkeypatch.setattr(Study, "function", lambda self, name: script)
    part = {"script": "module:function", "options": {"word": "x"}}
    content = yaml.safe_load((tiny / "study.yaml").read_text())
    content["parts"]["made"] = part
    content["figures"] = {"made.png": {"copy": "tiny-made/figure.png"}}
    (tiny / "study.yaml").write_text(yaml.safe_dump(content))
    assert do(tiny, "report") == 0
    assert "| 1 | 2 |" not in (tiny / "page.md").read_text()
    assert do(tiny, "run", "made", "--maps", "2") == do(tiny, "report") == 0
    text = (tiny / "page.md").read_text()
    assert (
        "<!-- table tiny-made -->\n| a | b |\n|---|---|\n| 1 | 2 |\n<!-- end -->"
        in text
    )
    assert "<!-- text tiny-made -->\n| c |\n<!-- end -->" in text
    made = tiny.parent / "runs" / "tiny-made"
    assert pd.read_csv(made / "rows.csv").to_dict("records") == [
        {"name": "x", "value": pytest.approx(2 / 3)}
    ]
    assert "| x | 0.6667 |" in (made / "rows.md").read_text()
    assert (figures / "made.png").read_bytes()[:4] == b"\x89PNG"
