"""Ways of writing a table: Markdown, LaTeX, and text for a terminal."""

import io

from benchnav.eval.report.tables import ResultTable

# Wide enough for any table where there is no terminal to fit it into.
_WIDTH = 400

_LATEX = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{",
    "}": r"\}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": r"\textless{}",
    ">": r"\textgreater{}", "|": r"\textbar{}", "[": "{[}", "±": r"$\pm$", "–": "--", "λ": r"$\lambda$",
    "ω": r"$\omega$", "θ": r"$\theta$",
}  # fmt: skip
_LATEX |= {raised: rf"\textsuperscript{{{digit}}}" for digit, raised in enumerate("⁰¹²³⁴⁵⁶⁷⁸⁹")}
_LATEX_WORDS = {"λ̄": r"$\bar{\lambda}$", "λ̂": r"$\hat{\lambda}$", "T_total": r"$T_\mathrm{total}$"}


def to_markdown(table: ResultTable) -> str:
    """Writes a table in Markdown, with its notes under it."""
    lines = [_markdown_row(table.headings), "|" + "---|" * len(table.headings)]
    lines += [_markdown_row(row) for row in table.rows]
    return "\n".join([*lines, *(f"\n{_markdown(note)}" for note in table.notes), ""])


def to_latex(table: ResultTable) -> str:
    """Writes a table for LaTeX's `booktabs`, with its notes under it."""
    numbers = len(table.headings) - table.labels - 1
    lines = [r"\begin{tabular}{" + "l" * table.labels + "c" * numbers + "l}", r"\toprule"]
    lines += [_latex_row(table.headings), r"\midrule", *map(_latex_row, table.rows)]
    lines += [r"\bottomrule", r"\end{tabular}"]
    return "\n".join([*lines, *(rf"\par{{\footnotesize {latex(note)}}}" for note in table.notes), ""])


def to_terminal(table: ResultTable, width: int | None = None) -> str:
    """Draws a table with lines for a terminal, with its notes under it.

    Args:
        table: what to draw.
        width: columns of the terminal; not limited when not given.
    """
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    # Escaped, since square brackets are markup.
    drawn = Table()
    for heading in table.headings:
        drawn.add_column(escape(heading), overflow="fold")
    for row in table.rows:
        drawn.add_row(*map(escape, row))
    console = Console(file=io.StringIO(), width=width or _WIDTH, color_system=None)
    console.print(drawn, *map(escape, table.notes), sep="\n", highlight=False)
    return console.file.getvalue()  # type: ignore[attr-defined]


def latex(text: str) -> str:
    """Escapes text for LaTeX."""
    for word, written in _LATEX_WORDS.items():
        before, found, after = text.partition(word)
        if found:
            return latex(before) + written + latex(after)
    return "".join(_LATEX.get(character, character) for character in text)


def _latex_row(cells: tuple[str, ...]) -> str:
    return " & ".join(map(latex, cells)) + r" \\"


def _markdown_row(cells: tuple[str, ...]) -> str:
    return "| " + " | ".join(map(_markdown, cells)) + " |"


def _markdown(text: str) -> str:
    for character in "\\|*<`":
        text = text.replace(character, "\\" + character)
    return text
