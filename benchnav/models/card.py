"""Card of a checkpoint (README.md), for hubs and readers: model, data and use."""

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
    """Return the card of a checkpoint.

    Args:
        name: name of the checkpoint's folder.
        model: name of the model's class, as in `Checkpoint.model`.
        parts: parts of the model by name, each a `models.checkpoint.Part`; at least one.
        classes: names of the terrain classes.
        code: digest of the code of a custom class; empty for models of this package.
        conformal_maps: number of maps used for conformal recalibration; 0 if the model is
            not recalibrated.
        pool_temperature: temperature of the average of an ensemble's members.

    Returns:
        Markdown, with the front matter that model hubs read.
    """
    datasets = sorted({part.data_id for part in parts.values()})
    head = {
        "library_name": "benchnav",
        "tags": ["traversability", "robotics"],
        "datasets": datasets,
    }
    # A registered class is loaded by name; any other needs the path of its file.
    is_custom = code and model not in registry.names("model")
    model_path = f"path/to/file.py:{model}@{name}" if is_custom else name
    custom_note = (
        f"The class `{model}` is custom code, which is not in this folder: give the "
        "path of its file. The "
        f"SHA-256 of its code was `{code}`. Loading runs that file.\n\n"
        if is_custom
        else ""
    )
    classes = (
        f"Terrain classes of the maps: {', '.join(classes)}.\n\n" if classes else ""
    )
    guarantee = (
        f"The model is recalibrated on {conformal_maps} maps (conformal prediction): on "
        "a new map of the same kind, λ of a random cell is below the predicted "
        "u-quantile with probability at most u. There is no guarantee for other "
        "terrain.\n\n"
        if conformal_maps
        else ""
    )
    return (
        f"---\n{yaml.safe_dump(head, sort_keys=False)}---\n\n# {name}\n\n"
        f"A traversability model of the class `{model}`, trained on "
        f"{' and '.join(datasets)}. It predicts "
        "the distribution of traversability in every cell of a "
        f"map.{_ensemble_sentence(parts, pool_temperature)} This folder "
        "contains tensors and settings, and no code.\n\n"
        f"```sh\nbenchnav-train evaluate {model_path} --data DATASET\n"
        f"benchnav-eval run --model {model_path} --data DATASET\n```\n\n"
        "```python\nfrom benchnav.models import load_model\n\nmodel = "
        f"load_model({model_path!r})\n```\n\n"
        f"{custom_note}{classes}{guarantee}## Parts\n\n{_parts_table(parts)}\n\n## "
        f"Settings\n\n{_settings_table(parts)}\n\n"
        "The metrics are those of the validation maps, which early stopping and "
        "calibration have used. `config.json` contains the "
        "digests of data and tensors, and the versions of the packages. This card "
        "contains no licence: add one before you share the checkpoint.\n"
    )


def _ensemble_sentence(parts: Mapping[str, Any], temperature: float) -> str:
    """Return a sentence on the members of an ensemble; empty for a single network."""
    n_members = sum(name.partition("-")[2] != "" for name in parts) + 1
    if n_members == 1:
        return ""
    calibrated = (
        ""
        if temperature == 1
        else f" and calibrated by the temperature {temperature:.3g}"
    )
    return (
        f" It is an ensemble: the predictions of its {n_members} networks are "
        f"averaged{calibrated}."
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
