"""The card of a checkpoint, README.md, for hubs and people: what it is, what it was
trained on, how to load it.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import yaml

from benchnav.core import registry
from benchnav.core.tables import Table, to_markdown

CARD = "README.md"


def card_of(
    name: str,
    model: str,
    parts: Mapping[str, Any],
    classes: Sequence[str],
    code: str,
    conformal_maps: int = 0,
    pool_temperature: float = 1.0,
) -> str:
    """Writes the card of a checkpoint.

    Args:
        name: of its folder.
        model: of what kind it is.
        parts: its parts by name, each a `models.checkpoint.Part`; one or more.
        classes: names of the terrain classes.
        code: digest of the code of a user's own class; empty where it is ours.
        conformal_maps: by how many maps it has been recalibrated; 0 where it has not.
        pool_temperature: of the average of its members.

    Returns:
        Markdown, with the front matter that model hubs read.
    """
    datasets = sorted({part.data_id for part in parts.values()})
    head = {
        "library_name": "benchnav",
        "tags": ["traversability", "robotics"],
        "datasets": datasets,
    }
    # an installed class is found by its name
    is_own = code and model not in registry.names("model")
    place = f"path/to/file.py:{model}@{name}" if is_own else name
    own = (
        f"The class `{model}` is a user's own and not in this folder: name the file "
        "that holds it. The "
        f"SHA-256 of its code was `{code}`. Loading runs that file.\n\n"
        if is_own
        else ""
    )
    classes = (
        f"Terrain classes of the maps: {', '.join(classes)}.\n\n" if classes else ""
    )
    promise = (
        f"It is recalibrated by {conformal_maps} maps (conformal): on a new map of "
        "the same kind λ of a random cell "
        "falls below the u-quantile with probability u at most. Nothing is promised "
        "on other ground.\n\n"
        if conformal_maps
        else ""
    )
    return (
        f"---\n{yaml.safe_dump(head, sort_keys=False)}---\n\n# {name}\n\n"
        f"A model of traversability of the kind `{model}`, trained on "
        f"{' and '.join(datasets)}. It predicts "
        "the distribution of traversability in every cell of a "
        f"map.{_members(parts, pool_temperature)} This folder "
        "holds tensors and settings, and no code.\n\n"
        f"```sh\nbenchnav-train evaluate {place} --data DATASET\n"
        f"benchnav-eval run --model {place} --data DATASET\n```\n\n"
        "```python\nfrom benchnav.models import load_model\n\nmodel = "
        f"load_model({place!r})\n```\n\n"
        f"{own}{classes}{promise}## Parts\n\n{_parts_table(parts)}\n\n## "
        f"Settings\n\n{_settings_table(parts)}\n\n"
        "Measures are of the validation maps, which early stopping and calibration "
        "have seen. `config.json` holds the "
        "digests of data and tensors, and the versions of the packages. No licence is "
        "given here: add one before you "
        "share it.\n"
    )


def _members(parts: Mapping[str, Any], temperature: float) -> str:
    """Of an ensemble, of how many networks it is made."""
    count = sum(name.partition("-")[2] != "" for name in parts) + 1
    if count == 1:
        return ""
    widened = (
        ""
        if temperature == 1
        else f", and widened by the temperature {temperature:.3g}"
    )
    return (
        f" It is an ensemble: what its {count} networks predict is averaged{widened}."
    )


def _parts_table(parts: Mapping[str, Any]) -> str:
    rows = []
    for name, part in parts.items():
        measured = ", ".join(
            f"{metric.removeprefix('valid_')} {value:.4g}"
            for metric, value in part.metrics.items()
            if metric.startswith(("valid_", "held_out"))
        )
        rows.append(
            (
                name,
                str(part.seed),
                part.data_id,
                measured or "–",
                part.versions.get("benchnav", "–"),
            )
        )
    headings = ("part", "seed", "trained on", "validation", "by benchnav")
    return to_markdown(Table(title="", headings=headings, rows=tuple(rows)))


def _settings_table(parts: Mapping[str, Any]) -> str:
    first = {name.partition("-")[0]: part for name, part in reversed([*parts.items()])}
    rows = []
    for stem, part in sorted(first.items()):
        for setting, value in part.config.items():
            shown = list(value) if isinstance(value, tuple) else value
            if setting != "steepest_deg":
                rows.append((stem, setting, str(shown)))
    return to_markdown(
        Table(title="", headings=("part", "setting", "value"), rows=tuple(rows))
    )
