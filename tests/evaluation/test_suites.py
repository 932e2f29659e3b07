"""Suites are data, and run; a method of one's own joins them."""

import json
from dataclasses import replace

import numpy as np
import pytest

from covis.evaluation.benchmark import benchmark_suite
from covis.evaluation.comparison import Entry, Ordering, judged
from covis.evaluation.experiments import units_of
from covis.evaluation.methods import EVALUATION_ONLY, Method
from covis.evaluation.settings import SCENE_NAMES
from covis.evaluation.suites import BASELINES, SUITES, TABLE_1, Suite
from covis.evaluation.synthetic import problem_names

NAMES = {
    "paper-table1",
    "paper-fig7",
    "paper-case-study",
    "paper-runtime",
    "matching-synthetic",
    "scaling-robots",
    "quick",
}


def nearest(source, target, *, prior=None, rng=None, count=2):
    from covis.matching import Matching

    k = min(count, len(source), len(target))
    return Matching([[i, i] for i in range(k)], [0.5] * k)


def test_all_suites_are_there():
    assert set(SUITES) == NAMES
    assert not NAMES & set(SCENE_NAMES)
    assert set(BASELINES) < set(EVALUATION_ONLY)


@pytest.mark.parametrize("suite", SUITES.values(), ids=lambda suite: suite.id)
def test_suites_are_complete(suite: Suite):
    assert SUITES[suite.id] is suite
    assert suite.version >= 1
    assert suite.title
    ids = [experiment.id for experiment in suite.experiments]
    assert len(set(ids)) == len(ids)
    for experiment in suite.experiments:
        assert experiment.seeds
        assert len(set(experiment.seeds)) == len(experiment.seeds)
        assert set(BASELINES) < set(experiment.methods)
        for text in experiment.methods:
            Method.parse(text).load()
        known = problem_names() if experiment.kind == "synthetic" else SCENE_NAMES
        assert experiment.target in known
        assert experiment.settings.episodes
    assert units_of(suite.plan())


def test_table_1_is_the_papers():
    suite = SUITES["paper-table1"]
    assert [e.target for e in suite.experiments] == ["connected_driving", "multi_robot", "aerial_ground"]
    for experiment in suite.experiments:
        assert set(experiment.methods) == {*TABLE_1, "bayes", "clipper", "oracle", "random"}
        assert len(TABLE_1) == 9
        assert len(experiment.seeds) == 5
        assert (experiment.settings.pose, experiment.settings.perception) == ("unknown", "learned")


def entry(label, correct):
    sums = {k: np.array([c, 10, 10], dtype=float) for k, c in enumerate(correct)}
    return Entry(Method.parse(label), {"f1": sum(correct) / (10 * len(correct))}, sums)


@pytest.mark.parametrize(
    ("rgm", "verdict"), [([6] * 8, "borne out"), ([2] * 8, "contradicted"), ([4, 6, 3, 5, 5, 3, 4, 5], "open")]
)
def test_an_ordering_is_borne_out_contradicted_or_open(rgm, verdict):
    entries = [entry("mos", [4, 4, 4, 4, 4, 4, 4, 5]), entry("reid", [1] * 8), entry("rgm", rgm)]
    ordering = Ordering("rgm is ahead", ("mos", "reid"), ("rgm",))
    found = judged(ordering, entries)
    assert found["verdict"] == verdict
    assert [(p["higher"], p["lower"]) for p in found["pairs"]] == [("rgm", "mos"), ("rgm", "reid")]
    assert judged(ordering, entries[:1])["verdict"] == "open"


def test_verdicts_are_handed_out_and_kept(small, tmp_path):
    suite = replace(small, experiments=small.experiments[:1], orderings=(Ordering("so", ("random",), ("oracle",)),))
    heard = []
    benchmark_suite(suite, changes={"episodes": 8}, out=tmp_path, judge=heard.extend)
    (verdict,) = heard
    assert (verdict["experiment"], verdict["verdict"]) == ("synthetic-cad-mid", "borne out")
    assert json.loads((tmp_path / "rows.json").read_text())["orderings"] == heard


def test_disturbances_cross_every_method_but_the_baselines():
    suite = SUITES["paper-fig7"]
    (experiment,) = suite.plan(["mine:match:radius=2"])
    methods = [Method.parse(text) for text in experiment.methods]
    assert sum(m.name == "mine:match" for m in methods) == len(suite.disturbances)
    assert [m.label for m in methods if m.name in BASELINES] == list(BASELINES)
    rates = {m.disturbance.position_uncertainty for m in methods}
    assert {0.0, 0.15} <= rates


@pytest.fixture(scope="module")
def small():
    """The generated part of two suites, with a method of one's own under a disturbance as well."""
    experiments = (SUITES["quick"].experiments[-1], SUITES["matching-synthetic"].experiments[3])
    return Suite("small", 3, "a test", experiments, ("", "@position_noise=1"))


@pytest.fixture(scope="module")
def rows(small):
    return benchmark_suite(small, [Method.parse(f"{__name__}:nearest:count=3")], {"episodes": 6})


def test_rows_say_where_they_come_from(rows):
    json.dumps(rows, allow_nan=False)
    for row in rows:
        assert (row["suite"], row["suite_version"]) == ("small", 3)
        assert row["perception"] is row["renderer"] is None
        assert row["pairs"] == row["episodes"] == 6
        assert row["seeds"] == [row["seed"]]
        assert row["versions"]["numpy"]
        assert "commit" in row
    assert {row["experiment"] for row in rows} == {"synthetic-cad-mid", "synthetic-cad-mixed"}


def test_an_own_method_is_in_every_experiment_and_disturbance(rows):
    own = [row for row in rows if row["method"] == f"{__name__}:nearest"]
    assert len(own) == 4
    assert all(row["options"] == {"count": 3} for row in own)
    assert [row["disturbance"] for row in own] == [{}, {"position_noise": 1}] * 2


def test_rows_compare_with_bayes_with_the_best_and_with_themselves_undisturbed(rows):
    first = [row for row in rows if row["experiment"] == "synthetic-cad-mid"]
    by_label = {(row["method"], bool(row["disturbance"])): row for row in first}
    bayes, rgm, noisy = by_label["bayes", False], by_label["rgm", False], by_label["bayes", True]
    assert bayes["f1_minus_bayes"] == 0.0
    assert rgm["f1_minus_bayes"] == pytest.approx(rgm["f1"] - bayes["f1"])
    assert rgm["f1_minus_bayes_low"] <= rgm["f1_minus_bayes"] <= rgm["f1_minus_bayes_high"]
    assert 0 < rgm["p_value"] <= 1
    assert noisy["f1_minus_undisturbed"] == pytest.approx(noisy["f1"] - bayes["f1"])
    assert noisy["f1_minus_undisturbed"] < 0
    oracle = by_label["oracle", False]
    assert oracle["f1_minus_best"] > 0
    assert oracle["ties_best"] is False


def test_quick_runs_from_scenes_to_rows(tmp_path):
    rows = benchmark_suite(SUITES["quick"], changes={"episodes": 1}, out=tmp_path)
    scenes = [row for row in rows if row["renderer"]]
    assert {row["target"] for row in scenes} == {"multi_robot", "aerial_ground"}
    assert all(row["perception"] == "simulated" and row["preset"] == "easy" for row in scenes)
    assert json.loads((tmp_path / "rows.json").read_text())["rows"] == rows
