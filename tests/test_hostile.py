"""Hostile command lines and files: each ends in one line and status 2, before anything
is written.
"""

# ruff: noqa: E501 - a case a line

import os
import shlex
from pathlib import Path

import pytest

from benchnav.eval.experiment.suite import Suite
from benchnav.eval.run.runner import run_suite
from tests.commands import call

BOMB = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]\n" for n in range(1, 9)
)

# What makes a suite short, so that one which is not refused ends soon.
SHORT = "data: d.h5\nmodel: oracle\nscenarios: [std]\nplanners: [straight]\n"

# Suites, by what is wrong with them: `eval run --config NAME.yaml --out o` is tried
# with each.
SUITES: dict[str, str | bytes] = {
    # keys twice
    "twice": SHORT + "maps: 1\nmaps: 2\n",
    "twice-far": SHORT + "maps: 1\nseed: 3\nrisks: [mean]\nmaps: 1\n",
    "twice-inner": SHORT + "maps: 1\nworld: {noise: stored, noise: frozen}\n",
    "twice-in-list": "conditions:\n- planners: [straight]\n  planners: [mppi]\n",
    "twice-deep": "planners:\n- part: mppi\n  options: {samples: 8, samples: 16}\n",
    "twice-null": "world: {0: null, 0: null}\n",
    "twice-equal": "world: {1: a, 1.0: b}\n",
    "twice-without-values": "{maps, maps}\n",
    "twice-dotted": SHORT + "maps: 1\nworld.noise: stored\nworld.noise: frozen\n",
    "twice-dotted-first": SHORT + "maps: 1\nworld.noise: stored\nworld: {noise: frozen}\n",
    "twice-dotted-last": SHORT + "maps: 1\nworld: {noise: stored}\nworld.noise: frozen\n",
    # structure
    "recursive": "conditions: &a [*a]\n",
    "recursive-mapping": "world: &a {preset: *a}\n",
    "recursive-far": "world: &a {immobile: {below: [*a]}}\n",
    "recursive-whole": "&a [*a]\n",
    "bomb": BOMB,
    "bomb-inner": "conditions:\n" + "".join("- &" + line.replace(": &", " &")[1:].partition("&")[2] + "\n" for line in BOMB.splitlines()),
    "bomb-mappings": "a0: &a0 {k: v}\n" + "".join(f"a{n}: &a{n} {{l: *a{n - 1}, r: *a{n - 1}}}\n" for n in range(1, 40)),
    "deep": "maps: " + "[" * 3000 + "]" * 3000,
    "deep-open": "maps: " + "[" * 3000,
    "deep-mapping": "world: " + "{a: " * 3000 + "1" + "}" * 3000,
    "deep-block": "".join(" " * n + "a:\n" for n in range(1000)),
    "deep-dashes": "maps:\n" + "- " * 3000 + "1\n",
    "deep-dots": ".".join("a" * 3000) + ": 1\n",
    "deep-dots-known": "world." + ".".join("a" * 3000) + ": 1\n",
    "documents": "maps: 1\n---\nmaps: 2\n",
    "list": "- maps: 1\n",
    "text": "maps\n",
    "number": "3\n",
    "list-as-key": "? [a, b]\n: 1\n",
    "mapping-as-key": "? {a: b}\n: 1\n",
    "null-as-key": "null: 1\n",
    "empty-key": "'': 1\n",
    "dots-as-key": "'..': 1\n",
    "dot-at-end": "world.: 1\n",
    "true-as-key": "true: 1\n",
    "alias-of-nothing": "maps: *nope\n",
    "anchor-alone": "maps: &a\n",
    "unclosed": "maps: [1, 2\n",
    "unquoted": "maps: 'one\n",
    "tab": "world:\n\tnoise: stored\n",
    "percent": "%YAML 9.9\n---\nmaps: 1\n",
    "at": "maps: @1\n",
    "merge-nothing": "<<: 1\nmaps: 1\n",
    # bytes
    "not-utf8": b"maps: \xff\xfe\n",
    "utf16-cut": b"\xff\xfem\x00a\x00p",
    "nul": b"maps: 1\x00\n",
    "control": b"maps: \x07\n",
    "escape": b"data: \x1b[31mred\n",
    "gzip": b"\x1f\x8b\x08\x00\x00\x00\x00\x00",
    # types
    "python-object": "maps: !!python/object:os.system ls\n",
    "python-apply": "maps: !!python/object/apply:os.system ['touch made-by-yaml']\n",
    "python-name": "data: !!python/name:os.system\n",
    "own-tag": "maps: !mine 1\n",
    "date": "data: 2001-01-01\n",
    "date-for-number": "maps: 2001-01-01\n",
    "date-invalid": "data: 2001-13-45\n",
    "time": "maps: 2001-01-01T10:00:00Z\n",
    "binary": "data: !!binary aGVsbG8=\n",
    "binary-invalid": "data: !!binary '*'\n",
    "set": "planners: !!set {mppi, straight}\n",
    "omap": "world: !!omap [{preset: paper}]\n",
    "int-tag": "maps: !!int many\n",
    "float-tag": "maps: !!float much\n",
    "bool-tag": "maps: !!bool perhaps\n",
    "null-value": "maps: null\n",
    "sexagesimal": "maps: 190:20:30\n",
    "digits": f"maps: {'9' * 5000}\n",
    "digits-hex": f"seed: 0x{'f' * 5000}\n",
    "digits-seeds": f"seeds: [{'9' * 4000}]\n",
    "long-word": f"data: {'x' * 100_000}\n",
    "long-key": f"{'x' * 900}: 1\n",
    "many-keys": "".join(f"k{n}: 1\n" for n in range(2_000)),
    # paths and names
    "nul-data": 'data: "a\\0b"\n',
    "nul-model": 'model: "a\\0b"\n',
    "nul-part": 'planners: ["a\\0b.py:Part"]\n',
    "nul-module": 'planners: ["a\\0b:Part"]\n',
    "nul-checkpoint": 'model: "part.py:Part@a\\0b"\n',
    "nul-out": 'out: "a\\0b"\n',
    "nul-scenario": 'scenarios: ["a\\0b"]\n',
    "url-data": "data: s3://bucket/data.h5\n",
    "url-model": "model: https://host/model\n",
    "url-part": "planners: [https://host/part.py:Part]\n",
    "url-out": "out: gs://bucket/run\n",
    "surrogate": 'data: "\\udcff"\n',
    "surrogate-out": 'out: "\\ud800"\n',
    "newline-label": 'data: d.h5\nmodel: oracle\nmaps: 1\nplanners: [{part: straight, label: "a\\nb"}]\n',
    "escape-label": 'data: d.h5\nmodel: oracle\nmaps: 1\nplanners: [{part: straight, label: "a\\e[31mb"}]\n',
    "nul-label": 'data: d.h5\nmodel: oracle\nmaps: 1\nplanners: [{part: straight, label: "\\0"}]\n',
    "empty-label": "data: d.h5\nmodel: oracle\nmaps: 1\nplanners: [{part: straight, label: ''}]\n",
    "blank-label": "data: d.h5\nmodel: oracle\nmaps: 1\nplanners: [{part: straight, label: '  '}]\n",
    "list-label": "data: d.h5\nmodel: oracle\nmaps: 1\nplanners: [{part: straight, label: [a]}]\n",
    "bidi-label": 'data: d.h5\nmodel: oracle\nmaps: 1\nplanners: [{part: straight, label: "a\\u202eb"}]\n',
    "empty-names": "data: ''\nmodel: ''\n",
    "empty-model": "data: d.h5\nmodel: ''\nmaps: 1\n",
    "empty-planner": "data: d.h5\nmodel: oracle\nmaps: 1\nplanners: ['']\n",
    "empty-scenario": "data: d.h5\nmodel: oracle\nmaps: 1\nscenarios: ['']\n",
    "colon-planner": "data: d.h5\nmodel: oracle\nmaps: 1\nplanners: [':']\n",
    "dots-planner": "data: d.h5\nmodel: oracle\nmaps: 1\nplanners: ['..:..']\n",
    "folder-part": "data: d.h5\nmodel: oracle\nmaps: 1\nplanners: [folder.py:Part]\n",
    "binary-part": "data: d.h5\nmodel: oracle\nmaps: 1\nplanners: [binary.py:Part]\n",
    "deep-part": "data: d.h5\nmodel: oracle\nmaps: 1\nplanners: [deep.py:Part]\n",
    # counts, and products of lists
    "realisations": "data: d.h5\nmodel: oracle\nmaps: 1\nrealisations: 1000000000\n",
    "realisations-more": "data: d.h5\nmodel: oracle\nmaps: 1\nrealisations: 1000000000000000000000\n",
    "maps": "data: d.h5\nmodel: oracle\nmaps: 1000000000\n",
    "all-of-many": "data: d.h5\nmodel: oracle\nmaps: 0\nrealisations: 100000000\n",
    "seeds": f"data: d.h5\nmodel: oracle\nmaps: 1\nrealisations: 10000000\nseeds: {list(range(100))}\n",
    "settings": "data: d.h5\nmodel: oracle\nmaps: 1\nplanners: [{part: mppi, options: {"
    + ", ".join(f"{name}: {list(range(1, 101))}" for name in ("samples", "horizon", "iterations", "lambda_"))
    + "}}]\n",
    "worlds": f"data: d.h5\nmodel: oracle\nmaps: 1\nworld: {{noise: frozen, correlation_m: {list(range(1, 1001))}, time_budget_s: {list(range(1, 1001))}, immobile: {{below: {[n / 1001 for n in range(1, 1001)]}}}}}\n",
    "tasks": f"data: d.h5\nmodel: oracle\nmaps: 1\ntask: {{goal_radius_m: {list(range(1, 3001))}, replan_every_s: {list(range(1, 3001))}, min_traversability: {[n / 3001 for n in range(1, 3001)]}}}\n",
    "product": f"data: d.h5\nmodel: oracle\nmaps: 1\nrisks: {[f'cvar:{n / 1000}' for n in range(0, 1000, 10)]}\nworld: {{correlation_m: {list(range(1, 1000))}, noise: frozen}}\nplanners: [{{part: mppi, options: {{samples: {list(range(1, 1000))}}}}}]\n",
    "samples": "data: d.h5\nmodel: oracle\nmaps: 1\nplanners: [{part: mppi, options: {samples: 1000000000000}}]\n",
    "samples-more": "data: d.h5\nmodel: oracle\nmaps: 1\nplanners: [{part: mppi, options: {samples: 1000000000000000000000}}]\n",
    "horizon": "data: d.h5\nmodel: oracle\nmaps: 1\nplanners: [{part: mppi, options: {horizon: 1000000000000}}]\n",
    "steps": "data: d.h5\nmodel: oracle\nmaps: 1\nworld: {time_budget_s: 1.0e+300}\n",
    "steps-many": "data: d.h5\nmodel: oracle\nmaps: 1\nworld: {time_budget_s: 1.0e+12}\n",
    # numbers
    "budget-nan": "data: d.h5\nmodel: oracle\nmaps: 1\nworld: {time_budget_s: .nan}\n",
    "budget-small": "data: d.h5\nmodel: oracle\nmaps: 1\nworld: {time_budget_s: 1.0e-300}\n",
    "ratio-inf": "data: d.h5\nmodel: oracle\nmaps: 1\nworld: {preset: stakes, time_budget_ratio: .inf}\n",
    "correlation-nan": "data: d.h5\nmodel: oracle\nmaps: 1\nworld: {noise: frozen, correlation_m: .nan}\n",
    "correlation-huge": "data: d.h5\nmodel: oracle\nmaps: 1\nworld: {noise: frozen, correlation_m: 1.0e+308}\n",
    "immobile-nan": "data: d.h5\nmodel: oracle\nmaps: 1\nworld: {preset: stakes, immobile: {below: .nan}}\n",
    "immobile-for": "data: d.h5\nmodel: oracle\nmaps: 1\nworld: {preset: stakes, immobile: {for_s: .inf}}\n",
    "radius-nan": "data: d.h5\nmodel: oracle\nmaps: 1\ntask: {goal_radius_m: .nan}\n",
    "replan-zero": "data: d.h5\nmodel: oracle\nmaps: 1\ntask: {replan_every_s: 0}\n",
    "above-nan": "data: d.h5\nmodel: oracle\nmaps: 1\ntask: {free_space: {above: .nan}}\n",
    "least-huge": "data: d.h5\nmodel: oracle\nmaps: 1\ntask: {min_traversability: 1.0e+300}\n",
    "level-nan": "data: d.h5\nmodel: oracle\nmaps: 1\nrisks: ['cvar:.nan']\n",
    "level-two": "data: d.h5\nmodel: oracle\nmaps: 1\nrisks: ['cvar:2']\n",
    "seed-huge": "seed: 9223372036854775808\n",
    "seed-negative": "seeds: [-1]\n",
    "seeds-twice": "seeds: [1, 1]\n",
    "hypotheses": "hypotheses: [1]\n",
    "hypothesis-empty": "data: d.h5\nmodel: oracle\nmaps: 1\nhypotheses: [{}]\n",
    "hypothesis-margin": "data: d.h5\nmodel: oracle\nmaps: 1\nplanners: [straight, astar_dwa]\nrisks: [mean]\nhypotheses: [{one: {planner: astar_dwa}, other: {planner: straight}, metric: success, kind: non-inferiority, margin: .nan}]\n",
    "conditions-text": "conditions: [a]\n",
    "conditions-key": "conditions: [{nope: 1}]\n",
    "conditions-number-key": "conditions: [{3: 1}]\n",
}  # fmt: skip

