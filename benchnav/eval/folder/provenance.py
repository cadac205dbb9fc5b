"""Provenance of result rows: code, maps, machine and commands.

A unit of work is identified by a key: the digest of its condition, seed, realisation,
maps and code. The code comprises all modules of benchnav that the unit imports (see
`digests_of_package_modules`), the code of its custom parts, the files of all its parts
(such as planner and model), versions of installed packages, and the vector instructions
of the processor.
"""

import itertools
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
from benchnav.core.sources import digest_of, digests_of_package_modules
from benchnav.core.store import text_digest
from benchnav.core.touched import Touches, differing_entries, touches_of
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.eval.experiment.condition import SPLIT_PROPERTIES, Condition
from benchnav.eval.experiment.unit import Conditions, Unit
from benchnav.models.checkpoint import digests_of
from benchnav.models.predictor import ModelPart
from benchnav.planning.planners.compilation import can_compile

PACKAGES = ("torch", "numpy", "scipy", "gpytorch", "segmentation-models-pytorch")

# The module that runs a unit; rows depend on its imports.
_UNIT = "benchnav.eval.run.unit"
_MAX_LISTED_MODULES = 3  # maximum number of modules that a message lists

Code = dict[str, dict[str, Any]]
METRICS = "metrics"  # key in `Code` of metrics in addition to the built-in ones
# Additional key in `Code`: files, packages and environment variables that custom parts
# read. They are known only after a run.
TOUCHED = "touched"


@dataclass(frozen=True, kw_only=True)
class Origin:
    """Inputs of a unit's rows in addition to its condition, seed and realisation.

    Args:
        code: values by group: `environment` (versions, processor, device, time limit of
            planners); `modules` (digests of benchnav's modules); `parts` (digests of
            other code and files); and, if rows have additional metrics, `metrics` from
            `describe_metrics`.
        maps: digest of the split's properties, followed by digests of the maps.
    """

    code: Code
    maps: tuple[str, ...]

    def key(self, unit: Unit) -> str:
        """Return the key of a unit with this origin, 16 hexadecimal digits."""
        identity = [unit.condition.id, unit.seed, unit.realisation, unit.maps]
        return text_digest([*identity, self.maps, self.code])[:16]


def code_digest(code: Code) -> str:
    """Return the digest of code, 12 hexadecimal digits."""
    return text_digest(code)[:12]


class Origins:
    """Current origins of units, cached.

    Args:
        planner_limit_s: time limit of each call of a planner in seconds; 0 for no
            limit.
        device: device of all computation, "cpu" or "cuda".
    """

    def __init__(self, planner_limit_s: float, device: str) -> None:
        """Start with an empty cache."""
        environment: dict[str, Any] = {name: version(name) for name in PACKAGES}
        environment["python"] = platform.python_version()
        environment["processor"] = torch.backends.cpu.get_cpu_capability()
        environment["compiles"] = can_compile()
        environment["device"] = gpu_name(device) or device
        environment["planner_limit_s"] = planner_limit_s
        self._environment = environment
        self._codes: dict[str, Code] = {}
        self._maps: dict[tuple[Any, ...], tuple[str, ...]] = {}  # as in `Origin.maps`

    def of(self, unit: Unit) -> Origin:
        """Return the current origin of a unit."""
        condition = unit.condition
        code_key = f"{condition.id} {unit.metrics}"
        if code_key not in self._codes:
            code: Code = {"environment": self._environment}
            code |= describe_parts(condition)
            if unit.metrics:
                code[METRICS] = describe_metrics(unit.metrics)
            self._codes[code_key] = code
        maps_key = condition.data, condition.split, unit.maps
        if maps_key not in self._maps:
            dataset = condition.dataset
            properties = dataset.about_digest(condition.split)
            digests = map_digests(dataset, condition.split, unit.maps)
            self._maps[maps_key] = (properties, *digests)
        return Origin(code=self._codes[code_key], maps=self._maps[maps_key])


