"""Our RRWM against pygmtools', step for step: same affinity, fixed iterations, its own meaning of alpha.

pygmtools returns the mixture of walk and jump, ours the walk: one more step of the walk makes them the same. Its jump
is not normalised before it is mixed (it sums to n), so its alpha weighs n alpha against 1 - alpha.
"""

import numpy as np
import pytest

from covis.matching import load_matcher
from covis.matching.candidates import affinity_matrix
from covis.matching.random_walk import distance_affinity, reweighted_random_walk
from covis.matching.similarity import attribute_similarity, distances
from covis.matching.testing import check_matcher, check_well_formed, degenerate_problems, scene

pygm = pytest.importorskip("pygmtools", reason="pygmtools is not installed")


@pytest.mark.parametrize("alpha", [0.2, 0.6])
@pytest.mark.parametrize("seed", range(4))
def test_same_walk(seed, alpha):
    rng = np.random.default_rng(seed)
    problem = scene(rng, common=6, source_only=2, target_only=2)
    n = len(problem.source)
    s, t = distances(problem.source.positions), distances(problem.target.positions)
    K = affinity_matrix(problem.source, problem.target, s, t, 0.5, 1.0)
    by_columns = K.reshape(n, n, n, n).transpose(1, 0, 3, 2).reshape(n * n, n * n)
    steps, half_steps = 12, 20
    options = {"max_iter": steps, "sk_iter": half_steps, "alpha": alpha, "beta": 30, "backend": "numpy"}
    soft = np.asarray(pygm.rrwm(by_columns, n1=n, n2=n, **options))
    walk = K @ soft.ravel()
    share = (1 - alpha) / (1 - alpha + n * alpha)
    A = attribute_similarity(problem.source.attributes, problem.target.attributes)
    affinity = distance_affinity(s, t, 0.5, A, A)
    ours = reweighted_random_walk(affinity, share, 30.0, steps + 1, half_steps // 2, 0.0, 0.0)
    np.testing.assert_allclose(ours.ravel(), walk / walk.sum(), rtol=1e-5, atol=1e-9)  # ours: single precision


@pytest.mark.parametrize("solver", ["rrwm", "sm", "ipfp"])
def test_adapter_keeps_the_contract(solver):
    check_matcher(load_matcher(f"pygm:{solver}"), min_f1=0.5, invariant=False)


def test_the_learned_solver_answers_every_problem():
    """Untrained weights: they need no network connection, and say nothing about quality."""
    torch = pytest.importorskip("torch")
    matcher = load_matcher("pygm:ngm")
    for problem in [*degenerate_problems(), scene(np.random.default_rng(0))]:
        torch.manual_seed(0)
        found = matcher(problem.source, problem.target, pretrain=False)
        check_well_formed(found, problem.source, problem.target, problem.name)
    assert len(found) == 8


def test_a_learned_solver_without_weights_says_so(monkeypatch):
    pytest.importorskip("torch")

    def no_connection(*args, **kwargs):
        raise FileNotFoundError("ngm_voc_pytorch.pt")

    monkeypatch.setattr(pygm, "ngm", no_connection)
    problem = scene(np.random.default_rng(0))
    with pytest.raises(RuntimeError, match=r"pygm:ngm lacks its weights.* ngm_voc_pytorch\.pt"):
        load_matcher("pygm:ngm")(problem.source, problem.target)


def test_unknown_solver_is_refused_by_name():
    with pytest.raises(ValueError, match="no pygmtools solver is called 'magic'"):
        load_matcher("pygm:magic")