# Command lines, without the folder of files that they are given in.
LINES: list[str] = [
    # addresses as outputs
    *(f"eval run --data d.h5 --model oracle --maps 1 --out {url}" for url in ("s3://b/c", "file:///b/c", "hf://a/b", "gs:/b")),
    "eval merge s3://b/c r", "eval rerun r --out s3://b/c", "eval report r --out s3://b/c",
    "eval compare r --by planner --out s3://b/c", "eval replay r --out s3://b/c", "eval replay r --video s3://b/c.mp4",
    "datagen create tiny-v1 --out s3://b/c", "datagen create tiny-v1 --out s3://b/c.h5",
    "datagen merge d.h5 d.h5 --out https://b/c.h5", "datagen import-dem d.tif --out s3://b/c.h5",
    "datagen import-drives d.csv --dem d.tif --photo p.tif --out s3://b/c.h5",
    "datagen ground d.h5 --out s3://b/c.json", "datagen export d.h5 --out s3://b/c", "datagen preview d.h5 --out s3://b/c.png",
    "train fit mdn --data d.h5 --out s3://b/c", "train classifier --data d.h5 --out s3://b/c", "train gp --data d.h5 --out s3://b/c",
    "train all --data d.h5 --out s3://b/c", "train mdn --data d.h5 --out s3://b/c", "train evaluate oracle --data d.h5 --out s3://b/c",
    "train evaluate oracle --data d.h5 --json s3://b/c.json", "train compare oracle --data d.h5 --out s3://b/c",
    "train export stakes-v1 --onnx s3://b/c.onnx",
    # addresses as inputs
    "eval run --config s3://b/s.yaml", "eval run --data s3://b/d.h5 --out o", "eval report s3://b/r", "eval rerun s3://b/r",
    "eval compare s3://b/r", "eval replay s3://b/r", "eval merge o s3://b/r", "datagen create s3://b/recipe.yaml",
    "datagen list --folder s3://b/c", "datagen show s3://b/d.h5", "datagen validate s3://b/d.h5", "datagen merge s3://b/d.h5 d.h5 --out o.h5",
    "datagen ground s3://b/d.h5", "datagen export s3://b/d.h5 --out o", "datagen preview s3://b/d.h5",
    "train fit mdn --data s3://b/d.h5 --out o", "train evaluate s3://b/c --data d.h5", "train evaluate oracle --data s3://b/d.h5",
    "train compare s3://b/c --data d.h5", "train export s3://b/c --onnx o.onnx", "train gp --data s3://b/slip.csv --out o",
    # NUL, where a caller that is no shell may put it
    *(line.replace("@", "'a\0b'") for line in (
        "eval run --config @", "eval run --data @ --out o", "eval run --data d.h5 --model @ --out o", "eval run --data d.h5 --model oracle --maps 1 --out @",
        "eval run --planners @ --out o", "eval run --data d.h5 --model oracle --planners mppi --shard @ --out o",
        "eval report @", "eval report r --out @", "eval compare @", "eval compare r --out @", "eval replay @", "eval replay r --out @",
        "eval replay r --planner @", "eval merge @ r", "eval merge o @", "eval rerun @", "eval rerun r --out @", "eval list @",
        "datagen create @", "datagen create tiny-v1 --out @", "datagen create tiny-v1 id=@", "datagen list --folder @", "datagen show @",
        "datagen validate @", "datagen merge @ @ --out o.h5", "datagen merge d.h5 d.h5 --out @", "datagen import-dem @ --out o.h5",
        "datagen import-dem d.tif --out @", "datagen import-drives @ --dem d.tif --photo p.tif --out o.h5", "datagen ground @",
        "datagen ground d.h5 --out @", "datagen export d.h5 --out @", "datagen export @ --out o", "datagen preview @",
        "datagen preview d.h5 --split @", "train fit @ --data d.h5 --out o", "train fit mdn --data @ --out o", "train fit mdn --data d.h5 --out @",
        "train gp --data @ --out o", "train gp --data d.h5 --out @", "train evaluate @ --data d.h5", "train evaluate oracle --data d.h5 --json @",
        "train evaluate oracle --data d.h5 --out @", "train compare @ --data d.h5", "train compare oracle --data d.h5 --out @",
        "train export @ --onnx o.onnx", "train export stakes-v1 --onnx @",
    )),
    # surrogates, which stand for bytes that are no UTF-8
    "eval run --config '\udcff'", "eval run --data '\udcff' --out o", "eval report '\udcff'", "datagen show '\udcff'", "train evaluate '\udcff' --data d.h5",
    "datagen create tiny-v1 'id=\udcff'", "eval '\udcff'", "eval run '--\udcff' 1",
    # nothing
    "eval run --data d.h5 --model oracle --maps 1 --out ''", "eval run --config ''", "eval run --data '' --out o", "eval run --out", "eval report ''", "eval compare ''",
    "eval compare", "eval merge '' r", "eval merge o ''", "eval merge o", "eval rerun ''", "eval replay ''", "eval list ''", "eval ''",
    "datagen create ''", "datagen create tiny-v1 ''", "datagen create tiny-v1 id=", "datagen create tiny-v1 =3", "datagen show ''", "datagen validate ''",
    "datagen merge '' '' --out o.h5", "datagen merge d.h5 d.h5 --out ''", "datagen merge --out o.h5", "datagen import-dem '' --out o.h5", "datagen import-dem d.tif --out ''",
    "datagen ground ''", "datagen export d.h5 --out ''", "datagen export d.h5 --out o --splits ''", "datagen export d.h5 --out o --fields ''", "datagen preview ''",
    "datagen preview d.h5 --maps ''", "train fit '' --data d.h5 --out o", "train fit mdn --data '' --out o", "train fit mdn --data d.h5 --out ''",
    "train gp --data d.h5 --out ''", "train gp --data '' --out o", "train evaluate '' --data d.h5", "train evaluate oracle --data ''", "train compare --data d.h5",
    "train compare '' --data d.h5", "train export '' --onnx o.onnx", "train export stakes-v1 --onnx ''", "train export stakes-v1 --onnx .onnx/",
    # folders for files, files for folders
    "eval run --config folder.yaml", "eval run --data folder --out o", "eval run --data d.h5 --model folder --out o", "eval run --data d.h5 --model oracle --maps 1 --out text",
    "eval run --data d.h5 --model oracle --maps 1 --out text/o", "eval run --data d.h5 --model oracle --maps 1 --out folder", "eval run --data d.h5 --model oracle --maps 1 --out /",
    "eval run --data text --model oracle --out o", "eval report text", "eval report folder", "eval report r --out text/o", "eval compare text", "eval compare r --by planner --out folder/",
    "eval compare r --by planner --out text/o", "eval merge r r", "eval merge o text", "eval rerun text", "eval replay text", "eval replay r --video folder.mp4", "eval replay r --video text/o.mp4",
    "datagen create folder", "datagen create text", "datagen create binary.yaml", "datagen create tiny-v1 --out text", "datagen create tiny-v1 --out text/o.h5",
    "datagen create tiny-v1 --out folder.h5", "datagen list --folder text", "datagen show text", "datagen show folder", "datagen merge text text --out o.h5",
    "datagen merge d.h5 d.h5 --out folder.h5", "datagen import-dem folder --out o.h5", "datagen import-drives folder.csv --dem d.tif --photo p.tif --out o.h5", "datagen ground d.h5 --out folder.json",
    "datagen export d.h5 --out text", "datagen export d.h5 --out folder", "datagen preview d.h5 --out folder.png", "datagen preview d.h5 --out text/o.png",
    "train fit mdn --data d.h5 --out text", "train fit mdn --data d.h5 --out folder", "train fit mdn --data text --out o", "train gp --data folder.csv --out o",
    "train gp --data binary.csv --out o", "train gp --data d.h5 --out folder", "train evaluate folder --data d.h5", "train evaluate oracle --data d.h5 --json folder",
    "train evaluate oracle --data d.h5 --json text/o.json", "train evaluate oracle --data d.h5 --out text", "train evaluate text --data d.h5", "train compare oracle --data d.h5 --out folder",
    "train compare oracle --data d.h5 --out text", "train export text --onnx o.onnx", "train export stakes-v1 --onnx folder.onnx", "train export stakes-v1 --onnx text/o.onnx",
    "eval run --data d.h5 --model oracle --planners folder.py:Part --out o", f"eval run --data {'x' * 300} --out o", f"eval report {'x' * 300}", f"datagen show {'x/' * 3000}",
    f"eval run --data d.h5 --model oracle --maps 1 --out {'x' * 300}", f"datagen create tiny-v1 --out {'x' * 300}.h5", f"train fit mdn --data d.h5 --out {'x' * 300}",
    f"eval {'x' * 100_000}", f"eval run --{'x' * 100_000} 1", f"datagen create tiny-v1 {'x' * 100_000}=1", f"eval run --risks {','.join(['mean'] * 110_000)} --data nope --out o",
    # numbers
    *(f"eval compare r --by planner --points {number}" for number in ("1e-300", "1e-30", "5e-324", "nan", "inf", "-inf", "1e400", "0", "-1", "101", "''", "five", "5%", "1_0e", "1e-12")),
    *(f"eval run --data d.h5 --model oracle --out o --maps {number}" for number in ("-1", "1.5", "nan", "inf", "1e30", "''", "ten", "9" * 30, "9" * 5000, "[]", "null", "true")),
    *(f"eval run --data d.h5 --model oracle --maps 1 --out o --realisations {number}" for number in ("0", "-1", "1.5", "nan", "1000000000", "9" * 30, "''")),
    *(f"eval run --data d.h5 --model oracle --maps 1 --out o --seed {number}" for number in ("-1", "1.5", "nan", str(2**63), "9" * 30, "''")),
    *(f"eval run --data d.h5 --model oracle --maps 1 --out o --seeds {seeds}" for seeds in ("1,1", "-1", "a", "1,nan", f"{2**63}")),
    *(f"eval run --data d.h5 --model oracle --maps 1 --out o --jobs {number}" for number in ("0", "-1", "1.5", "nan", "1000000000", "9" * 30, "''")),
    *(f"eval run --data d.h5 --model oracle --maps 1 --out o --planner-limit-s {number}" for number in ("-1", "nan", "inf", "1e400", "''", "1e300")),
    *(f"eval run --data d.h5 --model oracle --maps 1 --out o --shard {shard}" for shard in ("0/0", "0/1", "2/1", "1", "1/", "/2", "a/b", "1/2/3", "-1/2", "1.0/2", f"1/{'9' * 5000}", f"1/{'9' * 30}", "' '")),
    *(f"eval run --data d.h5 --model oracle --maps 1 --out o {words}" for words in (
        "--device tpu", "--backend dask", "--backend dask --scheduler nope", "--backend dask --scheduler tcp://:1", "--backend dask --scheduler tcp://127.0.0.1:99999",
        "--backend dask --scheduler http://127.0.0.1:1", "--scheduler tcp://127.0.0.1:1", "--backend slurm", "--record everything", "--record ''", "--world nope", "--world ''", "--world '{}' --world.noise loud",
        "--world.noise.a.b.c 1", "--world '{noise: stored, noise: frozen}'", "--world '[[[['", f"--world '{'{a: ' * 3000}'", f"--world '{'[' * 3000}{']' * 3000}'", "--world '&a {a: *a}'", "--task '&a [*a]'",
        "--task.goal_radius_m nan", "--task.goal_radius_m -1", "--task 3", "--risks ''", "--risks cvar:1", "--risks cvar:-1", "--risks cvar:nan", "--risks cvar:1e400", "--risks nope", "--planners ''",
        "--planners '[]'", "--planners '[[]]'", "--planners '{}'", "--planners '{part: 3}'", "--planners '{part: mppi, options: {samples: 0}}'", "--planners '{part: mppi, options: {samples: nan}}'",
        "--planners '{part: mppi, options: {samples: []}}'", "--planners '{part: mppi, options: {samples: 1000000000000}}'", "--planners ./none.py:Part", "--planners os:system", "--planners benchnav:nope", "--planners 'a b'",
        "--planners 'straight\nmppi'", "--robots '{part: unicycle, options: {dt_s: 0}}'", "--robots '{part: unicycle, options: {dt_s: .nan}}'", "--robots '{part: unicycle, options: {dt_s: 1.0e-300}}'",
        "--scenarios nope", "--model 'oracle\n'", "--model ../../etc/passwd", "--models oracle,oracle", "--hypotheses '[{}]'", "--conditions '[{}, {}, 3]'", "--conditions '[{planners: []}]'",
        "--maps 1 extra", "-x", "--", "--=1", "--maps=", "--config", "--reuse-code maybe",
    )),
    *(f"eval replay r {words}" for words in ("--map -1", "--map 1000000000", f"--map {'9' * 30}", "--seed -1", f"--seed {'9' * 30}", "--realisation -1", "--realisation 7", "--planner nope", "--video o.gif", "--video o.mp4 --web", "--video ''.mp4x")),
    *(f"eval compare r {words}" for words in ("--by nope", "--against nope", "--planner nope", "--allow-different everything", "r --by run", "--by planner --out .", "--by planner --out ..")),
    "eval rerun r --jobs 0", "eval rerun r --out r", "eval rerun r --backend dask", "eval list nope", "eval nope", "eval run --config nope --out o",
    *(f"datagen create tiny-v1 --out o.h5 {words}" for words in (
        "--jobs 0", "--jobs 1000000000", "--jobs nan", "--first -1", "--first nan", f"--first {'9' * 5000}", "--seed 1.5", f"--seed {2**70}", "--seed -1", "--splits nope", "--splits '[]'", "--splits ''",
        "--shard 1/2", "--shard 0/2", "--backend dask", "--scheduler x", "id=a height=1000000000", "id=a height=0", "id=a height=-1", "id=a height=nan", "id=a height=1e9", f"id=a height={'9' * 30}",
        "id=a resolution_m=0", "id=a resolution_m=nan", "id=a resolution_m=inf", "id=a resolution_m=-1", "id=a resolution_m=1e-300", "id=a resolution_m=1e300", "id=a splits.train.maps=1000000000000",
        f"id=a splits.train.maps={'9' * 30}", "id=a splits.train.maps=0", "id=a splits.train.maps=-1", "id=a seed=nan", f"id=a seed={2**63}", "id=a classes=[]", "id=a occupancy=[]", "id=a occupancy=[nan]", "id=a environments=0",
        "id=a environments=1000000000", "id=a class_periods_m=[]", "id=a class_periods_m=[nan]", "id=a start_m=[nan,nan]", "id=a goal_m=[inf,0]", "id=a stuck_threshold=nan", "id=a splits={}",
        "id=a/b", "id=../a", "'id=a\nb'", "'id=a b'", "id=.", "id=s3://b/c", "id=tiny-v1 height=20", "height=20", "id=a '=1'", "id=a ..=1", "id=a 'splits=&a {train: *a}'", f"id=a 'classes={'[' * 3000}{']' * 3000}'",
        "id=a 'splits={train: {scenario: std, maps: 1, maps: 2}}'", "id=a 'synthesis=3'", "id=a 'synthesis=[]'", "id=a 'synthesis={}'", "id=a scenarios=3", "id=a 'scenarios={std: 2001-01-01}'", "id=a 'scenarios={std: {severity: .nan}}'",
        "id=a 'scenarios={std: {preset: []}}'", "id=a scenarios.std.relief_m=[nan,nan]", "id=a scenarios.std.crater_count=[0,1000000000]", "id=a scenarios.std.roughness=1e300", "id=a 'seed=!!python/object:os.system ls'", "id=a 'seed=2001-01-01'",
        "id=a correlation_m=nan", "id=a vegetation_period_m=nan", "id=a classes.basalt.scale=nan", "id=a classes.basalt.noise=-1", "id=a 'classes.basalt.name=\"a\\nb\"'",
    )),
    *(f"datagen export d.h5 --out o {words}" for words in ("--splits nope", "--splits '[]'", "--fields nope", "--fields '[]'", "--maps-per-file -1", "--maps-per-file nan", f"--maps-per-file {'9' * 30}", "--license MIT --creator a --date 2020-99-99", "--license MIT --creator a --date today", "--license MIT --creator 'a\nb'", "--license 'M\0T' --creator a", "--license MIT --creator a --url 'not a url'")),
    *(f"datagen preview d.h5 {words}" for words in ("--maps -1", "--maps 99999", f"--maps {'9' * 30}", "--maps nan", "--maps '[]'", "--split nope", "--split ''x", "--out o.gif", "--out o", "--contact-sheet --maps 1", "--out .png")),
    "datagen merge d.h5 --out o.h5", "datagen merge d.h5 d.h5 --out o.h5 --id 'a b'", "datagen merge d.h5 d.h5 --out o.h5 --id 'a\nb'", "datagen merge d.h5 d.h5 --out d.h5", "datagen ground d.h5 --out o.txt", "datagen list x", "datagen show d.h5 --json maybe",
    *(f"datagen import-dem d.tif --out o.h5 {words}" for words in ("--stride nan", "--stride 0", "--stride -1", "--stride 1e-300", "--splits ''", "--splits train:nan", "--splits train:-1,valid:2", "--splits train:1e300", "--splits a:b", "--splits train", "--id 'a b'", "--recipe nope", "--class-ids '{1: a, 1: b}'", "--class-ids '[1]'", "--class-ids '{a: b}'", "--layer ''", "--layer a", "--layer 'a=b' --layer 'a=c'", "--scenario nope", "id=a height=nan")),
    *(f"datagen import-drives d.csv --dem d.tif --out o.h5 {words}" for words in ("", "--photo p.tif --least-speed nan", "--photo p.tif --least-speed -1", "--photo p.tif --splits train:nan", "--photo p.tif --stride inf")),
    *(f"train {words} --data d.h5 --out o" for words in (
        "fit nope", "fit fused --members 0", "fit mdn --members -1", "fit mdn --members 1000000000", "fit mdn --members nan", "fit mdn --seed -1", f"fit mdn --seed {2**63}", "fit mdn --seed nan", "fit mdn --workers -1", "fit mdn --workers nan",
        "fit mdn --workers 1000000000", "fit mdn --crop -1", "fit mdn --crop 1000000000", "fit mdn --device tpu", "fit mdn --trainer 3", "fit mdn --trainer.nope 1", "fit mdn --trainer.max_epochs nan", "fit mdn --trainer.devices 0", "fit mdn --trainer.devices 1000000000",
        "fit mdn --trainer.precision 7", "fit mdn --trainer.accelerator abacus", "fit mdn --trainer '&a {a: *a}'", "fit mdn --settings 3", "fit mdn --settings.nope 1", "fit mdn --settings.hidden 0", "fit mdn --settings.hidden nan", "fit mdn --settings.hidden 1000000000000",
        f"fit mdn --settings.hidden {'9' * 30}", "fit mdn --settings.components 1000000000000", "fit mdn --settings.learning_rate nan", "fit mdn --settings.learning_rate 0", "fit mdn --settings.learning_rate 1e300", "fit mdn --settings.batch_size 1", "fit mdn --settings.batch_size nan",
        f"fit mdn --settings.batch_size {'9' * 30}", "fit mdn --settings.max_epochs 0", "fit mdn --settings.inputs []", "fit mdn --settings.inputs nope", "fit mdn --settings.inputs [rgb,rgb]", "fit mdn --settings.encoder nope", "fit mdn --settings.encoder ''", "fit mdn --settings.architecture nope",
        "fit mdn --settings.encoder_depth 0", "fit mdn --settings.encoder_depth 99", "fit mdn --settings '{hidden: 8, hidden: 9}'", "fit ./none.py:Model", "fit folder.py:Model", "fit os:system", "fit binary.py:Model",
        "mdn --mdn.hidden -1", "mdn --mdn.hidden 1000000000000", "mdn --mdn.learning_rate nan", "mdn --mdn.masking.share nan", "mdn --mdn.masking.share 2", "mdn --mdn.masking.radius_m [0,1]", "mdn --mdn.masking.radius_m [nan,nan]", "mdn --mdn.masking.radius_m [1]", "mdn --mdn.jitter nan",
        "classifier --classifier.decoder_channels [0]", "classifier --classifier.decoder_channels [1000000000000]", "classifier --classifier.focal nan", "classifier --classifier.dice inf", "classifier --classifier.label_smoothing 1", "classifier --classifier '{dice: 1, dice: 2}'", "classifier --members 0",
        "gp --gp.inducing_points 1", "gp --gp.inducing_points 1000000000000", "gp --gp.epochs 0", "gp --gp.prior_level nan", "gp --gp.prior_fall inf", "gp --gp.prior_std_range [1,0]", "gp --gp.prior_std_range [nan,nan]", "gp --gp.length_deg 1e300", "gp --gp.noise_std 0", "gp --gp.likelihood nope", "gp --seed -1",
        "all --members 0", "all --classifier.encoder nope", "all --gp.prior_level nan", "mdn --resume --overwrite nope",
    )),
    *(f"train evaluate oracle --data d.h5 {words}" for words in ("--maps -1", "--maps nan", "--seed -1", f"--seed {2**63}", "--seed nan", "--splits nope", "--splits '[]'", "--splits ''", "--device tpu", "--json nope/o.json")),
    *(f"train compare oracle --data d.h5 {words}" for words in ("oracle", "--seed -1", "--splits nope", "--splits '[]'", "nope", "'or\nacle'")),
    *(f"train export stakes-v1 --onnx {words}" for words in ("o.onnx --level nan", "o.onnx --level 1", "o.onnx --level -1", "o.onnx --level inf", "o.onnx --opset 0", "o.onnx --opset -1", "o.onnx --opset 1000000000", "o.onnx --opset nan", "o.txt")),
    "train export oracle --onnx o.onnx", "train nope", "train fit mdn", "train fit --data d.h5 --out o",
]  # fmt: skip

