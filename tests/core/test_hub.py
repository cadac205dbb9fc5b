"""Datasets and checkpoints of a hub are downloaded by name and revision, from a server that speaks as the hub does."""

import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pandas as pd
import pytest
from huggingface_hub import constants

from benchnav.core import hub
from benchnav.datagen.files.reader import TerrainDataset
from benchnav.models import find_checkpoint
from benchnav.models.checkpoint import load_checkpoint
from benchnav.models.training.data import training_digest
from tests.commands import call

COMMIT = "a" * 40


class Hub(BaseHTTPRequestHandler):
    """Answers what `snapshot_download` asks of a hub: revisions, trees and files."""

    protocol_version = "HTTP/1.1"
    repos: dict[str, Path]
    asked: list[str]

    def do_HEAD(self) -> None:
        self.do_GET()

    def do_GET(self) -> None:
        self.asked.append(self.path)
        path = self.path.partition("?")[0]
        if found := re.fullmatch(
            r"/api/(models|datasets)/([^/]+/[^/]+)/(revision|tree)/([^/]+)", path
        ):
            return self._about(found[1], found[2], found[3], found[4])
        if found := re.fullmatch(
            r"/(datasets/)?([^/]+/[^/]+)/resolve/([^/]+)/(.+)", path
        ):
            return self._file(
                f"{'datasets' if found[1] else 'models'}/{found[2]}", found[4]
            )
        return self._answer(404, b"", {})

    def _about(self, kind: str, name: str, what: str, revision: str) -> None:
        folder = self.repos.get(f"{kind}/{name}")
        if folder is None:
            return self._answer(404, b"{}", {"X-Error-Code": "RepoNotFound"})
        if revision not in ("main", COMMIT):
            return self._answer(404, b"{}", {"X-Error-Code": "RevisionNotFound"})
        files = sorted(path for path in folder.iterdir() if path.is_file())
        siblings = [{"rfilename": path.name} for path in files]
        tree = [
            {
                "type": "file",
                "path": path.name,
                "size": path.stat().st_size,
                "oid": digest(path),
            }
            for path in files
        ]
        about = {
            "id": name,
            "sha": COMMIT,
            "siblings": siblings,
            "tags": [],
            "private": False,
        }
        return self._answer(
            200, json.dumps(tree if what == "tree" else about).encode(), {}
        )

    def _file(self, repo: str, name: str) -> None:
        path = self.repos[repo] / name
        if not path.is_file():
            return self._answer(404, b"", {"X-Error-Code": "EntryNotFound"})
        return self._answer(
            200,
            path.read_bytes(),
            {"ETag": f'"{digest(path)}"', "X-Repo-Commit": COMMIT},
        )

    def _answer(self, status: int, content: bytes, headers: dict[str, str]) -> None:
        self.send_response(status)
        for key, value in {
            "Content-Length": str(len(content)),
            "Content-Type": "application/json",
            **headers,
        }.items():
            self.send_header(key, value)
        self.end_headers()
        if self.command == "GET":
            self.wfile.write(content)

    def log_message(self, *words: object) -> None:
        """Says nothing."""


def digest(path: Path) -> str:
    return hashlib.sha1(path.read_bytes()).hexdigest()


@pytest.fixture
def server(tmp_path: Path) -> Iterator[tuple[str, type[Hub]]]:
    """A hub without repositories."""
    handler = type("OneHub", (Hub,), {"repos": {}, "asked": []})
    serving = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=serving.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{serving.server_port}", handler
    serving.shutdown()


def run(
    folder: Path, command: str, *words: object, **environment: str
) -> subprocess.CompletedProcess[str]:
    """Runs a command with a cache of its own."""
    place = f"import sys; sys.argv[0] = {command!r}; from benchnav.{PACKAGES[command]}.cli import main; main()"
    settings = {
        **os.environ,
        "HF_HOME": str(folder / "hf"),
        "HF_HUB_DISABLE_XET": "1",
        **environment,
    }
    settings.pop("HF_HUB_CACHE", None)
    return subprocess.run(
        [sys.executable, "-c", place, *map(str, words)],
        cwd=folder, env=settings, capture_output=True, text=True, timeout=300,
    )  # fmt: skip


