"""Running a suite into a run folder: unit by unit, in parallel, to be resumed at any moment.

A run folder holds `run.json` (the suite, and where everything came from), `maps/` (the map each
risk setting gives a planner), `units/` (what is finished), and, when all is done, `episodes.parquet`,
`steps.parquet`, `timing.csv` and the report. Every file is written under another name first. A row
does not depend on the number of workers, on the order of units, or on interruptions.
"""

import hashlib
import json
import os
import platform
import shlex
import sys
import warnings
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import joblib
import numpy as np
import pandas as pd
import torch

from benchnav import rng
from benchnav.datagen.store import TerrainDataset, find_dataset
from benchnav.errors import BenchnavError, ConfigError
from benchnav.eval.metrics import episode_table, step_table
from benchnav.eval.playback import PLAN_EVERY, PlanSketch, Recording, write_recording
from benchnav.eval.rollout import Episodes, run_episodes
from benchnav.eval.suite import Suite, Unit, containing, units
from benchnav.files import replacing, sole_writer, write_text
from benchnav.models.predictor import AnyModel, find_checkpoint, load_model, model_names, predict
from benchnav.planning.dynamics import Unicycle
from benchnav.planning.objective import GoalDistance
from benchnav.planning.planner import Plan, make_planner
from benchnav.planning.problem import Problem, heading_to
from benchnav.planning.risk import RiskSetting
from benchnav.planning.simulation import Simulation, SimulationConfig, steps_in

PACKAGES = ("benchnav", "torch", "numpy", "scipy", "gpytorch", "segmentation-models-pytorch", "rerun-sdk")


def run_suite(suite: Suite, folder: Path, jobs: int = 1) -> Iterator[tuple[int, int]]:
    """Runs what is not finished of a suite, yielding (units done, units in all); to be iterated to the end.

    Args:
        suite: what is evaluated.
        folder: the run folder; it may hold an interrupted run of the same suite.
        jobs: worker processes.

    Raises:
        ConfigError: the folder holds another run, or the suite cannot be run.
        DatasetError: the dataset lacks what the suite asks for.
    """
    torch.set_num_threads(1)
    dataset = TerrainDataset(find_dataset(suite.data))
    model = check(suite, dataset)
    _begin(suite, dataset, folder)
    with sole_writer(folder, str(folder)):
        yield from _run_units(suite, model, dataset, folder, jobs)


def _run_units(
    suite: Suite, model: AnyModel, dataset: TerrainDataset, folder: Path, jobs: int
) -> Iterator[tuple[int, int]]:
    predict_maps(suite, model, dataset, folder)
    every = list(units(suite, sizes(suite, dataset)))
    missing = [unit for unit in every if not (folder / "units" / f"{unit.name}.json").exists()]
    done = len(every) - len(missing)
    yield done, len(every)
    # A worker whose memory has grown is replaced; that is no concern of a user's.
    warnings.filterwarnings("ignore", message="A worker stopped while some jobs were given")
    workers = joblib.Parallel(n_jobs=jobs, return_as="generator_unordered")
    for _ in workers(joblib.delayed(run_unit)(suite, unit, folder) for unit in missing):
        done += 1
        yield done, len(every)
    _merge(every, folder)


def check(suite: Suite, dataset: TerrainDataset) -> AnyModel:
    """Refuses a suite that names what is not there, before anything is run or dropped.

    Returns:
        The suite's model.
    """
    settings = [RiskSetting.parse(risk) for risk in suite.risks]
    if len(set(settings)) != len(settings):
        raise ConfigError(f"Expected `risks` that differ, got {list(suite.risks)}.")
    for planner in {*suite.planners, *suite.planner_options}:
        options = {**suite.planner_options.get(planner, {}), **suite.recording_options.get(planner, {})}
        make_planner(planner, options)
    absent = [name for name in suite.scenarios if f"test/{name}" not in dataset.splits]
    if absent:
        there = [name.removeprefix("test/") for name in dataset.splits if name.startswith("test/")]
        raise ConfigError(f"Expected `scenarios` among {there} of {dataset.path}, got {absent}.")
    few = {name: count for name, count in sizes(suite, dataset).items() if count < suite.instances}
    if few:
        raise ConfigError(f"Expected `instances` at most as in the data, {few}, got {suite.instances}.")
    steps_in(SimulationConfig(noise=suite.noise, time_budget_s=suite.time_budget_s), Unicycle())
    return load_model(suite.model)


