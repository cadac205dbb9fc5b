import re

import pytest

from benchnav.eval.report.paper_table import paper_table
from tests.eval.report import made


def table_of(*conditions: tuple[dict[str, str], int]) -> str:
    rows = made.rows(
        *([made.row(labels, i, 20.0 if i < n else None) for i in range(40)] for labels, n in conditions)
    )
    return paper_table(made.summary(rows), "run_1")


def body(text: str) -> list[list[str]]:
    """Cells of all lines of the tabulars."""
    lines = [line.strip() for line in text.splitlines()]
    return [[cell.strip() for cell in line[:-2].split("&")] for line in lines if line.endswith(r"\\")]


def test_settings_stand_down_and_scenarios_across() -> None:
    text = table_of(
        (made.condition("astar_dwa", "mean"), 40), (made.condition("astar_dwa", "cvar:0.9"), 10),
        (made.condition("mppi", "mean"), 38), (made.condition("mppi", "mean", scenario="hg"), 20),
    )  # fmt: skip
    titles, heads, *rows = body(text)
    assert titles == ["", "", r"\multicolumn{3}{c}{std}", r"\multicolumn{3}{c}{hg}"]
    assert heads == [
        "Planner",
        "Risk",
        *([r"Succ.\ [\%]", r"$T_\mathrm{total}$ [s]", r"$\bar{\lambda}$ [\%]"] * 2),
    ]
    assert r"\cmidrule(lr){3-5} \cmidrule(lr){6-8}" in text
    assert [row[:2] for row in rows] == [["A* + DWA", "mean"], ["", "cvar:0.9"], ["MPPI", "mean"]]
    # Not 38 but 10 of 40 are significantly worse than 40; hg has one setting alone, so none is bold.
    assert [row[2].split(" ")[0] for row in rows] == [r"\textbf{100}", "25", r"\textbf{95}"]
    assert rows[1][3] == r"80.0 $\pm$ 35.1"
    assert rows[0][5:] == ["--"] * 3
    assert rows[2][5].startswith("50 {")


def test_it_is_a_whole_table_for_booktabs_alone() -> None:
    scenarios = ("std", "hg", "hs", "a_b", "50%")
    text = table_of(
        *((made.condition("my_planner&", "r_1", scenario=s, model=m), 9) for s in scenarios for m in "ab")
    )
    assert text.count("{") - text.count(r"\{") == text.count("}") - text.count(r"\}")
    for name in ("table*", "tabular"):
        assert text.count(rf"\begin{{{name}}}") == text.count(rf"\end{{{name}}}")
    assert text.count(r"\begin{tabular}") == 2  # at most three scenarios across
    assert r"\caption{" in text
    assert r"\label{tab:run_1}" in text
    assert r"my\_planner\&" in text
    assert r"50\%" in text
    for tabular in re.findall(r"\\begin\{tabular\}\{(\w+)\}(.*?)\\end\{tabular\}", text, re.DOTALL):
        columns, inner = len(tabular[0]), tabular[1]
        for line in (line for line in inner.splitlines() if line.endswith(r"\\")):
            unescaped = line.replace(r"\&", "")
            spanned = sum(int(n) - 1 for n in re.findall(r"\\multicolumn\{(\d)\}", line))
            assert unescaped.count("&") + 1 + spanned == columns
    assert not re.search(r"\\(multirow|resizebox|usepackage)", text)


def test_a_model_is_named_where_there_are_several() -> None:
    text = table_of((made.condition(model="a"), 30), (made.condition(model="b"), 30))
    assert body(text)[1][:3] == ["Planner", "Model", "Risk"]
    assert [row[:3] for row in body(text)[2:]] == [["MPPI", "a", "cvar"], ["", "b", "cvar"]]
    assert r"\begin{table}[t]" in text


@pytest.mark.parametrize(("counts", "expected"), [((30,), False), ((30, 29), False), ((30, 29, 5), True)])
def test_bold_is_used_and_explained_where_something_is_worse(counts: tuple[int, ...], expected: bool) -> None:
    text = table_of(*((made.condition(risk=f"r{i}"), count) for i, count in enumerate(counts)))
    assert ("Bold:" in text) == expected
    assert (r"\textbf" in text) == expected
