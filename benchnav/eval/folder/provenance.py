"""Where rows come from: what `run.json` holds, and what has to be the same for a run to go on."""

import json
import os
import platform
import re
import shlex
import subprocess
import sys
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

import benchnav
from benchnav import registry
from benchnav.datagen.files.reader import TerrainDataset, find_dataset
from benchnav.eval.trial import PART_KINDS, Trial
from benchnav.eval.unit import Extent
from benchnav.models.predictor import model_identity
from benchnav.planning.planners.compilation import can_compile
from benchnav.sources import digest_of

PACKAGES = ("benchnav", "torch", "numpy", "scipy", "gpytorch", "segmentation-models-pytorch")

Trials = Mapping[str, tuple[Trial, Extent]]


def describe_code() -> dict[str, Any]:
    """What rows depend on beside their trial: sources, versions, arithmetic of the processor."""
    package = Path(benchnav.__file__).parent
    files = sorted(path for path in package.rglob("*") if path.suffix in (".py", ".yaml"))
    named = ((path.relative_to(package).as_posix().encode(), path.read_bytes()) for path in files)
    return {
        "sources": digest_of(item for pair in named for item in pair),
        "versions": {name: version(name) for name in PACKAGES} | {"python": platform.python_version()},
        "processor": torch.backends.cpu.get_cpu_capability(),
        "compiles": can_compile(),
    }


def describe_machine() -> dict[str, Any]:
    """The machine, for people."""
    return {"processor": _processor(), "cores": os.cpu_count(), "host": platform.node()}


def extend_history(earlier: Iterable[Mapping[str, Any]], suite: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """What was asked of a run: command, suite, date, machine, and git commit of this package, an entry each.

    The commit ends in `+` where files differ from it, and is empty where the package is in no repository. A command
    that is given again at the same place adds no entry.

    Args:
        earlier: entries that are there.
        suite: of this process's command, as it was written.
    """
    asked = {"command": describe_command(), "suite": dict(suite), **describe_machine(), "commit": _commit()}
    now = {"date": datetime.now(UTC).isoformat(timespec="seconds"), **json.loads(json.dumps(asked))}
    again = any({**entry, "date": now["date"]} == now for entry in earlier)
    return [*earlier, *([] if again else [now])]


def join(*lists: Iterable[Any]) -> list[Any]:
    """All entries of lists of plain data, each once, in order."""
    return list({json.dumps(item, sort_keys=True): item for one in lists for item in one}.values())


@cache
def _processor() -> str:
    """The processor's name, which Python itself does not know on Linux."""
    cpuinfo = Path("/proc/cpuinfo")
    text = cpuinfo.read_text(errors="replace") if cpuinfo.is_file() else ""
    named = re.search(r"^model name\s*: (.+)$", text, re.MULTILINE)
    return named[1].strip() if named else platform.processor() or platform.machine()


@cache
def _commit() -> str:
    package = Path(benchnav.__file__).parent

    def git(*words: str) -> str:
        command = ["git", "-C", str(package), *words]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()

    try:
        git("ls-files", "--error-unmatch", "__init__.py")  # else the repository is another project's
        return git("rev-parse", "HEAD") + ("+" if git("status", "--porcelain", "--", ".") else "")
    except (OSError, subprocess.SubprocessError):
        return ""


def describe_command() -> str:
    """The command of this process."""
    return shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])


def describe(trials: Trials) -> dict[str, Any]:
    """All that rows depend on beside the trials themselves."""
    return {
        "datasets": describe_maps(trials),
        "parts": describe_parts(trials),
        "code": describe_code(),
    }


def describe_maps(trials: Trials) -> dict[str, Any]:
    """The maps used: by dataset its id and, by split, a digest of each map."""
    used: dict[str, dict[str, int]] = {}
    for trial, extent in trials.values():
        splits = used.setdefault(trial.data, {})
        splits[trial.split] = max(extent.instances, splits.get(trial.split, 0))
    datasets = {data: TerrainDataset(find_dataset(data)) for data in used}
    return {
        data: {
            "id": datasets[data].id,
            "maps": {split: _map_digests(datasets[data], split, count) for split, count in splits.items()},
        }
        for data, splits in used.items()
    }


def describe_parts(trials: Trials) -> dict[str, Any]:
    """Models by the digests of their files, and parts that are not ours by origin and digest."""
    described: dict[str, Any] = {}
    for trial, _ in trials.values():
        described[f"model {trial.model.part}"] = model_identity(trial.model.part)
        for kind in PART_KINDS[1:]:
            source = getattr(trial, kind).part
            found = registry.find(kind, source)
            if not found.shipped:
                described[f"{kind} {source}"] = {"origin": found.origin, "digest": found.digest}
    return described


def differences(earlier: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Says what changed between two states of a run that bears on rows; what only one has is no change.

    Args:
        earlier: the `run.json` of the folder.
        now: what it would be.
    """
    changed = []
    if earlier["code"]["sources"] != now["code"]["sources"]:
        changed.append("benchnav's own sources")
    changed += [
        f"{name} ({before} to {now['code']['versions'].get(name)})"
        for name, before in earlier["code"]["versions"].items()
        if before != now["code"]["versions"].get(name)
    ]
    for name in ("processor", "compiles"):
        if earlier["code"][name] != now["code"][name]:
            changed.append(f"{name} ({earlier['code'][name]} to {now['code'][name]})")
    if earlier["planner_limit_s"] != now["planner_limit_s"]:
        changed.append(f"planner_limit_s ({earlier['planner_limit_s']:g} to {now['planner_limit_s']:g})")
    if _device(earlier) != _device(now):
        changed.append(f"device ({_device(earlier)} to {_device(now)})")
    changed += [
        name for name, identity in earlier["parts"].items() if now["parts"].get(name, identity) != identity
    ]
    for data, about in earlier["datasets"].items():
        again = now["datasets"].get(data, {"maps": {}})["maps"]
        for split, digests in about["maps"].items():
            pairs = zip(digests, again.get(split, digests), strict=False)
            if any(before != after for before, after in pairs):
                changed.append(f"maps of {data} {split}")
    return changed


def _device(about: Mapping[str, Any]) -> str:
    """What a run is computed on; the CPU where a run of earlier versions does not say."""
    return about.get("gpu") or about.get("device", "cpu")


def _map_digests(dataset: TerrainDataset, split: str, count: int) -> list[str]:
    digests = dataset.entry_digests(split, range(count))
    return [digest_of([entry.tobytes()])[:16] for entry in digests]


def command_lines(earlier: Iterable[str]) -> list[str]:
    """The commands that made a run, this process's last."""
    return [*(line for line in earlier if line != describe_command()), describe_command()]