def sizes(suite: Suite, dataset: TerrainDataset) -> dict[str, int]:
    """Number of instances in each scenario's test split."""
    return {name: dataset.splits[f"test/{name}"]["maps"] for name in suite.scenarios}


def load_run(folder: Path) -> tuple[Suite, dict[str, Any]]:
    """Reads what a run folder is about.

    Returns:
        The suite, and all of `run.json`.

    Raises:
        ConfigError: the folder is no run folder.
    """
    try:
        about = json.loads((folder / "run.json").read_text())
        settings: dict[str, Any] = {
            n: tuple(v) if isinstance(v, list) else v for n, v in about["suite"].items()
        }
        return Suite(**settings), about
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise ConfigError(
            f"Expected a run folder with run.json, got {folder}. Make one with `benchnav-eval run`."
        ) from error


def read_table(folder: Path, name: str) -> pd.DataFrame:
    """Reads a table of a finished run.

    Raises:
        ConfigError: the run is not finished.
    """
    path = folder / name
    if not path.exists():
        raise ConfigError(
            f"Expected a finished run, got {folder} without {name}. Run the same command again to finish it."
        )
    try:
        return pd.read_parquet(path)
    except ValueError as error:
        raise ConfigError(f"{path} is damaged: {error}. Remove it and run the same command again.") from error


def run_unit(suite: Suite, unit: Unit, folder: Path) -> None:
    """Runs one unit on one thread and writes its tables, recordings, and last its `.json` of wall times."""
    torch.set_num_threads(1)
    dataset = TerrainDataset(find_dataset(suite.data))
    problem, episodes, sketches = _simulate(suite, unit, dataset, folder)
    reference = dataset.read(f"test/{unit.scenario}", unit.instances, ["reference_time_s"])[
        "reference_time_s"
    ]
    place = folder / "units"
    _write(place / f"{unit.name}.parquet", episode_table(unit, problem, episodes, reference))
    _write(place / f"{unit.name}.steps.parquet", step_table(unit, problem, episodes))
    for member in range(unit.recorded):
        write_recording(
            _recording(unit, dataset, problem, episodes, member, sketches[member]),
            folder / "playback" / f"{unit.episode_name(member)}.rrd",
        )
        _write_sketches(place / f"{unit.episode_name(member)}.plans.npz", sketches[member])
    steps = int(episodes.steps.max())
    timing = {
        "planner": unit.planner, "risk": unit.risk, "scenario": unit.scenario, "episodes": len(unit.instances),
        "steps": steps, "planning_s": episodes.planning_s,
        "planning_ms_per_step_and_episode": 1e3 * episodes.planning_s / max(steps, 1) / len(unit.instances),
    }  # fmt: skip
    write_text(place / f"{unit.name}.json", json.dumps(timing))


def record_episode(suite: Suite, folder: Path, planner: str, risk: str, scenario: str, instance: int) -> Path:
    """Gives the recording of an episode, running its unit again where it was not recorded.

    Raises:
        ConfigError: the run has no such episode.
        BenchnavError: the unit did not repeat what the run holds.
    """
    dataset = TerrainDataset(find_dataset(suite.data))
    unit = containing(suite, sizes(suite, dataset), planner, risk, scenario, instance)
    member = unit.instances.index(instance)
    path = folder / "playback" / f"{unit.episode_name(member)}.rrd"
    if path.exists():
        return path
    known = read_table(folder, "steps.parquet").query(
        "planner == @planner and risk == @risk and scenario == @scenario and instance == @instance"
    )
    torch.set_num_threads(1)
    problem, episodes, sketches = _simulate(suite, unit, dataset, folder)
    track = episodes.states[member, : int(episodes.steps[member]) + 1, :2].numpy()
    if not np.array_equal(known[["x_m", "y_m"]].to_numpy(np.float32), track):
        raise BenchnavError(
            f"The episode did not repeat: {folder} was made with other versions or on another machine type. "
            "Run the suite again here to replay it."
        )
    write_recording(_recording(unit, dataset, problem, episodes, member, sketches[member]), path)
    return path


