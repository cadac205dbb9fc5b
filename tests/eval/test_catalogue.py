"""What `benchnav-eval list` shows: every part with its options, and nothing hidden by
one that is broken.
"""

import json
import re
import shutil
import sys
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from rich.cells import cell_len

from benchnav.core import part_lookup, registry
from benchnav.core.errors import ConfigError
from benchnav.core.tables import to_terminal
from benchnav.eval import catalogue
from benchnav.eval.catalogue import (
    Entry,
    list_entries,
    make_table,
    plain_lines,
    print_catalogue,
)
from benchnav.models.base import is_family

CHECKPOINTS = Path(__file__).parents[2] / "checkpoints"


@dataclass(frozen=True, kw_only=True)
class Follower:
    gain: float = 2.0
    widths: tuple[float, float] = (0.5, 1.0)


@dataclass(frozen=True, kw_only=True)
class Config:
    count: int
    mode: str = "a"
    limit: float | None = None
    follower: Follower = field(default_factory=lambda: Follower(gain=3.0))
    second: Follower | None = None


class Mine:
    """Plans [somehow].

    More of it.
    """

    def __init__(self, config: Config) -> None:
        self.config = config


@pytest.fixture(autouse=True)
def _registered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(part_lookup, "_REGISTERED", {})
    registry.register("planner", "mine", Mine)


def test_options_are_told_with_types_defaults_and_those_within() -> None:
    (entry,) = [entry for entry in list_entries("planner") if entry.name == "mine"]
    assert entry == Entry(
        name="mine",
        purpose="Plans [somehow].",
        options=(
            "count: int (required)",
            'mode: str = "a"',
            "limit: float | None = null",
            "follower.gain: float = 3.0",
            "follower.widths: tuple[float, float] = [0.5, 1.0]",
            "second: Follower | None = null",
        ),
    )


@pytest.mark.parametrize("kind", registry.KINDS)
def test_every_known_part_is_listed_with_a_purpose_and_all_its_options(
    kind: str,
) -> None:
    entries = {entry.name: entry for entry in list_entries(kind)}
    for name in registry.names(kind):
        assert entries[name].purpose
        assert "cannot be used" not in entries[name].purpose
        target = registry.find(kind, name).target
        if is_family(target):
            assert f"Train it by `benchnav-train fit {name}`" in entries[name].purpose
            continue
        options = " ".join(entries[name].options)
        assert all(option in options for option in registry.options_of(kind, target))


def test_worlds_are_listed_by_the_names_that_flags_and_suites_have() -> None:
    paper, stakes = list_entries("world")
    assert (paper.name, stakes.name) == ("paper", "stakes")
    assert "resampled" in paper.purpose
    assert "immobilises" in stakes.purpose
    assert {
        'world.noise = "resampled"',
        "world.time_budget_s = 100.0",
        "task.min_traversability = 0.3",
    } <= set(paper.options)
    assert not any("immobile" in option for option in paper.options)
    assert {
        'world.noise = "frozen"',
        "world.correlation_m = 1.5",
        "world.immobile.below = 0.1",
        "world.time_budget_ratio = 3.0",
        'task.free_space.by = "mean"',
    } <= set(stakes.options)


def test_a_dataclass_without_a_docstring_has_no_made_up_purpose() -> None:
    registry.register("robot", "bare", Follower)
    (entry,) = [entry for entry in list_entries("robot") if entry.name == "bare"]
    assert entry.purpose == ""


def test_a_part_that_cannot_be_imported_hides_no_other(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    info = tmp_path / "broken-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: broken\nVersion: 1\n")
    (info / "entry_points.txt").write_text(
        "[benchnav.risks]\nbroken = nowhere_at_all:risk\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    entries = {entry.name: entry.purpose for entry in list_entries("risk")}
    assert entries["broken"].startswith("cannot be used: ")
    assert "nowhere_at_all" in entries["broken"]
    assert entries["mean"]


def test_checkpoints_here_and_of_this_checkout_are_listed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copytree(CHECKPOINTS / "paper-v1", "checkpoints/mine")
    config = Path("checkpoints/mine/config.json")
    config.write_text(json.dumps(json.loads(config.read_text()) | {"model": "theirs"}))
    Path("checkpoints/damaged").mkdir()
    Path("checkpoints/damaged/config.json").write_text("{")
    entries = {entry.name: entry.purpose for entry in list_entries("model")}
    assert (
        entries["mine"]
        == "Checkpoint of the family theirs in checkpoints/mine, 10 classes."
    )
    assert entries["damaged"].startswith(
        "cannot be used: checkpoints/damaged/config.json is damaged"
    )
    assert (
        entries["paper-v1"]
        == f"Checkpoint of the family fused in {CHECKPOINTS / 'paper-v1'}, 10 classes."
    )


def test_plain_lines_where_there_is_no_terminal(
    capsys: pytest.CaptureFixture[str],
) -> None:
    print_catalogue("planner")
    out = capsys.readouterr().out.splitlines()
    assert out == plain_lines("planner")
    at = out.index("planner mine: Plans [somehow].")
    assert out[at + 1 : at + 3] == ["    count: int (required)", '    mode: str = "a"']
    print_catalogue("risk", "robot")
    assert capsys.readouterr().out.splitlines() == [
        *plain_lines("risk"),
        *plain_lines("robot"),
    ]
    print_catalogue("")
    kinds = [
        line.split()[0]
        for line in capsys.readouterr().out.splitlines()
        if not line.startswith(" ")
    ]
    assert list(dict.fromkeys(kinds)) == [*registry.KINDS, "world"]


def test_a_table_where_there_is_one(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
    monkeypatch.setenv("COLUMNS", "100")
    print_catalogue("planner")
    out = capsys.readouterr().out
    assert "planners" in out
    assert "Plans [somehow]." in out
    assert " ".join(catalogue.HELP.split()) in " ".join(out.split())


@pytest.mark.parametrize("width", [100, 130])
@pytest.mark.parametrize("kind", [*registry.KINDS, "world"])
def test_tables_fit_and_break_no_option(kind: str, width: int) -> None:
    text = to_terminal(make_table(kind), width=width, styled=True)
    text = re.sub(r"\x1b\[[0-9;]*m", "", text)
    assert max(map(cell_len, text.splitlines())) <= width
    for entry in list_entries(kind):
        assert entry.name in text
        assert all(option in text for option in entry.options)


def test_an_unknown_kind_gets_a_hint() -> None:
    with pytest.raises(ConfigError, match="Did you mean 'planner'"):
        print_catalogue("planers")
