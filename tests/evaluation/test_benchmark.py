"""Rows, intervals, parallel and resumed runs."""

import json
import re

import numpy as np
import pyarrow.parquet as pq
import pytest

from covis.evaluation import experiments, extras
from covis.evaluation.benchmark import benchmark, plan
from covis.evaluation.datasets import DatasetError, load_dataset
from covis.evaluation.methods import Method
from covis.evaluation.settings import SCENE_NAMES, Settings
from covis.evaluation.statistics import bootstrap_f1
from covis.matching import Matching, PriorRequiredError, registry, reid
from covis.matching.metrics import Counts

METHODS = [Method.parse(m) for m in ("oracle", "hungarian:gate_m=1.5", "reid", "random")]
FIELDS = {
    "target",
    "method",
    "options",
    "pose",
    "preset",
    "frames",
    "pairs",
    "precision",
    "recall",
    "f1",
    "f1_low",
    "f1_high",
    "ece",
    "match_ms",
}


def broken(source, target, *, prior=None, rng=None):
    raise ZeroDivisionError("no")


def out_of_range(source, target, *, prior=None, rng=None):
    return Matching(np.array([[0, len(target)]]), np.ones(1))


def leaves(source, target, *, prior=None, rng=None):
    raise SystemExit(3)


def unsure(source, target, *, prior=None, rng=None):
    return Matching(np.array([[0, 0]]), np.array([np.nan]))


def repeats(source, target, *, prior=None, rng=None):
    return Matching(np.array([[0, 0], [1, 0]]), np.ones(2))


def of_another_kind(source, target, *, prior=None, rng=None):
    return [(0, 0)]


def fails_on_few(source, target, *, prior=None, rng=None):
    if len(source) < 7:
        raise ValueError(f"{len(source)} are too few")
    return reid(source, target)


def scribbles(source, target, *, prior=None, rng=None):
    source.positions[:] = 0.0
    target.attributes[:] = 1.0
    if prior is not None:
        prior.T_source_target[:] = np.eye(4)
    return Matching.empty()


def finds_nothing(source, target, *, prior=None, rng=None):
    return Matching.empty()


def talks(source, target, *, prior=None, rng=None):
    print("hello")
    return Matching.empty()


def without_time(rows):
    return [{k: v for k, v in row.items() if k != "match_ms"} for row in rows]


def own_figures(rows):
    """Without those that compare a method with others."""
    return [
        {k: v for k, v in row.items() if not k.startswith(("f1_minus", "p_value", "ties"))}
        for row in without_time(rows)
    ]


def test_rows_have_the_documented_fields_and_order(small_dataset):
    rows = benchmark([str(small_dataset)], METHODS, Settings(pose="known"))
    assert [row["method"] for row in rows] == ["oracle", "hungarian", "reid", "random"]
    assert all(set(row) >= FIELDS for row in rows)
    oracle, hungarian, reid, random = rows
    assert (oracle["precision"], oracle["recall"], oracle["f1"]) == (1.0, 1.0, 1.0)
    assert hungarian["options"] == {"gate_m": 1.5}
    assert hungarian["f1"] > 0.9
    assert random["f1"] < reid["f1"] + 0.2 < hungarian["f1"]
    assert oracle["pairs"] == oracle["frames"] == 6
    json.dumps(rows, allow_nan=False)


def test_a_method_given_twice_runs_once(small_dataset):
    once = benchmark([str(small_dataset)], METHODS[:1], Settings())
    assert without_time(benchmark([str(small_dataset)] * 2, METHODS[:1] * 2, Settings())) == without_time(once)


def test_min_common_leaves_pairs_out(small_dataset):
    dataset = load_dataset(small_dataset)
    common = []
    for frame in dataset:
        a, b = frame.views
        common.append(len(np.intersect1d(a.identity, b.identity)))
    least = sorted(common)[3]
    (row,) = benchmark([str(small_dataset)], METHODS[:1], Settings(min_common=least))
    assert row["pairs"] == sum(c >= least for c in common)


def test_methods_do_not_disturb_each_other(small_dataset):
    together = benchmark([str(small_dataset)], METHODS, Settings(pose="known"))
    alone = benchmark([str(small_dataset)], METHODS[3:], Settings(pose="known"))
    assert own_figures(together)[3:] == own_figures(alone)


def test_parallel_equals_serial(small_dataset, monkeypatch):
    monkeypatch.setattr(experiments, "FRAMES_PER_UNIT", 2)
    serial = benchmark([str(small_dataset)], METHODS, Settings(pose="known"))
    parallel = benchmark([str(small_dataset)], METHODS, Settings(pose="known"), workers=2)
    assert without_time(serial) == without_time(parallel)


