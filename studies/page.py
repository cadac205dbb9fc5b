"""Tables and figures of a study's page.

A table is between the lines `<!-- KIND RUN -->` and `<!-- end -->`, which may be
indented (for example in a fold). `RUN` is the name of a run of the study. A table or
figure whose run is missing is not changed.
"""

import re
import shutil
from pathlib import Path
from textwrap import indent

import pandas as pd

from benchnav.core.errors import expect
from benchnav.core.store import replacing, write_text
from benchnav.core.tables import to_markdown
from benchnav.viz.style import save
from studies import rows
from studies.power import power
from studies.runs import developed, digest_of
from studies.study import ROOT, Study, Work
from studies.tables import KINDS

BLOCK = re.compile(
    r"^( *)<!-- ([\w-]+) ([\w/.-]+) -->\n.*?<!-- end -->", re.DOTALL | re.MULTILINE
)
FIGURES = ROOT / "docs" / "figures"


def report(study: Study, work: Work) -> None:
    """Write the tables and figures of the page; print the power if it can be computed."""
    if (fixed := study.folder / "primary.yaml").exists():
        print(f"primary.yaml {digest_of(fixed)}")
    page = ROOT / study.page
    write_text(page, with_tables(page.read_text(), study, work))
    draw_figures(study, work)
    if (developed(study, work) / rows.EPISODES).exists():
        print(power(study, work))


def with_tables(text: str, study: Study, work: Work) -> str:
    """Return the text of a page with updated tables of this study's runs."""
    parts = {study.run_of(part): part for part in study.parts}

    def written(block: re.Match[str]) -> str:
        margin, kind, run = block.groups()
        if run not in parts:
            return block.group()
        table = _table(study, parts[run], kind, rows.folder_of(study, run, work))
        if table is None:
            print(f"not changed: {kind} {run}")
            return block.group()
        # In a fold, a table needs empty lines around it.
        body = f"\n{table.rstrip()}\n" if margin else table.rstrip()
        return indent(f"<!-- {kind} {run} -->\n{body}\n<!-- end -->", margin)

    return BLOCK.sub(written, text)


def _table(study: Study, part: str, kind: str, folder: Path) -> str | None:
    """Return a table of a part as Markdown; None if its input is missing.

    Raises:
        ConfigError: If `kind` is not a kind of table.
    """
    if study.parts[part].script:
        stored = folder / f"{kind}.md"
        return stored.read_text() if stored.exists() else None
    kinds = KINDS | {
        name: (study.function(spec), rows.SUMMARY)
        for name, spec in study.tables.items()
    }
    expect(kind in kinds, f"a table among {', '.join(kinds)}, got {kind}.")
    table, needed = kinds[kind]
    return to_markdown(table(folder)) if (folder / needed).exists() else None


def draw_figures(study: Study, work: Work) -> None:
    """Draw the figures of the page, or copy them from the runs."""
    for name, drawing in study.figures.items():
        path = FIGURES / name
        folders = [
            rows.folder_of(study, study.run_of(part), work) for part in drawing.parts
        ]
        needed = (
            [work.out / drawing.copy]
            if drawing.copy
            else [folder / rows.SUMMARY for folder in folders]
        )
        if not all(file.exists() for file in needed):
            print(f"not changed: {name}")
        elif drawing.copy:
            shutil.copyfile(needed[0], path)
        else:
            figure = study.function(drawing.draw)(pd.concat(map(pd.read_csv, needed)))
            with replacing(path) as partial:
                save(figure, partial, "png", dpi=200)
