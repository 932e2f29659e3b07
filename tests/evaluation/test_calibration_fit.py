"""Fitting how far `bayes` trusts its evidence: known damping comes back, halves are apart, the command prints both."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from covis.evaluation.calibration_fit import (
    PairEvidence,
    collect,
    emitted,
    entries,
    fit,
    fittable,
    halves,
    monotone_bound,
    objective,
    probabilities,
    refit,
)
from covis.evaluation.synthetic import frames
from covis.matching import bayes
from covis.matching.bayes_calibration import CALIBRATIONS, Calibration, Evidence, calibrated
from covis.matching.bayes_overlap import N_FEATURES
from covis.matching.metrics import expected_calibration_error
from covis.scripts.main import app

TRUE = Calibration(0.3 * np.eye(N_FEATURES)[0], np.array([0, 0.5, 0, 0, 0]), np.array([-0.5, 0.4, 0, 0, 0]), 0.4)


def pairs(number: int, rng: np.random.Generator, target: str = "made") -> list[PairEvidence]:
    """Pairs whose right mode is drawn as TRUE says: of three modes, each four certain matches, or none of them."""
    out = []
    for group in range(number):
        modes = np.zeros((3, N_FEATURES))
        modes[:, 0] = rng.uniform(-10, 15, 3)
        evidence = Evidence(modes, np.array([1.0, rng.uniform(-1.5, 1.5), 0, 0, 0]))
        marginals = np.zeros((3, 4, 12))
        for k in range(3):
            marginals[k, np.arange(4), 4 * k + np.arange(4)] = 1.0
        odds = np.append(np.exp(calibrated(evidence, TRUE)), 1.0)
        right = rng.choice(4, p=odds / odds.sum())
        truth = marginals[right] > 0 if right < 3 else np.zeros((4, 12), dtype=bool)
        out.append(PairEvidence(target, group, "unseen", evidence, marginals, truth))
    return out


def flat(x: Calibration) -> np.ndarray:
    return np.concatenate([x.terms, x.damping, x.offset])


def test_gradient_is_that_of_the_objective():
    rng = np.random.default_rng(0)
    x = entries(pairs(20, rng), {"made": 2.0})
    theta = flat(TRUE) + 0.1 * rng.standard_normal(len(flat(TRUE)))
    _, gradient = objective(theta, x)
    for i, step in enumerate(1e-6 * np.eye(len(theta))):
        slope = (objective(theta + step, x)[0] - objective(theta - step, x)[0]) / 2e-6
        np.testing.assert_allclose(gradient[i], slope, atol=1e-5)


def test_a_known_damping_comes_back_and_makes_scores_honest():
    drawn = pairs(1500, np.random.default_rng(1))
    fitted = fit(drawn)
    np.testing.assert_allclose(fitted.terms[0], TRUE.terms[0], atol=0.05)
    np.testing.assert_allclose(fitted.damping[1], TRUE.damping[1], atol=0.15)
    np.testing.assert_allclose(fitted.offset[:2], TRUE.offset[:2], atol=0.3)
    x = entries(drawn, {})
    assert objective(flat(fitted), x)[0] <= objective(flat(TRUE), x)[0]
    assert objective(flat(TRUE), x)[0] < objective(flat(CALIBRATIONS["whole"]), x)[0] - 0.5
    fresh = pairs(1500, np.random.default_rng(2))
    errors = [expected_calibration_error(*emitted(fresh, c)[:2]) for c in (fitted, CALIBRATIONS["whole"])]
    assert errors[0] < 0.02 < 0.1 < errors[1]


def test_probabilities_are_those_of_bayes():
    (frame,) = frames("smrc-hard", 3, [0])
    a, b = frame.views
    (pair,) = collect("synthetic-smrc-hard", "fields", frames=1, seed=3)
    assert pair.kind == "fields"
    assert collect("synthetic-smrc-hard", "unseen", frames=1, seed=3)[0].kind == "unseen"
    found = bayes(a.graph, b.graph)
    np.testing.assert_allclose(
        probabilities(pair, CALIBRATIONS[pair.kind]), found.diagnostics["probabilities"], atol=1e-12
    )
    scores, right, common = emitted([pair], CALIBRATIONS[pair.kind])
    kept = scores >= CALIBRATIONS[pair.kind].min_score
    np.testing.assert_allclose(scores[kept], found.scores, atol=1e-12)
    identical = a.identity[found.pairs[:, 0]] == b.identity[found.pairs[:, 1]]
    np.testing.assert_array_equal(right[kept], identical)
    assert common == len(np.intersect1d(a.identity, b.identity))


def test_halves_keep_episodes_together():
    made = [replace(pair, group=pair.group // 5) for pair in pairs(50, np.random.default_rng(3))]
    first, second = halves(made, 0)
    assert len(first) == len(second) == 25
    assert not {pair.group for pair in first} & {pair.group for pair in second}


def test_refit_compares_and_refuses_what_is_not_there():
    made = pairs(200, np.random.default_rng(4)) + pairs(100, np.random.default_rng(5), "other")
    found = refit("unseen", [*made, replace(made[0], kind="eyes")], {"other": 2.0})
    assert found.left_out == 1
    assert [row["target"] for row in found.rows] == ["made", "other"]
    for row in found.rows:
        assert max(row["fitted_ece"], row["halves_ece"]) < row["whole_ece"]
    assert abs(found.fitted.min_score - 0.5 * np.mean([row["fitted_f1"] for row in found.rows])) < 0.02
    with pytest.raises(ValueError, match="no pair of views is of the kind 'fields'"):
        refit("fields", made)
    with pytest.raises(ValueError, match="a weight for 'elsewhere'"):
        refit("unseen", made, {"elsewhere": 2.0})


def test_bound_of_sets_that_contradict_each_other():
    """Where equal scores are right in .9 of one set and in .5 of the other, the best map is .2 away from both."""
    rng = np.random.default_rng(6)
    scores = rng.uniform(0.4, 1, 20000)
    right, doubtful = (rng.random(20000) < share for share in (0.9, 0.5))
    assert 0.17 < monotone_bound([(scores, right), (scores, doubtful)]) <= 0.205
    assert monotone_bound([(scores, right), (scores, right)]) < 0.005
    assert monotone_bound([(scores, rng.random(20000) < scores**3)]) < 0.01
    assert monotone_bound([]) == 0.0


def test_command(tmp_path):
    run = CliRunner().invoke
    out = run(
        app,
        ["train", "calibration", "fields", "synthetic-cad-hard", "synthetic-cad-mid"]
        + ["--frames", "12", "--weight", "*-mid=2", "--json", str(tmp_path / "fit.json")],
    )
    assert out.exit_code == 0, out.output
    assert {"synthetic-cad-mid", "min_score:"} <= set(out.output.split())
    written = json.loads((tmp_path / "fit.json").read_text())
    assert (written["kind"], len(written["terms"])) == ("fields", N_FEATURES)
    assert [row["target"] for row in written["rows"]] == ["synthetic-cad-hard", "synthetic-cad-mid"]
    made = "synthetic-cad-hard"
    printed = run(app, ["train", "calibration", "fields", made, "--frames", "4", "--json", "-"])
    assert json.loads(printed.stdout)["rows"][0]["target"] == made
    for wrong in (["whole", made], ["fields", "nowhere"], ["fields", made, "--weight", made], ["eyes", made]):
        assert run(app, ["train", "calibration", *wrong, "--frames", "3"]).exit_code == 2
    assert "whole" not in fittable()
