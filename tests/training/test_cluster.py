"""Work on a Ray cluster of two nodes is the same work, whatever dies while it is done."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner
from units import Unit

from coloc_env.scenarios import make_scenario
from training import pool
from training.cli.command import app
from training.cluster import connected
from training.evaluation.evaluate import evaluate, silent
from training.learning.run import start
from training.reproduce.results import Results
from training.reproduce.settings import Settings
from training.reproduce.study import Part, Study, reproduce
from training.reproduce.work import WORLD, Cell, Variant
from training.units import WorkerDied

STORE = 80 * 2**20  # bytes of a node's object store: Ray's least, nearly
AGENTS = ("ekf", "pf500", "dead_reckoning")


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """Two nodes of a CPU each on this machine; the second may be replaced."""
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    paths = [str(Path(__file__).parent), str(Path(__file__).parents[2])]
    before = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join([*paths, *filter(None, [before])])
    node = {"num_cpus": 1, "object_store_memory": STORE}
    made = Cluster(initialize_head=True, head_node_args=node)
    made.second = made.add_node(**node)
    try:
        with connected(made.address):  # once, so that workers start once
            yield made
    finally:
        made.shutdown()
        os.environ.pop("PYTHONPATH")
        if before is not None:
            os.environ["PYTHONPATH"] = before


def workers(cluster: Any) -> pool.Workers:
    return pool.Workers(ray=cluster.address)


@pytest.mark.slow
def test_an_evaluation_is_the_same_to_the_last_bit(cluster: Any) -> None:
    scenario = make_scenario("indoor-v0", n_uavs=3, horizon=15)
    bars: dict[str, list[tuple[int, int]]] = {}

    def progress(what: str, done: int, total: int) -> None:
        bars.setdefault(what, []).append((done, total))

    alone = evaluate(scenario, AGENTS, 4, 7, chunk=1)
    spread = evaluate(scenario, AGENTS, 4, 7, progress, chunk=1, workers=workers(cluster))
    assert spread.errors == alone.errors == {}
    assert alone.bound is not None
    assert spread.bound is not None
    np.testing.assert_array_equal(spread.bound.mse, alone.bound.mse)
    for name in AGENTS:
        one, other = spread.agents[name], alone.agents[name]
        for field in ("offset", "error", "nees", "broken", "covariance"):
            np.testing.assert_array_equal(getattr(one, field), getattr(other, field))
        np.testing.assert_array_equal(one.worlds.truth, other.worlds.truth)
        for key, series in other.series.items():
            np.testing.assert_array_equal(one.series[key], series)
        assert bars[name][-1] == (4 * 15, 4 * 15)


@pytest.mark.slow
def test_a_study_whose_node_is_killed_loses_nothing(cluster: Any, tmp_path: Path) -> None:
    variant = Variant("small", "small", (("n_uavs", 2),), steps=100)
    cells = [Cell(variant, ("ekf", "pf500"), runs) for runs in (2, 4)]
    study = Study("small", "SMALL", "nowhere", 5, {"own": Part("A part", lambda settings: cells)})

    def run(out: Path, who: pool.Workers, killing: bool = False) -> tuple[Results, list[str]]:
        lines: list[str] = []
        seen: list[int] = []

        def progress(what: str, done: int, total: int) -> None:
            if killing and 0 < done < total and cluster.second is not None:
                cluster.remove_node(cluster.second, allow_graceful=False)
                cluster.second = None
            seen.append(done)

        settings = Settings(out, 5, seed=5, workers=who)
        reproduce(study, settings, progress, lines.append)
        assert not seen or seen[-1] == 4 * 100 * 3
        found = Results(Settings(out, 5, seed=5), cells, cells)
        found.pieces()
        return found, lines

    alone, _ = run(tmp_path / "alone", pool.ALONE)
    spread, lines = run(tmp_path / "spread", workers(cluster), killing=True)
    assert cluster.second is None
    assert len(lines) == 6
    assert not any("failed" in line for line in lines)
    for agent in (WORLD, "ekf", "pf500"):
        one, other = (results["small", agent].record for results in (spread, alone))
        np.testing.assert_array_equal(one.offset, other.offset)
        np.testing.assert_array_equal(one.nees, other.nees)
    assert run(tmp_path / "spread", workers(cluster))[1] == []  # what is stored is not run again
    cluster.second = cluster.add_node(num_cpus=1, object_store_memory=STORE)


@pytest.mark.slow
def test_rollouts_of_a_training_end_in_the_same_weights(cluster: Any, tmp_path: Path) -> None:
    chosen = {
        "scenario": "wsn-v0:horizon=30",
        "variants": "case=1/q=0.0036:believed_uwb_std=0.04",
        "mains": "pf:particles=60/ekf",
        "worlds": 1,
        "epochs": 2,
        "score_runs": 0,
    }
    alone = start("nnhpff", chosen, tmp_path / "alone", silent)
    spread = start("nnhpff", chosen, tmp_path / "spread", silent, workers(cluster))
    assert spread.read_bytes() == alone.read_bytes()


@pytest.mark.slow
def test_workers_and_nodes_that_die_are_replaced(cluster: Any, tmp_path: Path) -> None:
    slow = [Unit(tmp_path, f"slow{i}", seconds=8.0) for i in range(2)]
    units = [*slow, Unit(tmp_path, "once", kills=1), Unit(tmp_path, "raises", raises=True)]
    units += [Unit(tmp_path, "always", kills=99)]
    done = dict.fromkeys(units, 0)

    def progress(unit: Unit, size: int) -> None:
        done[unit] += size
        running = all(list(tmp_path.glob(f"{one.name}.try-*")) for one in slow)
        if running and cluster.second is not None:  # one on each node
            cluster.remove_node(cluster.second, allow_graceful=False)
            cluster.second = None

    found = {one.unit.name: one for one in pool.work(units, workers(cluster), progress)}
    assert found.keys() == {unit.name for unit in units}
    assert isinstance(found["always"].error, WorkerDied)
    assert "\n" not in str(found["always"].error)
    assert isinstance(found["raises"].error, ZeroDivisionError)
    assert found["once"].error is None
    assert all(found[unit.name].result == unit.name for unit in slow)
    assert all(done[unit] == unit.size for unit in units)
    assert cluster.second is None
    assert len(list(tmp_path.glob("slow*.try-*"))) == 3  # one was lost with its node
    assert len(list(tmp_path.glob("once.try-*"))) == 2


_DEAD = """
import sys, threading, time
from pathlib import Path
from ray.cluster_utils import Cluster
from units import Unit
from training import cluster, pool