PACKAGES = {"benchnav-datagen": "datagen", "benchnav-train": "models"}


def test_a_dataset_is_downloaded_once_and_read_without_a_connection(
    server: tuple[str, type[Hub]], dataset_path: Path, tmp_path: Path
) -> None:
    address, handler = server
    repo = tmp_path / "repo"
    repo.mkdir()
    shutil.copy(dataset_path, repo / "maps.h5")
    (repo / "evil.py").write_text("raise SystemExit(7)")
    handler.repos["datasets/me/ground"] = repo
    done = run(
        tmp_path, "benchnav-datagen", "show", "me/ground@main", HF_ENDPOINT=address
    )
    assert done.returncode == 0, done.stderr
    assert f"me/ground@main is commit {COMMIT} now and may change" in done.stderr
    # data alone is downloaded
    assert not any("evil.py" in path for path in handler.asked)
    local = run(tmp_path, "benchnav-datagen", "show", str(dataset_path))
    assert done.stdout.splitlines()[1:] == local.stdout.splitlines()[1:]
    handler.asked.clear()
    again = run(
        tmp_path, "benchnav-datagen", "show", f"me/ground@{COMMIT}", HF_ENDPOINT=address
    )
    assert (again.returncode, again.stdout, again.stderr, handler.asked) == (
        0,
        done.stdout,
        "",
        [],
    )
    offline = run(
        tmp_path, "benchnav-datagen", "show", "me/ground@main", HF_HUB_OFFLINE="1"
    )
    assert (offline.returncode, offline.stdout) == (0, done.stdout)


def test_what_a_hub_lacks_is_one_line(
    server: tuple[str, type[Hub]], tmp_path: Path
) -> None:
    address, handler = server
    handler.repos["datasets/me/empty"] = tmp_path / "empty"
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "README.md").write_text("nothing")
    cases = {
        "me/none@main": "does not exist or is private",
        "me/empty@v9": "got 'v9', which does not exist",
        "me/empty@main": "got 0 .h5 files",
    }
    for name, said in cases.items():
        done = run(tmp_path, "benchnav-datagen", "show", name, HF_ENDPOINT=address)
        assert done.returncode == 2
        assert said in done.stderr
        assert "Traceback" not in done.stderr
    offline = run(
        tmp_path, "benchnav-datagen", "show", "me/none@main", HF_HUB_OFFLINE="1"
    )
    assert offline.returncode == 2
    assert (
        "Try again with a network connection, or name a local folder." in offline.stderr
    )


FIND = """
import os, shutil, sys
from contextlib import suppress
from urllib.error import HTTPError
from urllib.request import urlopen

from benchnav.core import hub
from benchnav.models import find_checkpoint, load_model
from benchnav.models.checkpoint import digests_of

def find(address):
    hub.download.cache_clear()  # as a process does that has found none before
    folder = find_checkpoint(address)
    load_model(address)
    assert digests_of(folder) == digests_of(find_checkpoint(sys.argv[1]))
    return folder

folder = find(sys.argv[2])
print(folder)
if len(sys.argv) > 3:
    (folder / "gp.safetensors").unlink()  # as a download leaves it that was cut short
    shutil.rmtree(folder.parents[1] / "trees")  # of what there is, which not every version keeps
    print(find(sys.argv[3]))
    with suppress(HTTPError):
        urlopen(os.environ["HF_ENDPOINT"] + "/whole")  # tells the server that what follows asks nothing
    print(find(sys.argv[3]))
"""


