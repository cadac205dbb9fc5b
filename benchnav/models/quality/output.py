"""The files that measures of models are written to: texts, figures, and a page that
shows and explains them.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchnav.core.progress import show_progress
from benchnav.core.store import write_text
from benchnav.core.tables import Table, to_markdown
from benchnav.datagen.recipe.scenario import find_series
from benchnav.models.quality.files import FIGURES
from benchnav.viz.figure import Figure
from benchnav.viz.style import save_twice

DPI = 300


@dataclass(frozen=True, kw_only=True)
class Page:
    """A page of tables, notes and figures.

    Args:
        title: of the page.
        tables: the first stands under the title, before the notes; the others have
            headings of their own.
        notes: lines.
    """

    title: str
    tables: Sequence[Table]
    notes: Sequence[str] = ()

    def to_markdown(self, figures: Sequence[tuple[str, str, str]] = ()) -> str:
        """Write the page in Markdown.

        Args:
            figures: path of each image from the page, its title, and what it shows.
        """
        first, *others = (to_markdown(table).rstrip() for table in self.tables)
        parts = [f"# {self.title}", first, *self.notes]
        for table, text in zip(self.tables[1:], others, strict=True):
            parts += [f"## {table.title}", text]
        for path, heading, text in figures:
            parts += [f"![{heading}]({path})", f"**{heading}.** {text}"]
        return "\n\n".join(parts) + "\n"


def write_folder(
    folder: Path,
    texts: Mapping[str, str],
    name: str,
    page: Page,
    figures: Sequence[Figure],
    data: Any,
) -> None:
    """Write all files of a measurement, in place of figures that are there, and say
    where they are.

    Args:
        folder: where to.
        texts: by the name of the file.
        name: of the file of the page.
        page: what is shown.
        figures: each with a name of its own.
        data: what they are drawn from.
    """
    for file, text in texts.items():
        write_text(folder / file, text)
    for old in (folder / FIGURES).glob("*.p[nd][gf]"):
        old.unlink()

    def saved() -> Iterator[tuple[int, int]]:
        for count, figure in enumerate(figures, 1):
            save_twice(figure(data), folder / FIGURES / f"{figure.name}.png", dpi=DPI)
            yield count, len(figures)

    show_progress(saved(), "figures")
    shown = [
        (f"{FIGURES}/{figure.name}.png", figure.title, figure.caption(data))
        for figure in figures
    ]
    write_text(folder / name, page.to_markdown(shown))
    print(f"wrote {', '.join(texts)}, {name} and {len(figures)} figures in {folder}")
    print(f"columns and figures are explained in {folder / name}")


def json_text(about: Mapping[str, Any], splits: Mapping[str, Any]) -> str:
    """Write what was measured as JSON, with the series of its splits; NaN is null.

    Args:
        about: what is said of models and data.
        splits: what was measured of each.
    """
    all_series = {
        scenario: [{"severity": severity, "split": split} for severity, split in pairs]
        for scenario, pairs in find_series(splits).items()
    }
    text = json.dumps({**about, "splits": splits, "series": all_series}, default=int)
    return json.dumps(json.loads(text, parse_constant=lambda _: None), indent=1) + "\n"
