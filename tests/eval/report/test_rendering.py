import pytest
from rich.cells import cell_len

from benchnav.eval.report.rendering import latex, to_latex, to_markdown, to_terminal
from benchnav.eval.report.tables import ResultTable

TABLE = ResultTable(
    headings=("planner", "λ̄ [%]", "failures"),
    labels=1,
    rows=(("my_planner¹", "5.0 ± 1.0", "2 stuck"), ("[bold] a|b & 50%", "–", "–")),
    notes=("¹ follows λ̂ & C:\\{x}",),
)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("astar_dwa", r"astar\_dwa"),
        ("50 % & #1 $x$", r"50 \% \& \#1 \$x\$"),
        ("a\\b{c}^~", r"a\textbackslash{}b\{c\}\textasciicircum{}\textasciitilde{}"),
        ("3 ± 1", r"3 $\pm$ 1"),
        ("9–91", "9--91"),
        ("λ̄ and λ̂ and λ", r"$\bar{\lambda}$ and $\hat{\lambda}$ and $\lambda$"),
        ("mppi¹,²", r"mppi\textsuperscript{1},\textsuperscript{2}"),
        ("T_total [s]", r"$T_\mathrm{total}$ {[}s]"),
    ],
)
def test_latex_escapes(text: str, expected: str) -> None:
    assert latex(text) == expected


def test_latex() -> None:
    assert to_latex(TABLE).splitlines() == [
        r"\begin{tabular}{lcl}",
        r"\toprule",
        r"planner & $\bar{\lambda}$ {[}\%] & failures \\",
        r"\midrule",
        r"my\_planner\textsuperscript{1} & 5.0 $\pm$ 1.0 & 2 stuck \\",
        r"{[}bold] a\textbar{}b \& 50\% & -- & -- \\",
        r"\bottomrule",
        r"\end{tabular}",
        r"\par{\footnotesize \textsuperscript{1} follows $\hat{\lambda}$ \& C:\textbackslash{}\{x\}}",
    ]


def test_markdown() -> None:
    assert to_markdown(TABLE).splitlines() == [
        "| planner | λ̄ [%] | failures |",
        "|---|---|---|",
        "| my_planner¹ | 5.0 ± 1.0 | 2 stuck |",
        r"| [bold] a\|b & 50% | – | – |",
        "",
        "¹ follows λ̂ & C:\\\\{x}",
    ]


def test_terminal_shows_brackets_and_notes_and_breaks_only_where_it_has_to() -> None:
    text = to_terminal(TABLE)
    assert "[bold] a|b & 50%" in text
    assert "[%]" in text
    assert text.splitlines()[-1] == TABLE.notes[0]
    narrow = to_terminal(TABLE, width=30)
    assert max(map(cell_len, narrow.splitlines())) <= 30
    assert "…" not in narrow
    wide = ResultTable(headings=("x" * 150,), labels=1, rows=(("y",),), notes=("n" * 300,))
    assert "n" * 300 in to_terminal(wide)
