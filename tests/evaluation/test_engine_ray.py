"""Units on a Ray cluster of two nodes: the same results, bit for bit, when a worker and a node are lost half way."""

from dataclasses import replace

import pyarrow.parquet as pq
import pytest

from covis.evaluation import engine_ray, experiments, extras
from covis.evaluation.benchmark import benchmark
from covis.evaluation.executors import Done, RunOne
from covis.evaluation.extras import MissingExtraError
from covis.evaluation.methods import Method
from covis.evaluation.settings import Settings

ray = pytest.importorskip("ray", reason="the Ray engine needs covis[ray]")
from ray.cluster_utils import Cluster  # noqa: E402

METHODS = ("bayes", "rgm", "random")

MORTAL = '''
"""A matcher that kills its worker the first time it is asked."""

import os
import signal
from pathlib import Path

from covis.matching import reid


def match(source, target, *, prior=None, rng=None, victim=""):
    try:
        Path(victim).touch(exist_ok=False)
    except FileExistsError:
        return reid(source, target, prior=prior, rng=rng)
    os.kill(os.getpid(), signal.SIGKILL)
'''


@pytest.fixture
def cluster(monkeypatch):
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    cluster = two_nodes()
    yield cluster
    ray.shutdown()
    cluster.shutdown()


def two_nodes(attempts=3):
    """A cluster; Ray gives a node 30 s to come up, which a busy machine may need."""
    node = {"num_cpus": 1, "object_store_memory": 100_000_000, "include_dashboard": False}
    cluster = Cluster()
    try:
        cluster.add_node(**node)
        cluster.second = cluster.add_node(**node)
        cluster.wait_for_nodes()
    except Exception as error:
        cluster.shutdown()
        if attempts == 1 or "timed out during startup" not in str(error):
            raise
        return two_nodes(attempts - 1)
    return cluster


@pytest.fixture
def data(dataset_writer, tmp_path, monkeypatch):
    monkeypatch.setattr(experiments, "FRAMES_PER_UNIT", 3)
    return str(dataset_writer(tmp_path / "data", n_frames=36))


def without_times(rows):
    return [{key: value for key, value in row.items() if key != "match_ms"} for row in rows]


def shards(out):
    files = sorted((out / "records").iterdir())
    assert len(files) == 12
    return [pq.read_table(file).drop_columns("match_ms").to_pylist() for file in files]


@pytest.mark.slow
def test_a_lost_worker_and_a_lost_node_change_nothing(cluster, data, tmp_path, monkeypatch):
    (tmp_path / "mortal.py").write_text(MORTAL)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)  # Ray shows its workers the folder a run is started in
    victim = tmp_path / "killed"
    methods = [Method.parse(text) for text in (*METHODS, f"mortal:match:victim={victim}")]
    seen = []

    def watch(done, total):
        seen.append((done, total))
        if done == total // 2 and cluster.second is not None:
            cluster.remove_node(cluster.second, allow_graceful=False)
            cluster.second = None

    rows = benchmark(
        [data],
        methods,
        Settings(),
        engine="ray",
        ray_address=cluster.address,
        out=tmp_path / "ray",
        progress=watch,
    )
    assert victim.exists()
    assert cluster.second is None
    assert seen == [(done, 12) for done in range(13)]
    serial = benchmark([data], methods, Settings(), out=tmp_path / "serial")
    assert without_times(rows) == without_times(serial)
    assert shards(tmp_path / "ray") == shards(tmp_path / "serial")


def test_nodes_with_other_versions_are_refused():
    with pytest.raises(RuntimeError, match=r"would give other results: it has numpy .* instead of 1\.0"):
        engine_ray._run_there(lambda number: pytest.fail("ran"), 0, engine_ray._versions() | {"numpy": "1.0"})


def test_a_node_without_the_dataset_is_named(data, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    here = experiments.Experiment("data", "dataset", "data", ("reid",), Settings(), (0,))
    units = tuple(replace(unit, experiment=experiments.absolute(here)) for unit in experiments.units_of([here]))
    assert isinstance(engine_ray._run_there(RunOne(units), 1, engine_ray._versions()), Done)
    (tmp_path / "data").rename(tmp_path / "elsewhere")
    message = rf"node .* has no dataset folder {tmp_path}/data: put it there under the same path on every node"
    with pytest.raises(RuntimeError, match=message):
        engine_ray._run_there(RunOne(units), 1, engine_ray._versions())


def test_without_ray_the_extra_is_named(monkeypatch):
    monkeypatch.setattr(extras, "find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match=r"ray is missing: install covis\[ray\]"):
        engine_ray.ray_executor()


def test_an_address_without_a_cluster_is_said_at_once(data):
    with pytest.raises(RuntimeError, match=r"no Ray cluster at 127.0.0.1:1: .*refused"):
        benchmark([data], [Method.parse("reid")], Settings(), engine="ray", ray_address="127.0.0.1:1")