def predict_maps(suite: Suite, model: AnyModel, dataset: TerrainDataset, folder: Path) -> None:
    """Predicts λ̂ once for each scenario and risk setting, into `maps/SCENARIO.npz`."""
    for scenario in suite.scenarios:
        if _map_path(folder, scenario).exists():
            continue
        count = min(suite.instances or sizes(suite, dataset)[scenario], sizes(suite, dataset)[scenario])
        mixture = predict(model, dataset.terrain(f"test/{scenario}", range(count)))
        maps = {risk: RiskSetting.parse(risk).apply(mixture).numpy() for risk in suite.risks}
        with replacing(_map_path(folder, scenario)) as partial, open(partial, "wb") as file:
            np.savez_compressed(file, **maps)  # type: ignore[arg-type]


def read_map(folder: Path, scenario: str, risk: str) -> np.ndarray:
    """Reads λ̂ of a scenario's instances under a risk setting, shape [instances, H, W]."""
    with np.load(_map_path(folder, scenario)) as maps:
        return maps[risk]


def _map_path(folder: Path, scenario: str) -> Path:
    return folder / "maps" / f"{scenario.replace('/', '_')}.npz"


def _simulate(
    suite: Suite, unit: Unit, dataset: TerrainDataset, folder: Path
) -> tuple[Problem, Episodes, list[list[PlanSketch]]]:
    split = f"test/{unit.scenario}"
    terrain = dataset.terrain(split, unit.instances)
    places = dataset.read(split, unit.instances, ["start_m", "goal_m"])
    start, goal = torch.from_numpy(places["start_m"]), torch.from_numpy(places["goal_m"])
    threshold = dataset.recipe.stuck_threshold
    config = SimulationConfig(noise=suite.noise, time_budget_s=suite.time_budget_s)
    problem = Problem(
        grid=terrain.grid,
        elevation_m=terrain.elevation_m,
        traversability=torch.from_numpy(read_map(folder, unit.scenario, unit.risk)[list(unit.instances)]),
        dynamics=Unicycle(),
        objective=GoalDistance(stuck_threshold=threshold),
        start=heading_to(start, goal),
        goal_m=goal,
        stuck_threshold=threshold,
        goal_radius_m=config.goal_radius_m,
        time_budget_s=config.time_budget_s,
    )
    # Keyed by scenario and instance alone, so that every planner and setting meets the same luck.
    luck = rng.stream_key(suite.seed, "simulation", split)
    simulation = Simulation(terrain, problem.dynamics, goal, luck, unit.instances, config)
    options = dict(suite.planner_options.get(unit.planner, {}))
    if unit.recorded:
        options |= suite.recording_options.get(unit.planner, {})
    planner = make_planner(unit.planner, options)
    generator = rng.generator(rng.stream_key(suite.seed, "planner", split, unit.instances[0]))
    sketches: list[list[PlanSketch]] = [[] for _ in range(unit.recorded)]

    def watch(step: int, plan: Plan) -> None:
        if step % PLAN_EVERY == 0:
            for member in range(unit.recorded):
                sketches[member].append(_sketch(step, plan, member))

    episodes = run_episodes(planner, problem, simulation, generator, watch if unit.recorded else None)
    # What was planned after an episode's end is not part of it; the first plan is, also one that failed.
    last = (episodes.steps - 1).clamp(min=0).tolist()
    return problem, episodes, [[p for p in plans if p.step <= last[m]] for m, plans in enumerate(sketches)]


