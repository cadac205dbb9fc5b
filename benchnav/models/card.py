"""The card of a checkpoint, README.md, for hubs and people: what it is, what it was trained on, how to load it."""

from typing import TYPE_CHECKING, Any

import yaml

from benchnav.core.tables import Table, to_markdown

if TYPE_CHECKING:
    from benchnav.models.checkpoint import Checkpoint, Part

CARD = "README.md"


def card_of(checkpoint: "Checkpoint", name: str) -> str:
    """Writes the card of a checkpoint.

    Args:
        checkpoint: with one part or more.
        name: of its folder.

    Returns:
        Markdown, with the front matter that model hubs read.
    """
    parts = checkpoint.parts
    datasets = sorted({part.data_id for part in parts.values()})
    head = {"library_name": "benchnav", "tags": ["traversability", "robotics"], "datasets": datasets}
    place = f"path/to/file.py:{checkpoint.model}@{name}" if checkpoint.code else name
    own = (
        f"The class `{checkpoint.model}` is a user's own and not in this folder: name the file that holds it. The "
        f"SHA-256 of its code was `{checkpoint.code}`.\n\n"
        if checkpoint.code
        else ""
    )
    classes = (
        f"Terrain classes of the maps: {', '.join(checkpoint.class_names)}.\n\n"
        if checkpoint.class_names
        else ""
    )
    return (
        f"---\n{yaml.safe_dump(head, sort_keys=False)}---\n\n# {name}\n\n"
        f"A model of traversability of the kind `{checkpoint.model}`, trained on {' and '.join(datasets)}. It predicts "
        "the distribution of traversability in every cell of a map. Reading it runs no code.\n\n"
        f"```sh\nbenchnav-train evaluate {place} --data DATASET\n"
        f"benchnav-eval run --model {place} --data DATASET\n```\n\n"
        f"```python\nfrom benchnav.models import load_model\n\nmodel = load_model({place!r})\n```\n\n"
        f"{own}{classes}## Parts\n\n{_parts_table(parts)}\n\n## Settings\n\n{_settings_table(parts)}\n\n"
        "Measures are of the validation maps, which early stopping and calibration have seen. `config.json` holds the "
        "digests of data and tensors, and the versions of the packages. No licence is given here: add one before you "
        "share it.\n"
    )


def _parts_table(parts: Any) -> str:
    rows = []
    for name, part in parts.items():
        measured = ", ".join(
            f"{metric.removeprefix('valid_')} {value:.4g}"
            for metric, value in part.metrics.items()
            if metric.startswith(("valid_", "held_out"))
        )
        rows.append((name, str(part.seed), part.data_id, measured or "–", part.versions.get("benchnav", "–")))
    headings = ("part", "seed", "trained on", "validation", "by benchnav")
    return to_markdown(Table(title="", headings=headings, rows=tuple(rows)))


def _settings_table(parts: Any) -> str:
    first: dict[str, Part] = {name.partition("-")[0]: part for name, part in reversed(parts.items())}
    rows = [
        (stem, setting, str(value)) for stem, part in sorted(first.items()) for setting, value in part.config.items()
        if setting not in ("steepest_deg",)
    ]  # fmt: skip
    return to_markdown(Table(title="", headings=("part", "setting", "value"), rows=tuple(rows)))