def test_resume_after_an_interruption(small_dataset, tmp_path, monkeypatch):
    monkeypatch.setattr(experiments, "FRAMES_PER_UNIT", 1)
    settings, out = Settings(pose="known"), tmp_path / "run"
    expected = benchmark([str(small_dataset)], METHODS, settings)

    class StoppedError(Exception):
        pass

    def stop(done, total):
        assert total == 2
        if done == 1:
            raise StoppedError

    with pytest.raises(StoppedError):
        benchmark([str(small_dataset)], METHODS, settings, out=out, progress=stop)
    assert len(list((out / "records").glob("*.parquet"))) == 1
    with pytest.raises(FileExistsError, match="give --resume"):
        benchmark([str(small_dataset)], METHODS, settings, out=out)
    seen = []
    rows = benchmark(
        [str(small_dataset)], METHODS, settings, out=out, resume=True, progress=lambda d, t: seen.append(d)
    )
    assert seen[0] == 1
    assert without_time(rows) == without_time(expected)


def test_another_run_in_the_folder_is_not_touched(small_dataset, tmp_path):
    benchmark([str(small_dataset)], METHODS, Settings(pose="known"), out=tmp_path / "run")
    with pytest.raises(FileExistsError, match="other targets, methods or settings"):
        benchmark([str(small_dataset)], METHODS[:1], Settings(), out=tmp_path / "run", resume=True)


def test_a_method_that_needs_a_prior_says_so(small_dataset):
    with pytest.raises(PriorRequiredError, match="hungarian needs a relative pose"):
        benchmark([str(small_dataset)], METHODS[1:2], Settings(pose="unknown"))


def test_known_poses_need_poses(tmp_path, small_dataset):
    table = pq.read_table(small_dataset / "robots.parquet").drop_columns(["pose"])
    pq.write_table(table, small_dataset / "robots.parquet")
    with pytest.raises(DatasetError, match="small, frame 0, robot_0 and robot_1: robot_0 has no pose, so"):
        benchmark([str(small_dataset)], METHODS[:1], Settings(pose="known"))


@pytest.mark.parametrize(
    ("matcher", "message"),
    [
        (broken, "ZeroDivisionError: no"),
        (leaves, "SystemExit: 3"),
        (out_of_range, "pairs name index"),
        (unsure, r"ValueError: scores must lie in \[0, 1\], got \[nan\]"),
        (repeats, "ValueError: pairs repeat an index in column 1"),
        (of_another_kind, "it returned list, not a Matching"),
    ],
)
def test_a_failing_matcher_is_named_and_costs_no_other_its_row(small_dataset, matcher, message, monkeypatch, tmp_path):
    monkeypatch.setattr(experiments, "FRAMES_PER_UNIT", 2)
    sound = benchmark([str(small_dataset)], METHODS[:1], Settings())
    name = f"{__name__}:{matcher.__name__}"
    said = []
    methods = [Method.parse(name), METHODS[0]]
    failed, oracle = benchmark([str(small_dataset)], methods, Settings(), out=tmp_path / "run", complain=said.append)
    assert own_figures([oracle]) == own_figures(sound)
    assert (failed["n_failed"], failed["n_retrieved"], failed["f1"], oracle["n_failed"]) == (6, 0, 0.0, 0)
    (complaint,) = said
    assert re.search(f"method '{name}' on small, frame 0, .*{message}", complaint)
    assert benchmark([str(small_dataset)], methods, Settings(), out=tmp_path / "run", resume=True) == [failed, oracle]


def test_a_matcher_that_fails_now_and_then_counts_where_it_does_not(small_dataset):
    now_and_then, reid = benchmark(
        [str(small_dataset)], [Method.parse(f"{__name__}:fails_on_few"), Method.parse("reid")], Settings()
    )
    assert 0 < now_and_then["n_failed"] < now_and_then["pairs"] == reid["pairs"]
    assert 0 < now_and_then["n_retrieved"] < reid["n_retrieved"]
    assert now_and_then["n_covisible"] == reid["n_covisible"]


def test_a_matcher_that_writes_into_its_input_spoils_no_other(small_dataset):
    first = Method.parse(f"{__name__}:scribbles")
    for settings, others in ((Settings(pose="known"), METHODS[1:3]), (Settings(sequence=True), METHODS[2:3])):
        alone = benchmark([str(small_dataset)], others, settings)
        after = benchmark([str(small_dataset)], [first, *others], settings)[1:]
        assert own_figures(after) == own_figures(alone)


