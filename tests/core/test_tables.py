from dataclasses import replace

import pytest
from rich.cells import cell_len

from benchnav.core.tables import Bold, Table, latex, to_latex, to_markdown, to_terminal

TABLE = Table(
    headings=("planner", "λ̄ [%]", "failures"),
    n_labels=1,
    rows=(("my_planner¹", "5.0 ± 1.0", "2 stuck"), ("[bold] a|b & 50%", "–", "–")),
    notes=("¹ follows λ̂ & C:\\{x}",),
)
BOLD = replace(
    TABLE,
    rows=(TABLE.rows[0], ("[bold] a|b & 50%", Bold("–"), "–")),
    bold_note="the best | all",
    explained=(("failures", "how <it> ended."),),
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
        ("Δ -2.7 to +1.0, N-1, cvar-0.5", r"$\Delta$ $-$2.7 to +1.0, N-1, cvar-0.5"),
        ("p ≥ 0.05 ¶", r"p $\geq$ 0.05 \P{}"),
    ],
)
def test_latex_escapes(text: str, expected: str) -> None:
    assert latex(text) == expected


def test_latex() -> None:
    assert to_latex([TABLE], "Over λ̄ & more", "mine").splitlines() == [
        r"\begin{table*}[t]",
        r"  \centering",
        r"  \caption{Over $\bar{\lambda}$ \& more}",
        r"  \label{tab:mine}",
        r"  \scriptsize",
        r"  \setlength{\tabcolsep}{3pt}",
        r"  \begin{tabular}{lcc}",
        r"    \toprule",
        r"    planner & $\bar{\lambda}$ {[}\%] & failures \\",
        r"    \midrule",
        r"    my\_planner\textsuperscript{1} & 5.0 $\pm$ 1.0 & 2 stuck \\",
        r"    {[}bold] a\textbar{}b \& 50\% & -- & -- \\",
        r"    \bottomrule",
        r"  \end{tabular}",
        r"  \par\smallskip\raggedright \textsuperscript{1} follows $\hat{\lambda}$ \& C:\textbackslash{}\{x\}",
        r"\end{table*}",
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
    wide = Table(headings=("x" * 150,), n_labels=1, rows=(("y",),), notes=("n" * 300,))
    assert "n" * 300 in to_terminal(wide)


def test_bold_cells_and_what_bold_means() -> None:
    lines = to_markdown(BOLD).splitlines()
    assert lines[3] == r"| [bold] a\|b & 50% | **–** | – |"
    assert lines[-3:] == [
        r"Bold: the best \| all",
        "",
        r"- **failures**: how \<it> ended.",
    ]
    assert r"{[}bold] a\textbar{}b \& 50\% & \textbf{--} & -- \\" in to_latex(
        [BOLD], "", ""
    )
    plain = to_terminal(BOLD)
    assert "–*" in plain
    assert plain.count("*") == 2
    assert "*: the best | all" in plain
    styled = to_terminal(BOLD, styled=True)
    assert "\x1b[1m–\x1b[0m" in styled
    assert "Bold: the best | all" in styled
    assert "\x1b" not in plain


def test_lowered_digits_are_one_index_in_latex() -> None:
    assert latex("CVaR₀.₉₅, VaR₀") == r"CVaR$_{0.95}$, VaR$_{0}$"