CASES = [
    f"eval run --config {name}.yaml{' --out o' * (not name.endswith('-out'))}"
    for name in SUITES
] + LINES


def lay_out(folder: Path, dataset: Path) -> None:
    """Puts the files that cases name into a folder, with a finished run on a dataset."""
    (folder / "d.h5").symlink_to(dataset)
    for name, content in SUITES.items():
        Path(folder, f"{name}.yaml").write_bytes(
            content.encode() if isinstance(content, str) else content
        )
    for name in ("text", "text.csv"):
        Path(folder, name).write_text("nothing\n")
    for suffix in ("yaml", "py", "csv", "h5"):
        Path(folder, f"binary.{suffix}").write_bytes(b"\xff\xfe\x00\x81")
    Path(folder, "deep.py").write_text("(" * 3000 + ")" * 3000)
    for suffix in ("", ".yaml", ".py", ".csv", ".h5", ".json", ".png", ".mp4", ".onnx"):
        Path(folder, f"folder{suffix}").mkdir()
        Path(folder, f"folder{suffix}", "notes.txt").write_text("not to be lost\n")
    suite = Suite(
        data=str(dataset), model="oracle", planners=("straight", "tests.eval.parts:Faulty"), risks=("mean",),
        scenarios=("std",), maps=2, record="none", world={"time_budget_s": 1.0},
    )  # fmt: skip
    for _ in run_suite(suite, folder / "r"):
        pass


def files_in(folder: Path) -> dict[str, int]:
    """All files and folders in a folder, files with the time of their last change."""
    found = {}
    for place, folders, files in os.walk(folder):
        found |= {f"{place}/{name}": 0 for name in folders}
        found |= {
            f"{place}/{name}": os.lstat(f"{place}/{name}").st_mtime_ns for name in files
        }
    return found


@pytest.fixture(scope="module")
def laid_out(
    dataset_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, dict[str, int]]:
    """The folder, and all that is in it."""
    folder = tmp_path_factory.mktemp("hostile")
    lay_out(folder, dataset_path)
    return folder, files_in(folder)


@pytest.mark.parametrize(
    "line", CASES, ids=[f"{n} {ascii(line)[1:90]}" for n, line in enumerate(CASES)]
)
def test_hostile_input_ends_in_one_line(
    line: str,
    laid_out: tuple[Path, dict[str, int]],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    folder, before = laid_out
    monkeypatch.chdir(folder)
    program, *words = shlex.split(line)
    assert call(program, *words) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith(f"benchnav-{program}")
    assert (err.count("\n"), err[-1:]) == (1, "\n")
    assert len(err) < 5000
    assert files_in(folder) == before
