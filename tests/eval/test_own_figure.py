"""A figure from one file: by the command and by the suite, and what is said of one that
cannot be drawn.
"""

from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from matplotlib.figure import Figure as Drawing

from benchnav.core import registry
from benchnav.core.errors import ConfigError
from benchnav.eval.experiment.suite import Suite
from benchnav.eval.figures import figures_of
from benchnav.eval.figures.data import RunData
from benchnav.eval.figures.shipped import SHIPPED
from benchnav.eval.report.write import read_report, write_report
from benchnav.eval.results import open_results
from benchnav.eval.run.check import check_suite
from benchnav.viz import Figure
from tests.commands import call
from tests.eval.report.test_write import episodes, run_folder

OWN = Path(__file__).parents[2] / "examples/own_figure.py"
BROKEN = """
from benchnav.viz import Figure

class Broken(Figure):
    name = "broken"
    def caption(self, data): return "Nothing."
    def draw(self, data): raise ValueError("no such\\ncolumn")

class Double(Broken):
    name = "success"

class Outside(Broken):
    name = "../outside"
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return run_folder(tmp_path / "run", episodes())


def test_the_command_draws_a_figure_of_one_file(folder: Path) -> None:
    assert len(OWN.read_text().splitlines()) <= 40
    assert OWN.read_text() in (OWN.parents[1] / "docs/how-to/own-figure.md").read_text()
    assert call("eval", "report", str(folder), "--figures", f"{OWN}:WhenFailed") == 0
    assert matplotlib.image.imread(folder / "figures/when-failed.png").size > 10_000
    assert (folder / "figures/when-failed.pdf").is_file()
    assert (
        "Times at which 4 failed episodes ended."
        in (folder / "report.html").read_text()
    )


def test_the_figure_shows_each_failure_once(folder: Path) -> None:
    report = read_report(folder)
    (figure,) = registry.make("figure", f"{OWN}:WhenFailed").variants(report)
    (panel,) = figure(report).axes
    corners = np.concatenate([patch.get_xy() for patch in panel.patches])
    # all of one planner, at one time
    assert corners[:, 1].max() == len(report.failures) == 4


def test_a_suite_names_figures_of_its_report(tmp_path: Path) -> None:
    suite = {"figures": [f"{OWN}:WhenFailed", "success"]}
    folder = run_folder(tmp_path / "run", episodes(), suite=suite)
    assert not write_report(folder).faults
    assert (
        "![when-failed](figures/when-failed.png)" in (folder / "summary.md").read_text()
    )


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("Broken", "the figure broken is missing: ValueError: no such column"),
        (
            "Double",
            "Expected a figure with a unique name that can be a file name, got 'success'.",
        ),
        (
            "Outside",
            "Expected a figure with a unique name that can be a file name, got '../outside'.",
        ),
    ],
)
def test_a_report_is_written_without_a_figure_that_fails(
    folder: Path,
    tmp_path: Path,
    name: str,
    why: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "own.py").write_text(BROKEN)
    names = f"{tmp_path / 'own.py'}:{name},{OWN}:WhenFailed"
    assert call("eval", "report", str(folder), "--figures", f"[{names}]") == 1
    (line,) = [
        line for line in capsys.readouterr().out.splitlines() if "is missing" in line
    ]
    assert why in line
    assert why.split(":")[0] in (folder / "summary.md").read_text()
    assert (folder / "figures/when-failed.png").is_file()
    assert not (folder / "figures/broken.png").exists()


def test_what_is_no_figure_is_an_error_before_anything_runs_or_is_written(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "own.py").write_text("class Own: ...")
    part = f"{tmp_path / 'own.py'}:Own"
    assert call("eval", "report", str(folder), "--figures", part) == 2
    assert (
        "to be an instance of benchnav.viz.Figure, got Own" in capsys.readouterr().err
    )
    assert not (folder / "report.html").exists()
    with pytest.raises(ConfigError, match=r"an instance of benchnav\.viz\.Figure"):
        check_suite(Suite(figures=(part,)), uses_workers=False)


def test_shipped_figures_have_names_and_needs_and_are_listed_in_order(
    folder: Path,
) -> None:
    assert {
        registry.find("figure", name).target for name in registry.names("figure")
    } == set(SHIPPED)
    report = read_report(folder)
    more = [registry.make("figure", name) for name in ("success", f"{OWN}:WhenFailed")]
    names = [figure.name for figure in figures_of(report, more)]
    assert names == ["success", "outcomes", "distributions", "when-failed"]


class Twice(Figure):
    """Two variants, each with its place as title."""

    name, place = "twice", 0

    def variants(self, data: RunData) -> list["Twice"]:
        return self.numbered(2)

    def draw(self, data: RunData) -> Drawing:
        figure = Drawing()
        figure.suptitle(self.name)
        return figure


def test_all_variants_of_a_figure_are_drawn(folder: Path) -> None:
    drawn = open_results(folder).plot(Twice())
    assert isinstance(drawn, list)
    assert [figure.get_suptitle() for figure in drawn] == ["twice-1", "twice-2"]
