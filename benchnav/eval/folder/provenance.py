"""Where rows come from: the code and the maps that made them, and what `run.json` says
of machine and commands.

A unit of work is known by a key: the digest of its condition, seed, realisation, maps
and code. Code is all of this package that a unit of the condition imports (see
`package_modules`), the parts' own code and files, versions of what is installed, and
the arithmetic of the processor.
"""

import json
import os
import platform
import re
import shlex
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

import benchnav
from benchnav.core import registry
from benchnav.core.device import gpu_name
from benchnav.core.registry import Part
from benchnav.core.shipped_files import PACKAGE
from benchnav.core.sources import digest_of, package_modules
from benchnav.core.store import text_digest
from benchnav.core.touched import Touches, touches_of, unlike
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.eval.experiment.condition import MEANING, Condition
from benchnav.eval.experiment.unit import Conditions, Unit
from benchnav.models.checkpoint import digests_of
from benchnav.models.predictor import ModelPart
from benchnav.planning.planners.compilation import can_compile

PACKAGES = ("torch", "numpy", "scipy", "gpytorch", "segmentation-models-pytorch")

# Runs a unit: what it imports is what rows depend on.
_UNIT = "benchnav.eval.run.unit"
_MOST_NAMED = 3

Code = dict[str, dict[str, Any]]
METRICS = "metrics"  # the group of code that rows with further metrics have
# beside the groups of code: what parts touched, which is known only when they have run
TOUCHED = "touched"


@dataclass(frozen=True, kw_only=True)
class Origin:
    """What makes the rows of a unit, beside its condition, seed and realisation.

    Args:
        code: `environment` (versions, processor, device, time limit of planners),
            `modules` of this package with their digests, `parts`, the digests of code
            and files that are not of it, and, if rows have further metrics, `metrics`,
            see `describe_metrics`.
        maps: digest of what the split's maps mean, and that of each map.
    """

    code: Code
    maps: tuple[str, ...]

    def key(self, unit: Unit) -> str:
        """The key of a unit that is made so, 16 hexadecimal digits."""
        return text_digest(
            [
                unit.condition.id,
                unit.seed,
                unit.realisation,
                unit.maps,
                self.maps,
                self.code,
            ]
        )[:16]


def code_digest(code: Code) -> str:
    """Digest of code, 12 hexadecimal digits."""
    return text_digest(code)[:12]


class Origins:
    """Looks origins of units up, as they are now; what was looked up once stays.

    Args:
        planner_limit_s: time limit of each call of a planner; 0 for none.
        device: where all is computed, "cpu" or "cuda".
    """

    def __init__(self, planner_limit_s: float, device: str) -> None:
        """Has looked nothing up yet."""
        self._environment = {
            **{name: version(name) for name in PACKAGES},
            "python": platform.python_version(),
            "processor": torch.backends.cpu.get_cpu_capability(),
            "compiles": can_compile(),
            "device": gpu_name(device) or device,
            "planner_limit_s": planner_limit_s,
        }
        self._codes: dict[str, Code] = {}
        # a digest of what they mean, and one of each
        self._maps: dict[tuple[Any, ...], tuple[str, ...]] = {}

    def of(self, unit: Unit) -> Origin:
        """The origin of a unit that is made now."""
        condition = unit.condition
        known_by = f"{condition.id} {unit.metrics}"
        if known_by not in self._codes:
            metrics = {METRICS: describe_metrics(unit.metrics)} if unit.metrics else {}
            self._codes[known_by] = {
                "environment": self._environment,
                **describe_parts(condition),
                **metrics,
            }
        place = condition.data, condition.split, unit.maps
        if place not in self._maps:
            dataset = condition.dataset
            digests = map_digests(dataset, condition.split, unit.maps)
            self._maps[place] = (dataset.about_digest(condition.split), *digests)
        return Origin(code=self._codes[known_by], maps=self._maps[place])


def describe_parts(condition: Condition) -> Code:
    """The `modules` of this package that a condition's units import, and the digests of
    its other `parts`.
    """
    modules, parts = [_UNIT], {}
    for kind, part in condition.parts.items():
        name, found = f"{kind} {part.part}", part.found
        folder = part.folder if isinstance(part, ModelPart) else None
        if folder is not None:
            parts[name] = text_digest(digests_of(folder))
        if found.shipped:
            modules.append(found.target.__module__)
        else:
            parts[f"class of {name}" if folder else name] = text_digest(
                [found.origin, found.digest]
            )
        files = registry.option_files(part)
        parts |= {f"{text} of {name}": digest for text, digest in files.items()}
    if statistics := condition.statistics:
        parts["statistics of the ground"] = text_digest(statistics.to_json())
    return {"modules": package_modules(modules), "parts": parts}


def describe_metrics(metrics: Iterable[Part]) -> dict[str, Any]:
    """Return part, options and digest of each metric's code and files, by its column."""
    described = {}
    for part in metrics:
        found = part.found
        known = (
            package_modules([found.target.__module__])
            if found.shipped
            else [found.origin, found.digest]
        )
        files = registry.option_files(part)
        described[part.object.column] = {
            "part": part.part,
            "options": dict(part.options),
            "digest": text_digest([known, files]),
        }
    return described


def lacks_metrics(code: Mapping[str, Any], wanted: Code) -> list[str]:
    """Return the columns of further metrics that rows of some code do not have.

    Args:
        code: that made the rows.
        wanted: of rows that have them.
    """
    return [
        column
        for column in wanted.get(METRICS, {})
        if column not in code.get(METRICS, {})
    ]