def test_a_checkpoint_is_downloaded_and_what_is_here_goes_first(
    server: tuple[str, type[Hub]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    address, handler = server
    shipped = Path(__file__).parents[2] / "checkpoints" / "stakes-v1"
    handler.repos["models/me/stakes"] = shipped
    settings = {
        "HF_HOME": str(tmp_path / "hf"),
        "HF_ENDPOINT": address,
        "HF_HUB_DISABLE_XET": "1",
    }

    moves, stays = "me/stakes@main", f"me/stakes@{COMMIT}"
    done = subprocess.run(
        [sys.executable, "-c", FIND, str(shipped), moves, stays],
        cwd=tmp_path, env={**os.environ, **settings}, capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    folder, *again = done.stdout.split()
    assert again == [folder, folder]
    assert Path(folder).name == COMMIT
    for name in ("ground.json", "gp.safetensors"):
        assert Path(folder, name).read_bytes() == (shipped / name).read_bytes()
    assert handler.asked[-1] == "/whole"
    monkeypatch.chdir(tmp_path)
    Path("me").mkdir()
    shutil.copytree(shipped, Path("me", "stakes@main"))
    assert str(find_checkpoint(moves)) == moves


def test_addresses_go_through_training_measures_and_suites(
    dataset_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By a cache that was filled before; what is found is what local files give."""
    monkeypatch.chdir(tmp_path)
    hub.download.cache_clear()
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / "cache"))  # for other processes
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
    ground, network = (
        tmp_path / "cache" / name / "snapshots" / COMMIT
        for name in ("datasets--me--ground", "models--me--net")
    )
    ground.mkdir(parents=True)
    shutil.copy(dataset_path, ground / "maps.h5")
    small = (
        "--settings.encoder_depth",
        1,
        "--settings.hidden",
        8,
        "--settings.max_epochs",
        1,
    )
    trained = (
        "fit",
        "mean_variance",
        "--out",
        "net",
        *small,
        "--device",
        "cpu",
        "--trainer.precision",
        "32-true",
    )
    assert call("train", *trained, "--data", f"me/ground@{COMMIT}") == 0
    shutil.copytree("net", network)
    kept = load_checkpoint("net").part("mean_variance")
    assert kept.data_digest == training_digest(TerrainDataset(dataset_path))

    shown = ("--splits", "[test/std]", "--json")
    task = (
        "--planners",
        "[{part: mppi, options: {samples: 32}}]",
        "--risks",
        "[mean]",
        "--scenarios",
        "[std]",
    )
    task += ("--maps", 2, "--world.time_budget_s", 3, "--record", "none")
    found = {}
    for name, model, data in (
        ("here", "net", dataset_path), ("hub", f"me/net@{COMMIT}", f"me/ground@{COMMIT}"),
    ):  # fmt: skip
        assert (
            call("train", "evaluate", model, "--data", data, *shown, f"{name}.json")
            == 0
        )
        assert (
            call("eval", "run", "--model", model, "--data", data, *task, "--out", name)
            == 0
        )
        report = json.loads(Path(f"{name}.json").read_text())
        rows = pd.read_parquet(tmp_path / name / "episodes.parquet")
        drawn = ["map", "outcome", "end_time_s", "traversability", "path_length_m"]
        found[name] = (
            report["splits"]["test/std"]["crps"],
            rows[drawn].to_dict("list"),
            set(rows["model"]),
        )
    assert found["hub"][:2] == found["here"][:2]
    assert (found["here"][2], found["hub"][2]) == ({"net"}, {f"net@{COMMIT}"})
    about = (tmp_path / "hub" / "run.json").read_text()
    assert f"me/net@{COMMIT}" in about
    assert f"me/ground@{COMMIT}" in about


def test_only_names_with_a_revision_are_of_a_hub() -> None:
    assert hub.is_address("me/ground@v1.0")
    for source in (
        "me/ground",
        "checkpoints/mine",
        "model.py:Name@me/ground",
        "a/b/c@main",
        "me/ground@",
        "/a@b",
    ):
        assert not hub.is_address(source)