def test_installed_packages_are_looked_through_once(small_dataset, monkeypatch):
    asked = []
    monkeypatch.setattr(registry, "entry_points", lambda group: asked.append(group) or [])
    benchmark([str(small_dataset)], [Method.parse(f"{__name__}:finds_nothing")], Settings())
    assert len(asked) == 1


def test_what_a_matcher_prints_goes_to_standard_error(small_dataset, capsys):
    benchmark([str(small_dataset)], [Method.parse(f"{__name__}:talks")], Settings())
    said = capsys.readouterr()
    assert (said.out, set(said.err.split())) == ("", {"hello"})


def test_an_option_that_a_method_does_not_have_is_found_before_anything_runs(small_dataset, monkeypatch):
    monkeypatch.setattr(experiments, "run_episodes", None)
    for text, message in (
        ("reid:min_similarty=0.5", "reid has no option 'min_similarty'; its options are min_similarity"),
        ("oracle:a=1", "oracle has no option 'a'; it has none"),
    ):
        with pytest.raises(ValueError, match=f"--method '{text}': {message}"):
            benchmark([str(small_dataset)], [Method.parse(text)], Settings())


def test_generated_graphs_by_name_follow_the_seed():
    one, same, other = (
        benchmark(["synthetic-smrc-hard"], METHODS[2:3], Settings(seed=seed, episodes=5))[0] for seed in (5, 5, 6)
    )
    assert (one["target"], one["seeds"], one["pairs"]) == ("synthetic-smrc-hard", [5], 5)
    assert without_time([one]) == without_time([same])
    assert without_time([one]) != without_time([other])


def test_the_true_pose_bounds_what_poses_can_give():
    methods = [Method.parse(text) for text in ("oracle-pose", "bayes", "oracle-pose:min_score=0.99")]
    pose, unknown, strict = benchmark(["synthetic-smrc-hard"], methods, Settings(seed=3, episodes=20))
    assert pose["f1"] > 0.85 > unknown["f1"]
    assert strict["n_retrieved"] < pose["n_retrieved"]
    assert not pose["ties_best"]
    assert unknown["f1_minus_best"] == 0.0


def test_the_true_pose_must_be_known(small_dataset):
    table = pq.read_table(small_dataset / "robots.parquet").drop_columns(["pose_truth"])
    pq.write_table(table, small_dataset / "robots.parquet")
    with pytest.raises(ValueError, match="oracle-pose needs the true poses, which are not known on small, frame 0"):
        benchmark([str(small_dataset)], [Method.parse("oracle-pose")], Settings())


def test_unknown_targets_are_refused():
    with pytest.raises(ValueError, match="target 'nowhere' is neither a dataset folder nor one of connected_driving"):
        benchmark(["nowhere"], METHODS, Settings())


def test_scene_names_are_the_scenes():
    from covis.envs.scenes import SCENES

    assert sorted(SCENE_NAMES) == sorted(SCENES)


@pytest.mark.parametrize(
    ("field", "value"),
    [("pose", "maybe"), ("perception", "psychic"), ("min_common", -1), ("seed", -1), ("episodes", 0)],
)
def test_bad_settings_are_refused(field, value):
    with pytest.raises(ValueError, match=field):
        Settings(**{field: value})


def test_bootstrap_resamples_episodes_not_pairs():
    # Ten pairs each of one good and one bad episode: by pairs the interval would be narrow.
    counts = [Counts(5, 5, 5)] * 10 + [Counts(0, 5, 5)] * 10
    low, high = bootstrap_f1([0] * 10 + [1] * 10, counts)
    assert (low, high) == (0.0, 1.0)
    low, high = bootstrap_f1(list(range(20)), counts)
    assert 0.2 < low < 0.5 < high < 0.8
    assert bootstrap_f1([], []) == (0.0, 0.0)


@pytest.mark.slow
def test_gated_assignment_on_development_data(shared_data):
    """A 7 m gate reaches F1 .88 on carla-v2v with noisy poses."""
    (row,) = benchmark(
        [str(shared_data / "carla-v2v")], [Method.parse("hungarian")], Settings(pose="known", episodes=6)
    )
    assert row["f1"] > 0.8


def test_scenes_need_torch_unless_their_eyes_are_simulated(small_dataset, monkeypatch):
    monkeypatch.setattr(extras, "find_spec", lambda module: None if module == "torch" else module)
    with pytest.raises(extras.MissingExtraError, match=r"torch is missing: install covis\[learned\], .*simulated"):
        plan(["multi_robot"], METHODS, Settings())
    plan(["multi_robot"], METHODS, Settings(perception="simulated"))
    plan([str(small_dataset)], METHODS, Settings())
