"""Settings of a run that are the same in several worlds.

A setting is a condition without its world: two conditions have the same setting if
their values in `run.json` differ only in the world. Changes of a preset's rules belong
to the setting. A block has the same data, scenario, robot and objective.
"""

import json
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from benchnav.core.settings import of, read
from benchnav.eval.experiment.condition import LABELS, NOT_USED
from benchnav.eval.stats.best import BLOCK, privileged_models
from benchnav.planning.free_space import Rules
from benchnav.planning.world.world import split_label

# Columns of a block. The world is no part of it.
BLOCK_LABELS = tuple(name for name in BLOCK if name != "world")
# Columns of a setting.
SETTING_LABELS = (*(name for name in LABELS if name != "world"), "rules")
Conditions = Mapping[str, Mapping[str, Any]]  # entries of `run.json` by id


@dataclass(frozen=True, kw_only=True, eq=False)
class Setting:
    """A setting in several worlds.

    Args:
        key: text that identifies the setting.
        labels: labels by column of `SETTING_LABELS`.
        ids: id of its condition in each world, by the world's label.
        privileged: its model if it receives part of the truth; otherwise empty.
    """

    key: str
    labels: Mapping[str, str]
    ids: dict[str, str]
    privileged: str = ""


@dataclass(frozen=True, kw_only=True, eq=False)
class Block:
    """The settings of a block with two or more worlds.

    Args:
        labels: labels by column of `BLOCK_LABELS`.
        worlds: labels of the worlds, in the order of the run.
        settings: settings, in the order of the run.
    """

    labels: Mapping[str, str]
    worlds: tuple[str, ...]
    settings: tuple[Setting, ...]

    def settings_in(self, worlds: Sequence[str]) -> list[Setting]:
        """Return the settings that were run in all of some worlds."""
        return [s for s in self.settings if s.ids.keys() >= set(worlds)]


def find_blocks(conditions: Conditions) -> list[Block]:
    """Return the blocks in which settings were run in two or more worlds.

    Args:
        conditions: entries of `run.json` by id.
    """
    privileged = privileged_models(conditions)
    settings: dict[str, Setting] = {}
    by_block: dict[tuple[str, ...], dict[str, Setting]] = defaultdict(dict)
    worlds: dict[tuple[str, ...], dict[str, None]] = defaultdict(dict)
    for condition, entry in conditions.items():
        key, world, rules = _identity(entry)
        labels = {**entry["labels"], "rules": rules or NOT_USED}
        new = Setting(
            key=key,
            labels={name: labels[name] for name in SETTING_LABELS},
            ids={},
            privileged=privileged.get(condition, ""),
        )
        setting = settings.setdefault(key, new)
        setting.ids[world] = condition
        block = tuple(setting.labels[name] for name in BLOCK_LABELS)
        by_block[block][key] = setting
        worlds[block][world] = None
    blocks = []
    for block, members in by_block.items():
        if all(len(setting.ids) < 2 for setting in members.values()):
            continue
        labels = dict(zip(BLOCK_LABELS, block, strict=True))
        blocks.append(
            Block(
                labels=labels,
                worlds=tuple(worlds[block]),
                settings=tuple(members.values()),
            )
        )
    return blocks


def _identity(entry: Mapping[str, Any]) -> tuple[str, str, str]:
    """Return the key of a condition's setting, the world's label, and rule changes."""
    value = entry["value"]
    rules = read(Rules, value["rules"], of("rules"))
    world, rule_changes = split_label(entry["labels"]["world"], rules)
    rest = {
        name: item for name, item in value.items() if name not in ("world", "rules")
    }
    key = json.dumps([rest, rule_changes], sort_keys=True)
    return key, world, rule_changes
