"""Seeded random edits of files, for tests that whatever was edited is refused in one
line or makes no difference.
"""

import copy
import json
import random
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

_VALUES = (None, True, 0, -1, 10**12, 0.5, float("nan"), "", "x", [], [0], {}, {"x": 0})


def edit_json(path: Path, chance: random.Random) -> str:
    """Edits a JSON file once or thrice, in its values or in its text; says how."""
    text = path.read_text()
    if chance.random() < 0.15:
        cut = chance.randrange(len(text))
        path.write_text(
            chance.choice((text[:cut], text[cut:], text[:cut] + "}" + text[cut:], ""))
        )
        return f"text at {cut}"
    content = json.loads(text)
    done = [_edit(content, chance) for _ in range(chance.choice((1, 1, 3)))]
    path.write_text(json.dumps(content))
    return "; ".join(done)


def _edit(content: Any, chance: random.Random) -> str:
    """Removes, replaces, doubles or renames one item of nested mappings and lists, at
    any depth alike.
    """
    holder, place, way = content, "", []
    while True:
        keys = list(holder) if isinstance(holder, dict) else list(range(len(holder)))
        key = chance.choice(keys)
        way.append(str(key))
        inner = holder[key]
        if not isinstance(inner, dict | list) or not inner or chance.random() < 0.2:
            break
        holder = inner
    place = ".".join(way)
    kind = chance.choice(("remove", "replace", "nudge", "double", "rename"))
    if kind == "remove":
        del holder[key]
    elif kind == "nudge" and isinstance(inner, int | float | str):
        holder[key] = inner + ("x" if isinstance(inner, str) else 1)
    elif kind == "double" and isinstance(holder, list):
        holder.append(copy.deepcopy(inner))
    elif kind == "rename" and isinstance(holder, dict):
        holder[f"{key}x"] = holder.pop(key)
    else:
        holder[key] = copy.deepcopy(chance.choice(_VALUES))
    return f"{kind} {place}"


def edit_table(path: Path, chance: random.Random) -> str:
    """Edits a Parquet file: its bytes, its rows, its columns or a value; says how."""
    kind = chance.choice(
        ("bytes", "cut", "rows", "double", "drop", "type", "value", "shuffle")
    )
    if kind in ("bytes", "cut"):
        content = bytearray(path.read_bytes())
        place = chance.randrange(len(content))
        if kind == "bytes":
            content[place] ^= 1 << chance.randrange(8)
        path.write_bytes(content if kind == "bytes" else content[:place])
        return f"{kind} at {place}"
    rows = pd.read_parquet(path)
    name, row = chance.choice(list(rows)), chance.randrange(len(rows))
    if kind == "rows":
        rows = rows.iloc[: chance.randrange(len(rows))]
    elif kind == "double":
        rows = pd.concat([rows, rows.iloc[[row]]])
    elif kind == "drop":
        rows = rows.drop(columns=name)
    elif kind == "type":
        rows[name] = chance.choice(
            ([str(value) for value in rows[name]], [np.nan] * len(rows), 7, None)
        )
    elif kind == "value":
        values = [*rows[name]]
        values[row] = chance.choice(("x", -1, 1e9, True))
        mixed = len({type(value) for value in values}) > 1 or chance.random() < 0.2
        rows[name] = [str(value) if mixed else value for value in values]
    else:
        rows[name] = (
            rows[name].sample(frac=1, random_state=chance.randrange(1000)).to_numpy()
        )
    rows.to_parquet(path)
    return f"{kind} {name} {row}"