def describe_parts(condition: Condition) -> Code:
    """Return two groups of a condition's code: `modules` of benchnav, and `parts`."""
    modules = [_UNIT]
    parts: dict[str, Any] = {}
    for kind, part in condition.parts.items():
        name = f"{kind} {part.part}"
        source = part.found
        folder = part.folder if isinstance(part, ModelPart) else None
        if folder is not None:
            parts[name] = text_digest(digests_of(folder))
        if source.shipped:
            modules.append(source.target.__module__)
        else:
            class_name = f"class of {name}" if folder else name
            parts[class_name] = text_digest([source.origin, source.digest])
        for text, digest in registry.option_files(part).items():
            parts[f"{text} of {name}"] = digest
    statistics = condition.statistics
    if statistics:
        parts["statistics of the ground"] = text_digest(statistics.to_json())
    return {"modules": digests_of_package_modules(modules), "parts": parts}


def describe_metrics(metrics: Iterable[Part]) -> dict[str, Any]:
    """Return a description of each metric, by column: part, options and digest.

    The digest is that of the metric's code and files.
    """
    described = {}
    for part in metrics:
        source = part.found
        code: Any = [source.origin, source.digest]
        if source.shipped:
            code = digests_of_package_modules([source.target.__module__])
        files = registry.option_files(part)
        described[part.object.column] = {
            "part": part.part,
            "options": dict(part.options),
            "digest": text_digest([code, files]),
        }
    return described


def missing_metrics(code: Mapping[str, Any], expected: Code) -> list[str]:
    """Return the columns of additional metrics that rows do not have.

    Args:
        code: code of the rows.
        expected: code of rows that have the metrics.
    """
    columns = code.get(METRICS, {})
    return [column for column in expected.get(METRICS, {}) if column not in columns]


def inputs_read_by_parts(condition: Condition, metrics: Iterable[Part] = ()) -> Touches:
    """Return the files, packages and variables that custom parts read in this process.

    See `benchnav.core.touched`.
    """
    sources = [part.found for part in (*metrics, *condition.parts.values())]
    return touches_of(source.target for source in sources if not source.shipped)


def describe_datasets(conditions: Conditions) -> dict[str, Any]:
    """Return each dataset's id, and digests by split: of its maps and its properties.

    The digest of the properties has the key `about`, as in the dataset's reader.
    """
    described: dict[str, Any] = {}
    for condition, extent in conditions.values():
        dataset = condition.dataset
        split = condition.split
        empty = {"id": dataset.id, "maps": {}, "about": {}}
        entry = described.setdefault(condition.data, empty)
        if extent.maps > len(entry["maps"].get(split, ())):
            entry["maps"][split] = map_digests(dataset, split, range(extent.maps))
            entry["about"][split] = dataset.about_digest(split)
    return described


def map_digests(dataset: TerrainDataset, split: str, maps: Sequence[int]) -> list[str]:
    """Return digests of some maps of a split, 16 hexadecimal digits each."""
    entries = dataset.entry_digests(split, maps)
    return [digest_of([entry.tobytes()])[:16] for entry in entries]


