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
from benchnav.core import registry
from benchnav.core.sources import digest_of
from benchnav.datagen.files.reader import TerrainDataset, find_dataset
from benchnav.eval.experiment.condition import PART_KINDS, Condition
from benchnav.eval.experiment.unit import Extent
from benchnav.models.predictor import model_identity
from benchnav.planning.planners.compilation import can_compile

PACKAGES = ("benchnav", "torch", "numpy", "scipy", "gpytorch", "segmentation-models-pytorch")

Conditions = Mapping[str, tuple[Condition, Extent]]


def describe_code() -> dict[str, Any]:
    """What rows depend on beside their condition: sources, versions, arithmetic of the processor."""
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


def describe(conditions: Conditions) -> dict[str, Any]:
    """All that rows depend on beside the conditions themselves."""
    return {
        "datasets": describe_maps(conditions),
        "parts": describe_parts(conditions),
        "code": describe_code(),
    }


def describe_maps(conditions: Conditions) -> dict[str, Any]:
    """The maps used: by dataset its id and, by split, a digest of each map."""
    used: dict[str, dict[str, int]] = {}
    for condition, extent in conditions.values():
        splits = used.setdefault(condition.data, {})
        splits[condition.split] = max(extent.maps, splits.get(condition.split, 0))
    datasets = {data: TerrainDataset(find_dataset(data)) for data in used}
    return {
        data: {
            "id": datasets[data].id,
            "maps": {split: _map_digests(datasets[data], split, count) for split, count in splits.items()},
            "about": {split: datasets[data].about_digest(split) for split in splits},
        }
        for data, splits in used.items()
    }


def describe_parts(conditions: Conditions) -> dict[str, Any]:
    """Models by the digests of their files, parts that are not ours by origin and digest, files that options name."""
    described: dict[str, Any] = {}
    for condition, _ in conditions.values():
        for kind in PART_KINDS:
            part = getattr(condition, kind)
            name = f"{kind} {part.part}"
            if kind == "model" and name not in described:
                described[name] = model_identity(part.part)
            elif name not in described:
                found = registry.find(kind, part.part)
                described[name] = {} if found.shipped else {"origin": found.origin, "digest": found.digest}
            for text, digest in registry.option_files(kind, part).items():
                described[f"{text} of {name}"] = {"digest": digest}
    return {name: identity for name, identity in described.items() if identity}


def code_of(about: Mapping[str, Any], condition: Condition) -> dict[str, Any]:
    """What rows of a condition depend on beside its value and its maps, by what people call it.

    Args:
        about: the `run.json` of its run.
        condition: of the run.
    """
    used = {
        f"{kind} {getattr(condition, kind).part}": json.dumps(dict(getattr(condition, kind).options))
        for kind in PART_KINDS
    }

    def bears(name: str) -> bool:
        named = ((name.removesuffix(f" of {owner}"), options) for owner, options in used.items())
        return name in used or any(text != name and json.dumps(text) in options for text, options in named)

    parts = {name: identity for name, identity in about.get("parts", {}).items() if bears(name)}
    return _code({**about, "parts": parts})


def _code(about: Mapping[str, Any]) -> dict[str, Any]:
    """All that rows depend on beside conditions and maps."""
    code = about["code"]
    return {
        "benchnav's own sources": {"digest": code["sources"]},
        **code["versions"],
        **{name: code[name] for name in ("processor", "compiles")},
        "planner_limit_s": about["planner_limit_s"],
        "device": _device(about),
        **about["parts"],
    }


def code_differences(earlier: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Names what both have and what is not the same, with the values where they are short.

    Args:
        earlier: from `code_of`.
        now: as well.
    """
    unlike = [name for name, value in earlier.items() if name in now and now[name] != value]
    return [
        name if isinstance(now[name], Mapping) else f"{name} ({earlier[name]} to {now[name]})"
        for name in unlike
    ]


def differences(earlier: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Says what changed between two states of a run that bears on rows; what only one has is no change.

    Args:
        earlier: the `run.json` of the folder.
        now: what it would be.
    """
    changed = code_differences(_code(earlier), _code(now))
    for data, about in earlier["datasets"].items():
        again = now["datasets"].get(data, {"maps": {}})["maps"]
        for split, digests in about["maps"].items():
            pairs = zip(digests, again.get(split, digests), strict=False)
            if any(before != after for before, after in pairs):
                changed.append(f"maps of {data} {split}")
        meanings = now["datasets"].get(data, {}).get("about", {})
        changed += [
            f"class table, λ_stuck, resolution or kind of truth of {data} {split}"
            for split, digest in about["about"].items()
            if meanings.get(split, digest) != digest
        ]
    return changed


def _device(about: Mapping[str, Any]) -> str:
    """What a run is computed on."""
    device: str = about["gpu"] or about["device"]
    return device


def _map_digests(dataset: TerrainDataset, split: str, count: int) -> list[str]:
    digests = dataset.entry_digests(split, range(count))
    return [digest_of([entry.tobytes()])[:16] for entry in digests]


def command_lines(earlier: Iterable[str]) -> list[str]:
    """The commands that made a run, this process's last."""
    return [*(line for line in earlier if line != describe_command()), describe_command()]