cluster._GONE = 2.0
made = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
units = [Unit(Path(sys.argv[1]), str(i), seconds=600.0) for i in range(2)]

def kill():
    while not list(Path(sys.argv[1]).glob("*.try-*")):
        time.sleep(0.2)
    made.head_node.kill_gcs_server()

threading.Thread(target=kill, daemon=True).start()
try:
    list(pool.work(units, pool.Workers(ray=made.address), lambda unit, size: None))
except ConnectionError as error:
    print(f"said: {error}", flush=True)
finally:
    made.head_node.kill_all_processes(check_alive=False, allow_graceful=False)
"""


@pytest.mark.slow
def test_a_cluster_that_dies_is_said_to_be_dead(tmp_path: Path) -> None:
    pytest.importorskip("ray")
    here = Path(__file__)
    path = os.pathsep.join([str(here.parent), str(here.parents[2])])
    done = subprocess.run(
        [sys.executable, "-c", _DEAD, str(tmp_path)],
        env=os.environ | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert "said: the Ray cluster at " in done.stdout, done.stderr[-2000:]
    assert "run the command again" in done.stdout


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of libraries, as Python hides them
@pytest.mark.parametrize(
    ("address", "words"),
    [
        ("nonsense", "auto, or HOST:PORT"),
        ("127.0.0.1:x", "auto, or HOST:PORT"),
        ("127.0.0.1:1", "nobody answers there; `ray start --head`"),
    ],
)
@pytest.mark.parametrize("command", ["evaluate", "reproduce", "train", "bench"])
def test_an_address_without_a_cluster(
    command: str, address: str, words: str, tmp_path: Path
) -> None:
    pytest.importorskip("ray")
    said = _one_line(command, address, tmp_path)
    assert said.startswith(f"error: --ray {address}")
    assert words in said


def test_ray_that_is_not_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    said = _one_line("evaluate", "auto", tmp_path)
    assert said == "error: --ray needs Ray: pip install 'coloc-env[ray]'\n"


def _one_line(command: str, address: str, folder: Path) -> str:
    what = {"evaluate": ["indoor-v0", "--agents", "ekf"], "reproduce": ["cspf"], "bench": []}
    words = [
        command,
        *what.get(command, ["nnhpff"]),
        "--out",
        str(folder / "out"),
        "--ray",
        address,
    ]
    done = CliRunner().invoke(app, words)
    assert (done.exit_code, done.stdout) == (2, "")
    assert done.stderr.count("\n") == 1
    assert not (folder / "out").exists()
    return done.stderr


def test_a_training_that_learns_between_batches_is_not_spread(tmp_path: Path) -> None:
    words = ["train", "trust", "--out", str(tmp_path / "out"), "--jobs", "2"]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 2
    assert done.stderr.startswith("error: trust learns while its episodes run")
    assert not (tmp_path / "out").exists()