def _sketch(step: int, plan: Plan, member: int) -> PlanSketch:
    layers = {name: getattr(plan, name)[member].numpy() for name in ("path", "samples", "reference", "tree")}
    return PlanSketch(step=step, **layers)


def _recording(
    unit: Unit,
    dataset: TerrainDataset,
    problem: Problem,
    episodes: Episodes,
    member: int,
    plans: list[PlanSketch],
) -> Recording:
    steps = int(episodes.steps[member])
    terrain = dataset.terrain(f"test/{unit.scenario}", [unit.instances[member]])
    return Recording(
        title=unit.episode_name(member),
        grid=problem.grid,
        rgb=terrain.rgb[0].numpy(),
        elevation_m=terrain.elevation_m[0].numpy(),
        predicted=problem.traversability[member].numpy(),
        goal_m=problem.goal_m[member].numpy(),
        dt_s=problem.dt_s,
        states=episodes.states[member, : steps + 1].numpy(),
        actions=episodes.actions[member, :steps].numpy(),
        traversability=episodes.traversability[member, :steps].numpy(),
        plans=plans,
    )


def _begin(suite: Suite, dataset: TerrainDataset, folder: Path) -> None:
    """Writes `run.json`, or checks that it is of the same suite on the same data and model."""
    tested = [f"test/{scenario}" for scenario in suite.scenarios]
    about = {
        "suite": suite.to_dict(),
        "dataset": {"id": dataset.id, "splits": {n: dataset.splits[n] for n in tested}},
        "model": _model_digest(suite.model),
        "versions": {name: version(name) for name in PACKAGES} | {"python": platform.python_version()},
        "machine": {"processor": platform.processor() or platform.machine(), "cores": os.cpu_count()},
        "command": shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]),
    }
    path = folder / "run.json"
    if path.exists():
        _, earlier = load_run(folder)
        differing = [
            k
            for k in ("suite", "dataset", "model", "versions")
            if earlier.get(k) != json.loads(json.dumps(about[k]))
        ]
        if differing:
            raise ConfigError(
                f"Expected `out` to be new or an interrupted run of the same suite, but {folder} has another "
                f"{' and '.join(differing)}. Choose another `out`, or pass --overwrite."
            )
        return
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ConfigError(
            f"Expected `out` to be a new folder or a run folder, but {folder} holds something else."
        )
    write_text(path, json.dumps(about, indent=1))


def _model_digest(source: str) -> dict[str, Any]:
    if source in model_names():
        return {"name": source}
    folder = find_checkpoint(source)
    files = sorted(path for path in folder.iterdir() if path.suffix in (".json", ".safetensors"))
    return {"name": source, "files": {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in files}}


def _merge(every: list[Unit], folder: Path) -> None:
    place = folder / "units"
    for name, suffix in (("episodes.parquet", "parquet"), ("steps.parquet", "steps.parquet")):
        tables = [pd.read_parquet(place / f"{unit.name}.{suffix}") for unit in every]
        _write(folder / name, pd.concat(tables, ignore_index=True))
    timing = pd.DataFrame([json.loads((place / f"{unit.name}.json").read_text()) for unit in every])
    write_text(folder / "timing.csv", timing.to_csv(index=False, float_format="%.4g"))


def _write_sketches(path: Path, plans: list[PlanSketch]) -> None:
    """Keeps the plan nearest before the snapshot, which the trajectory figure shows."""
    from benchnav.eval.plots import SNAPSHOT_STEP

    shown = [plan for plan in plans if plan.step <= SNAPSHOT_STEP][-1]
    layers = {name: getattr(shown, name) for name in ("path", "samples", "reference", "tree")}
    with replacing(path) as partial, open(partial, "wb") as file:
        np.savez_compressed(file, step=shown.step, **layers)


def _write(path: Path, table: pd.DataFrame) -> None:
    with replacing(path) as partial:
        table.to_parquet(partial, index=False)