def code_differences(earlier: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Describe the entries that are in both codes but have different values.

    Args:
        earlier: code as in `Origin.code`; it may also contain `TOUCHED`.
        now: the code that is compared with `earlier`, in the same form.
    """
    lines = []
    modules = _differing(earlier, now, "modules")
    if modules:
        more = ""
        if len(modules) > _MAX_LISTED_MODULES:
            more = f" and {len(modules) - _MAX_LISTED_MODULES} more modules of benchnav"
        lines.append(f"{', '.join(modules[:_MAX_LISTED_MODULES])}{more}")
    for name in _differing(earlier, now, "environment"):
        before = earlier["environment"][name]
        lines.append(f"{name} ({before} to {now['environment'][name]})")
    lines += _differing(earlier, now, "parts")
    lines += [f"metric {column}" for column in _differing(earlier, now, METRICS)]
    lines += differing_entries(earlier.get(TOUCHED, {}), now.get(TOUCHED, {}))
    return lines


def _differing(
    earlier: Mapping[str, Any], now: Mapping[str, Any], group: str
) -> list[str]:
    """Return names of a group's entries that are in both codes but differ in value."""
    values = now.get(group, {})
    return [
        name
        for name, value in earlier.get(group, {}).items()
        if values.get(name, value) != value
    ]


def dataset_differences(
    earlier: Mapping[str, Any], now: Mapping[str, Any]
) -> list[str]:
    """Describe the maps that both runs use but whose contents or properties differ.

    Args:
        earlier: datasets of the earlier run, from `describe_datasets`.
        now: datasets of the run that is compared with `earlier`.
    """
    changed = []
    for data, entry in earlier.items():
        now_entry = now.get(data, {"maps": {}, "about": {}})
        for split, digests in entry["maps"].items():
            now_digests = now_entry["maps"].get(split, digests)
            n_common = min(len(digests), len(now_digests))
            if list(digests[:n_common]) != list(now_digests[:n_common]):
                changed.append(f"maps of {data} {split}")
            properties = entry["about"][split]
            if now_entry["about"].get(split, properties) != properties:
                changed.append(f"{SPLIT_PROPERTIES} of {data} {split}")
    return changed


def describe_machine() -> dict[str, Any]:
    """Return the names of processor and host, and the number of cores."""
    return {"processor": _processor(), "cores": os.cpu_count(), "host": platform.node()}


def extend_history(
    earlier: Iterable[Mapping[str, Any]], suite: Mapping[str, Any]
) -> list[Mapping[str, Any]]:
    """Append an entry for this command to a history, unless it already has the entry.

    An entry contains the command, the suite, the date, the machine, and the version and
    git commit of benchnav. Entries that differ only in their date are the same. The
    commit ends in `+` if files differ from it; it is empty if benchnav is not in a git
    repository of its own.

    Args:
        earlier: existing entries.
        suite: suite of this command, as the user wrote it.
    """
    program, *arguments = sys.argv
    request = {
        "command": shlex.join([Path(program).name, *arguments]),
        "suite": dict(suite),
        **describe_machine(),
        "benchnav": benchnav.__version__,
        "commit": _commit(),
    }
    date = datetime.now(UTC).isoformat(timespec="seconds")
    now = {"date": date, **json.loads(json.dumps(request))}
    history = list(earlier)
    is_repeated = any({**entry, "date": date} == now for entry in history)
    if not is_repeated:
        history.append(now)
    return history


def join(*lists: Iterable[Any]) -> list[Any]:
    """Concatenate lists of plain data, without repetitions."""
    unique = {}
    for item in itertools.chain.from_iterable(lists):
        unique[json.dumps(item, sort_keys=True)] = item
    return list(unique.values())


def command_lines(manifest: Mapping[str, Any]) -> list[str]:
    """Return the commands in the history of a `run.json`, without repetitions."""
    return list(dict.fromkeys(entry["command"] for entry in manifest["history"]))


@cache
def _processor() -> str:
    """Return the processor's name, which Python does not provide on Linux."""
    cpuinfo = Path("/proc/cpuinfo")
    text = cpuinfo.read_text(errors="replace") if cpuinfo.is_file() else ""
    named = re.search(r"^model name\s*: (.+)$", text, re.MULTILINE)
    if named:
        return named[1].strip()
    return platform.processor() or platform.machine()


@cache
def _commit() -> str:
    def git(*words: str) -> str:
        command = ["git", "-C", str(PACKAGE), *words]
        completed = subprocess.run(
            command, capture_output=True, text=True, check=True, timeout=10
        )
        return completed.stdout.strip()

    try:
        # This command fails if the repository belongs to another project.
        git("ls-files", "--error-unmatch", "__init__.py")
        changed = git("status", "--porcelain", "--", ".")
        mark = "+" if changed else ""
        return git("rev-parse", "HEAD") + mark
    except (OSError, subprocess.SubprocessError):
        return ""
