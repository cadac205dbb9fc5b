from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from benchnav.eval.experiment.hypotheses import digest_of_tests
from benchnav.eval.figures.forest import Forest
from benchnav.eval.report.hypotheses import hypothesis_findings, hypothesis_table
from benchnav.eval.report.write import write_report
from tests.eval.report import made
from tests.eval.report.test_write import run_folder


def a_test(**changes: Any) -> dict[str, Any]:
    return {
        "one": "a", "other": "b", "names": ("cvar", "mean"), "metric": "T_total", "kind": "equivalence",
        "direction": "",
        "margin": 0.5, "claim": "T_total of cvar and of mean differs by less than 0.5 s", "unit": "s", "n_maps": 40,
        "n_episodes": 80, "mean_one": 35.2, "mean_other": 35.1, "difference": 0.1, "low": -0.25, "high": 0.45,
        "low_90": -0.2, "high_90": 0.4, "p": 0.01, "p_holm": 0.02, "supported": True,
    } | changes  # fmt: skip


OTHER = {
    "kind": "difference", "metric": "success", "margin": 0.0, "unit": "points", "difference": -4.0, "low": -14.0,
    "high": 6.0, "low_90": -12.0, "high_90": 4.0, "p_holm": 0.6, "supported": False,
    "claim": "success of cvar differs from that of mean",
}  # fmt: skip
ABOUT = {
    "hypotheses": {"digest": "d1", "episodes": {"a": 80, "b": 80}},
    "conditions": {name: {"draws": [[0, 0, 40], [1, 0, 40]]} for name in "ab"},
}


def test_each_hypothesis_is_said_with_its_numbers() -> None:
    ((title, sentences),) = hypothesis_findings(
        pd.DataFrame([a_test(), a_test(**OTHER)]), ABOUT, "map"
    ).items()
    assert title == "Hypotheses, fixed before the first unit was run (digest d1)"
    assert sentences == [
        "1. T_total of CVaR and of mean differs by less than 0.5 s: equivalent (difference +0.10 s, interval -0.20 to "
        "+0.40 (90 %), p = 0.02, 40 maps).",
        "2. Success of CVaR differs from that of mean: no significant difference (difference -4.0 points, interval "
        "-14.0 to +6.0 (95 %), p = 0.6, 40 maps).",
    ]


def test_names_with_commas_are_in_brackets() -> None:
    row = a_test(**OTHER, names=("std, mppi, cvar", "straight"))
    (sentences,) = hypothesis_findings(pd.DataFrame([row]), ABOUT, "map").values()
    assert sentences[0].startswith(
        "1. Success of (std, MPPI, CVaR) differs from that of straight: "
    )


def test_an_extension_after_the_hypotheses_is_told() -> None:
    conditions = {"a": {"draws": [[0, 0, 200]]}, "b": {"draws": [[0, 0, 80]]}}
    (said,) = hypothesis_findings(
        pd.DataFrame([a_test()]), ABOUT | {"conditions": conditions}, "group"
    ).values()
    assert said[-1].startswith(
        "The run was extended after the hypotheses were fixed (episodes per condition: 80 then, 80 to 200 now)"
    )
    assert "40 groups" in said[0]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"supported": False}, "equivalence not shown"),
        ({"kind": "non-inferiority"}, "not inferior"),
        ({"kind": "non-inferiority", "supported": False}, "non-inferiority not shown"),
        ({"kind": "superiority"}, "superior"),
        ({"kind": "superiority", "supported": False}, "superiority not shown"),
        ({"kind": "difference", "direction": ""}, "significantly different"),
        ({"kind": "difference", "direction": "lower"}, "significantly lower"),
        (
            {"kind": "difference", "direction": "lower", "supported": False},
            "not significantly lower",
        ),
    ],
)
def test_a_verdict_is_that_of_its_kind(changes: dict[str, Any], words: str) -> None:
    table = hypothesis_table(pd.DataFrame([a_test(**changes)]), "map")
    assert table.rows[0][-1] == words
    assert bool(made.bold_cells(table)) == (changes.get("supported", True))