def touches(condition: Condition, metrics: Iterable[Part] = ()) -> Touches:
    """Return what the user's own parts of a unit have touched in this process; see
    `benchnav.core.touched`.
    """
    known = [part.found for part in (*metrics, *condition.parts.values())]
    return touches_of(found.target for found in known if not found.shipped)


def describe_datasets(conditions: Conditions) -> dict[str, Any]:
    """The maps used: by dataset its id and, by split, a digest of each map and one of
    what they mean.
    """
    described: dict[str, Any] = {}
    for condition, extent in conditions.values():
        dataset, split = condition.dataset, condition.split
        about = described.setdefault(
            condition.data, {"id": dataset.id, "maps": {}, "about": {}}
        )
        if extent.maps > len(about["maps"].get(split, ())):
            about["maps"][split] = map_digests(dataset, split, range(extent.maps))
            about["about"][split] = dataset.about_digest(split)
    return described


def map_digests(dataset: TerrainDataset, split: str, maps: Sequence[int]) -> list[str]:
    """Digests of some maps of a split, 16 hexadecimal digits each."""
    return [
        digest_of([entry.tobytes()])[:16]
        for entry in dataset.entry_digests(split, maps)
    ]


def code_differences(earlier: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Names what two codes both have and what is not the same, with the values where
    they are short.

    Args:
        earlier: as `Origin.code`, perhaps with what parts touched as `TOUCHED`.
        now: as well.
    """
    differing = {
        group: [
            name
            for name, value in earlier.get(group, {}).items()
            if now.get(group, {}).get(name, value) != value
        ]
        for group in ("modules", "environment", "parts", METRICS)
    }
    modules = differing["modules"]
    more = (
        f" and {len(modules) - _MOST_NAMED} more of its modules"
        if len(modules) > _MOST_NAMED
        else ""
    )
    return [
        *([f"{', '.join(modules[:_MOST_NAMED])}{more}"] if modules else []),
        *(
            f"{n} ({earlier['environment'][n]} to {now['environment'][n]})"
            for n in differing["environment"]
        ),
        *differing["parts"],
        *(f"metric {column}" for column in differing[METRICS]),
        *unlike(earlier.get(TOUCHED, {}), now.get(TOUCHED, {})),
    ]


def dataset_differences(
    earlier: Mapping[str, Any], now: Mapping[str, Any]
) -> list[str]:
    """Names what of the maps of two runs is not the same; what only one has is no
    difference.

    Args:
        earlier: from `describe_datasets`.
        now: as well.
    """
    changed = []
    for data, about in earlier.items():
        other = now.get(data, {"maps": {}, "about": {}})
        for split, digests in about["maps"].items():
            pairs = zip(digests, other["maps"].get(split, digests), strict=False)
            if any(before != after for before, after in pairs):
                changed.append(f"maps of {data} {split}")
            if (
                other["about"].get(split, about["about"][split])
                != about["about"][split]
            ):
                changed.append(f"{MEANING} of {data} {split}")
    return changed


def describe_machine() -> dict[str, Any]:
    """The machine, for people."""
    return {"processor": _processor(), "cores": os.cpu_count(), "host": platform.node()}


def extend_history(
    earlier: Iterable[Mapping[str, Any]], suite: Mapping[str, Any]
) -> list[Mapping[str, Any]]:
    """What was asked of a run: command, suite, date, machine, version and git commit of
    this package, an entry each.

    The commit ends in `+` where files differ from it, and is empty where the package is
    in no repository. A command that is given again at the same place adds no entry.

    Args:
        earlier: entries that are there.
        suite: of this process's command, as it was written.
    """
    asked = {
        "command": shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        "suite": dict(suite),
        **describe_machine(),
        "benchnav": benchnav.__version__,
        "commit": _commit(),
    }
    now = {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        **json.loads(json.dumps(asked)),
    }
    again = any({**entry, "date": now["date"]} == now for entry in earlier)
    return [*earlier, *([] if again else [now])]


def join(*lists: Iterable[Any]) -> list[Any]:
    """All entries of lists of plain data, each once, in order."""
    return list(
        {
            json.dumps(item, sort_keys=True): item
            for entries in lists
            for item in entries
        }.values()
    )


def command_lines(about: Mapping[str, Any]) -> list[str]:
    """The commands that made a run, of its `run.json`, each once."""
    return list(dict.fromkeys(entry["command"] for entry in about["history"]))


@cache
def _processor() -> str:
    """The processor's name, which Python itself does not know on Linux."""
    cpuinfo = Path("/proc/cpuinfo")
    text = cpuinfo.read_text(errors="replace") if cpuinfo.is_file() else ""
    named = re.search(r"^model name\s*: (.+)$", text, re.MULTILINE)
    return named[1].strip() if named else platform.processor() or platform.machine()


@cache
def _commit() -> str:
    def git(*words: str) -> str:
        command = ["git", "-C", str(PACKAGE), *words]
        return subprocess.run(
            command, capture_output=True, text=True, check=True, timeout=10
        ).stdout.strip()

    try:
        # else the repository is another project's
        git("ls-files", "--error-unmatch", "__init__.py")
        return git("rev-parse", "HEAD") + (
            "+" if git("status", "--porcelain", "--", ".") else ""
        )
    except (OSError, subprocess.SubprocessError):
        return ""
