"""Claims travel through the action's flat leaves and come back."""

import numpy as np
import pytest
from gymnasium import spaces

from covis.envs.claims import POSITION_BOUND_M, VARIANCE_BOUND_M2, Claims, action_space, claims_to_action, decode


def random_claims(rng, K=5, partners=2):
    low = rng.uniform(0, 50, (K, 2))
    return Claims(
        boxes=np.concatenate([low, low + rng.uniform(1, 10, (K, 2))], axis=1),
        positions=rng.normal(0, 20, (K, 3)),
        positions_single=rng.normal(0, 20, (K, 3)),
        position_variance=rng.uniform(0, 3, K),
        matches=rng.integers(0, K + 1, (partners, K)),
        match_scores=rng.uniform(0, 1, (partners, K)),
    )


@pytest.mark.parametrize(("K", "partners"), [(1, 1), (5, 2), (3, 0)])
def test_round_trip(K, partners):
    space = action_space(2, K, partners, 64, 64)
    claims = random_claims(np.random.default_rng(0), K, partners)
    action = claims_to_action(claims, np.array([0.5, -1.0]))
    assert space.contains(action)
    control, back = decode("robot_0", action, space)
    np.testing.assert_array_equal(control, [0.5, -1.0])
    for name, value in vars(claims).items():
        np.testing.assert_allclose(getattr(back, name), value, rtol=1e-6)
    np.testing.assert_array_equal(back.matches, claims.matches, "partner-major order")


def test_what_is_decoded_shares_nothing_with_the_action():
    space = action_space(1, 4, 1, 64, 64)
    action = {name: leaf.sample() for name, leaf in space.items()}
    control, claims = decode("robot_0", action, space)
    for array in (control, *vars(claims).values()):
        assert not any(np.shares_memory(array, leaf) for leaf in action.values())


def test_estimates_beyond_the_space_are_clipped_to_it():
    claims = random_claims(np.random.default_rng(0))
    claims.positions[0] = 5e3, -5e3, 0
    claims.position_variance[0] = 1e9
    action = claims_to_action(claims, np.zeros(2))
    assert action_space(2, 5, 2, 64, 64).contains(action)
    np.testing.assert_array_equal(action["positions"][:3], [POSITION_BOUND_M, -POSITION_BOUND_M, 0])
    assert action["position_variance"][0] == VARIANCE_BOUND_M2


def test_empty_claims_fill_no_slot_and_match_nothing():
    claims = Claims.empty(4, 2)
    assert not claims.filled().any()
    assert (claims.matches == 4).all()
    assert action_space(2, 4, 2, 8, 8).contains(claims_to_action(claims, np.zeros(2)))


def test_a_box_without_area_is_an_empty_slot():
    claims = Claims.empty(4, 1)
    claims.boxes[:] = [[1, 1, 2, 2], [1, 1, 1, 5], [3, 3, 2, 5], [1, 5, 4, 4]]
    np.testing.assert_array_equal(claims.filled(), [True, False, False, False])


def test_every_leaf_is_flat_and_other_number_types_are_taken():
    space = action_space(3, 4, 2, 64, 48)
    assert all(len(leaf.shape) == 1 for leaf in space.values())
    assert isinstance(space["matches"], spaces.MultiDiscrete)
    action = {name: leaf.sample() for name, leaf in space.items()}
    lists = {name: leaf.tolist() for name, leaf in action.items()}
    doubles = {n: v.astype(np.float64 if v.dtype.kind == "f" else np.uint8) for n, v in action.items()}
    for same in (lists, doubles):
        for a, b in zip(decode("r", action, space), decode("r", same, space), strict=True):
            for x, y in zip(*(vars(c).values() if isinstance(c, Claims) else [c] for c in (a, b)), strict=True):
                np.testing.assert_array_equal(x, y)