def test_a_difference_of_time_says_that_its_interval_and_its_p_are_of_two_kinds() -> (
    None
):
    for test, said in (
        (a_test(kind="difference"), True),
        (a_test(), False),
        (a_test(**OTHER), False),
    ):
        explained = hypothesis_table(pd.DataFrame([test]), "map").explained
        assert (
            any("although the interval contains 0" in text for _, text in explained)
            == said
        )


def test_a_forest_has_a_panel_a_metric_with_points_intervals_and_margins() -> None:
    rows = [
        a_test(),
        a_test(**OTHER),
        a_test(
            supported=False, difference=2.0, kind="non-inferiority", direction="lower"
        ),
        a_test(supported=False, kind="superiority", direction="lower"),
        a_test(supported=False, kind="superiority", direction="higher"),
    ]
    success, time = Forest().draw(made.run_data(tests=pd.DataFrame(rows))).axes
    assert [panel.get_xlabel() for panel in (success, time)] == [
        "Δ success [points]",
        "Δ T_total [s]",
    ]
    points = [line for line in time.lines if line.get_marker() == "o"]
    assert [float(point.get_xdata()[0]) for point in points] == [0.1, 2.0, 0.1, 0.1]
    assert [point.get_markerfacecolor() == "white" for point in points] == [
        False,
        True,
        True,
        True,
    ]
    spans = {
        tuple(map(float, line.get_xdata()))
        for line in time.lines
        if len(line.get_xdata()) == 2
    }
    assert {(-0.25, 0.45), (-0.2, 0.4)} <= spans
    bands = [band.get_paths()[0].get_extents() for band in time.collections]
    assert (bands[0].x0, bands[0].x1) == (-0.5, 0.5)
    # of what is better the lower all below the margin is
    assert bands[1].x0 == time.get_xlim()[0]
    assert bands[1].x1 == 0.5
    assert (bands[2].x0, bands[2].x1) == (time.get_xlim()[0], -0.5)
    assert (bands[3].x0, bands[3].x1) == (0.5, time.get_xlim()[1])
    assert not success.collections
    assert [label.get_text() for label in success.get_yticklabels()] == [
        "2. CVaR\n− mean"
    ]
    assert [label.get_text().split(".")[0] for label in time.get_yticklabels()] == [
        "1",
        "3",
        "4",
        "5",
    ]


def test_a_forest_is_drawn_where_no_episode_tells_anything() -> None:
    nothing = dict.fromkeys(("difference", "low", "high", "low_90", "high_90"), np.nan)
    (panel,) = (
        Forest()
        .draw(
            made.run_data(
                tests=pd.DataFrame([a_test(kind="difference", margin=0.0, **nothing)])
            )
        )
        .axes
    )
    assert np.isfinite(panel.get_xlim()).all()


def test_a_report_tests_them_first_and_heads_the_rest_exploratory(
    tmp_path: Path,
) -> None:
    rows = made.rows(
        made.row(made.condition(risk=risk), i, 30.0 + i)
        for risk in ("mean", "cvar")
        for i in range(8)
    )
    one, other = rows["condition"].unique()[::-1]
    plain = {name: a_test(one=one, other=other, margin=5.0)[name] for name in
             ("one", "other", "names", "metric", "kind", "direction", "margin", "claim")}  # fmt: skip
    hypotheses = {
        "tests": [plain],
        "digest": digest_of_tests([plain]),
        "episodes": {one: 8, other: 8},
    }
    folder = run_folder(tmp_path / "run", rows, hypotheses=hypotheses)
    report = write_report(folder)
    assert [title.split(",")[0] for title in report.findings] == [
        "Hypotheses",
        "Exploratory: std",
    ]
    assert report.tests["difference"].tolist() == [0]
    text = (folder / "summary.md").read_text()
    assert text.index("forest.png") < text.index("success.png")
    assert "| hypothesis |" in text
    assert "TOST" in text
    for name in ("hypotheses.csv", "hypotheses.tex", "figures/forest.pdf"):
        assert (folder / name).stat().st_size > 100
    assert "forest" in (folder / "report.html").read_text()
