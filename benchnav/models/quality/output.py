"""The folders that measures of models are written to: checks before any work is done, and the files in them."""

import json
import tempfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from benchnav.core.tables import Table
    from benchnav.datagen.files.reader import TerrainDataset
    from benchnav.viz.figure import Figure

FIGURES = "figures"
DPI = 300


def check_folder(out: Path, overwrite: bool, files: Collection[str], what: str) -> None:
    """Reject a folder that cannot be written to, or that holds something else.

    Args:
        out: the folder.
        overwrite: whether what is there may be replaced.
        files: names of what such a folder holds, in addition to `FIGURES`.
        what: what that is, such as "an evaluation".
    """
    from benchnav.core.store import refuse_taken

    refuse_taken(out, overwrite, partial(_foreign, files={*files, FIGURES}, what=what))
    check_writable(out / next(iter(files)))


def open_maps(data: str, splits: Sequence[str] | None) -> "TerrainDataset":
    """Open the dataset that models are measured on.

    Args:
        data: its path or id.
        splits: which of its splits; None for every test split.

    Raises:
        ConfigError: If `splits` is empty.
    """
    from benchnav.core.errors import expect
    from benchnav.datagen.files.find import find_dataset
    from benchnav.datagen.files.reader import TerrainDataset

    dataset = TerrainDataset(find_dataset(data))
    expect(splits != [], f"`splits` among {', '.join(dataset.splits)}, got none.")
    return dataset


def check_writable(path: Path) -> None:
    """Reject a file that cannot be written, by an OSError that names it."""
    nearest = next(parent for parent in path.absolute().parents if parent.exists())
    try:
        with tempfile.TemporaryFile(dir=nearest):
            pass
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error


def _foreign(folder: Path, files: set[str], what: str) -> str:
    """Return why what is at a path is none of these; empty if it is one. For `refuse_taken`."""
    own = folder.is_dir() and {item.name for item in folder.iterdir()} <= files
    return "" if own else f"is something else than {what}"


def json_text(about: Mapping[str, Any], splits: Mapping[str, Any]) -> str:
    """Write what was measured as JSON, with the series of its splits; NaN is null.

    Args:
        about: what is said of models and data.
        splits: what was measured of each.
    """
    from benchnav.datagen.recipe.scenario import find_series

    all_series = {
        scenario: [{"severity": severity, "split": split} for severity, split in pairs]
        for scenario, pairs in find_series(splits).items()
    }
    text = json.dumps({**about, "splits": splits, "series": all_series}, default=int)
    return json.dumps(json.loads(text, parse_constant=lambda _: None), indent=1) + "\n"


def page(
    title: str, tables: "Sequence[Table]", notes: Sequence[str], figures: Sequence[tuple[str, str, str]]
) -> str:
    """Write tables as a Markdown page with notes and figures.

    Args:
        title: of the page.
        tables: the first stands under the title, before the notes; the others have headings of their own.
        notes: lines.
        figures: path of each image from the page, its title, and what it shows.
    """
    from benchnav.core.tables import to_markdown

    first, *others = tables
    parts = [f"# {title}", to_markdown(first).rstrip(), *notes]
    for table in others:
        parts += [f"## {table.title}", to_markdown(table).rstrip()]
    for path, heading, text in figures:
        parts += [f"![{heading}]({path})", f"**{heading}.** {text}"]
    return "\n\n".join(parts) + "\n"


def save_figures(folder: Path, figures: "Sequence[Figure]", data: Any) -> list[tuple[str, str, str]]:
    """Draw figures into a folder, as PNG and PDF, in place of those that are there.

    Args:
        folder: that holds `FIGURES`.
        figures: each with a name of its own.
        data: what they are drawn from.

    Returns:
        Of each the path of its PNG from the folder, its title and its caption.
    """
    from benchnav.core.progress import show_progress
    from benchnav.viz.style import save_twice

    for old in (folder / FIGURES).glob("*.p[nd][gf]"):
        old.unlink()

    def saved() -> Iterator[tuple[int, int]]:
        for count, figure in enumerate(figures, 1):
            save_twice(figure(data), folder / FIGURES / f"{figure.name}.png", dpi=DPI)
            yield count, len(figures)

    show_progress(saved(), "figures")
    return [(f"{FIGURES}/{figure.name}.png", figure.title, figure.caption(data)) for figure in figures]
