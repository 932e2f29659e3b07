"""The scoring rules, each with somebody who tries to cheat it."""

import numpy as np
import pytest

from covis.envs.claims import Claims
from covis.envs.scoring import LocalizationReward, Truth, score, tie, tight_boxes
from covis.matching.metrics import Counts

K = 6


def truth(n_robots=2, m=4, visible=None):
    """m objects in a row, 5 m ahead of robots that stand at the same place; every robot sees them in separate boxes."""
    boxes = np.array([[20.0 * j, 10, 20 * j + 10, 20] for j in range(m)])
    pixels = np.full((n_robots, m), 100)
    if visible is not None:
        pixels = np.where(visible, pixels, 0)
    return Truth(
        identity=np.arange(m) + 50,
        object_class=np.zeros(m, dtype=np.int64),
        positions=np.array([[j - 1.5, 0.0, 5.0] for j in range(m)]),
        T_world_camera=np.tile(np.eye(4), (n_robots, 1, 1)),
        boxes=np.tile(boxes, (n_robots, 1, 1)),
        pixels=pixels,
        min_pixels=60,
    )


def honest(t, robot, objects, matches=None, error=0.1):
    """Claims with the true boxes of `objects` in slots 0, 1, ...; `matches` (partner -> list of slots)."""
    claims = Claims.empty(K, t.n_robots - 1)
    n = len(objects)
    claims.boxes[:n] = t.boxes[robot, objects]
    claims.positions[:n] = t.positions[objects] + [0, 0, error]
    claims.positions_single[:n] = t.positions[objects] + [0, 0, 2 * error]
    for partner, slots in (matches or {}).items():
        claims.matches[partner, : len(slots)] = slots
        claims.match_scores[partner, : len(slots)] = 0.9
    return claims


def test_perfect_claims():
    t = truth()
    result = score([honest(t, 0, [0, 1, 2], {0: [1, 0, 2]}), honest(t, 1, [1, 0, 2], {0: [1, 0, 2]})], t)
    (pair,) = result.pairs
    assert pair.counts == Counts(correct=3, retrieved=3, common=3)
    assert pair.n_visible == 4
    assert pair.scene_recall == 0.75
    np.testing.assert_allclose(result.error_fused[0, :3], 0.1)
    np.testing.assert_allclose(result.error_single[0, :3], 0.2)
    assert np.isnan(result.error_fused[0, 3:]).all()


def test_one_easy_box_each_has_full_recall_but_low_scene_recall_and_reward():
    t = truth()
    easy = score([honest(t, 0, [0], {0: [0]}), honest(t, 1, [0], {0: [0]})], t)
    diligent = score([honest(t, 0, [0, 1, 2, 3], {0: [0, 1, 2, 3]}), honest(t, 1, [0, 1, 2, 3])], t)
    assert easy.counts.recall == 1.0
    assert easy.pairs[0].scene_recall == 0.25
    assert diligent.pairs[0].scene_recall == 1.0
    assert LocalizationReward()(easy) < 0.3 * LocalizationReward()(diligent)


def test_duplicate_boxes_have_no_identity():
    t = truth()
    twice = honest(t, 0, [0, 0, 1], {0: [0, 0, 1]})
    result = score([twice, honest(t, 1, [0, 1])], t)
    assert result.tied[0].tolist() == [0, -1, 1, -1, -1, -1]
    # (0, 0) and (2, 1) are right; the duplicate's assertion (1, 0) is retrieved and wrong.
    assert result.counts == Counts(correct=2, retrieved=3, common=2)


def test_a_duplicate_fits_better_or_not_at_all():
    t = truth()
    claims = honest(t, 0, [0, 0])
    claims.boxes[0, 2] -= 3  # a sloppy first copy; the exact one gets the object
    assert score([claims, honest(t, 1, [])], t).tied[0, :2].tolist() == [-1, 0]


def test_partner_slot_that_does_not_exist_is_retrieved_and_wrong():
    t = truth()
    result = score([honest(t, 0, [0, 1], {0: [0, 5]}), honest(t, 1, [0, 1])], t)
    assert result.counts == Counts(correct=1, retrieved=2, common=2)


def test_match_from_an_empty_slot_is_retrieved_and_wrong():
    t = truth()
    liar = honest(t, 0, [0], {0: [0]})
    liar.matches[0, 4] = 1
    result = score([liar, honest(t, 1, [0, 1])], t)
    assert result.counts == Counts(correct=1, retrieved=2, common=1)


def test_disagreement_costs_the_wrong_half():
    t = truth()
    result = score([honest(t, 0, [0, 1], {0: [0, 1]}), honest(t, 1, [0, 1], {0: [1, 0]})], t)
    # Union of {(0,0), (1,1)} and {(1,0), (0,1)}: two right, two wrong.
    assert result.counts == Counts(correct=2, retrieved=4, common=2)


def test_agreement_counts_once():
    t = truth()
    result = score([honest(t, 0, [0, 1], {0: [0, 1]}), honest(t, 1, [0, 1], {0: [0, 1]})], t)
    assert result.counts == Counts(correct=2, retrieved=2, common=2)


def test_matching_everything_to_one_slot_gains_nothing():
    t = truth()
    result = score([honest(t, 0, [0, 1, 2], {0: [0, 0, 0]}), honest(t, 1, [0, 1, 2])], t)
    assert result.counts == Counts(correct=1, retrieved=3, common=3)


def test_looking_away_does_not_pay():
    t = truth(visible=np.array([[True] * 4, [False] * 4]))
    away = score([honest(t, 0, [0, 1, 2, 3]), honest(t, 1, [])], t)
    nobody = truth(visible=np.zeros((2, 4), dtype=bool))
    blind = score([Claims.empty(K, 1), Claims.empty(K, 1)], nobody)
    reward = LocalizationReward()
    assert reward(blind) == 0.0
    assert reward(away) > reward(blind)
    together = truth()
    full = score(
        [honest(together, 0, [0, 1, 2, 3], error=0.01), honest(together, 1, [0, 1, 2, 3], error=0.01)], together
    )
    assert reward(full) >= reward(away)


def test_claiming_nothing_scores_zero():
    t = truth()
    result = score([Claims.empty(K, 1), Claims.empty(K, 1)], t)
    assert result.counts == Counts(0, 0, 0)
    assert result.n_visible == 4
    assert np.isinf(result.object_error).all()
    assert LocalizationReward()(result) == 0.0


def test_wrong_matches_cost_reward():
    t = truth()
    right = score([honest(t, 0, [0, 1], {0: [0, 1]}), honest(t, 1, [0, 1])], t)
    wrong = score([honest(t, 0, [0, 1], {0: [1, 0]}), honest(t, 1, [0, 1])], t)
    reward = LocalizationReward(wrong_match_penalty=0.02)
    assert reward(right) - reward(wrong) == pytest.approx(2 * 0.02)


def test_loose_boxes_have_no_identity():
    t = truth()
    claims = honest(t, 0, [0])
    claims.boxes[0] = [0, 0, 40, 40]
    assert score([claims, honest(t, 1, [])], t).tied[0, 0] == -1


@pytest.mark.parametrize(("width", "tied"), [(20.1, -1), (20.0, 0), (19.9, 0)])
def test_a_box_is_its_objects_from_an_overlap_of_one_half_on(width, tied):
    box = np.array([[0.0, 0, width, 10]])
    assert tie(box, np.array([[0.0, 0, 10, 10]]), np.array([100])).tolist() == [tied]


def test_a_match_that_both_assert_has_the_higher_score():
    t = truth()
    a, b = honest(t, 0, [0, 1], {0: [0, 1]}), honest(t, 1, [0, 1], {0: [0, 1]})
    a.match_scores[0, :2], b.match_scores[0, :2] = (0.3, 0.8), (0.6, 0.2)
    (pair,) = score([a, b], t).pairs
    assert dict(zip(map(tuple, pair.assertions.tolist()), pair.scores.tolist(), strict=True)) == {
        (0, 0): 0.6,
        (1, 1): 0.8,
    }


def test_visible_objects_are_those_large_enough_in_both_images():
    t = truth(visible=np.array([[True, True, False, False], [True, False, True, False]]))
    assert score([Claims.empty(K, 1), Claims.empty(K, 1)], t).n_visible == 1


def test_an_object_counts_by_the_best_robot_that_claims_it_matched_or_not():
    t = truth()
    result = score([honest(t, 0, [0, 1], error=0.3), honest(t, 1, [1, 2], error=0.1)], t)
    np.testing.assert_allclose(result.object_error, [0.3, 0.1, 0.1, np.inf])
    assert LocalizationReward(cap_m=1.0)(result) == pytest.approx((0.7 + 0.9 + 0.9) / 4)


def test_unmatched_objects_do_not_enter_the_displacement_error():
    t = truth()
    a = honest(t, 0, [0, 1], {0: [0]})
    a.positions[1] += 100
    result = score([a, honest(t, 1, [0, 1])], t)
    assert np.nanmax(result.error_fused) == pytest.approx(0.1)
    assert (~np.isnan(result.error_fused)).sum() == 2


def test_error_is_in_the_claimants_frame_through_the_true_pose():
    t = truth()
    T = np.eye(4)
    T[:3, 3] = [1.0, 2.0, 0.5]
    moved = Truth(**{**vars(t), "T_world_camera": np.stack([np.eye(4), T])})
    b = honest(t, 1, [0])
    b.positions[0] = moved.positions[0] - T[:3, 3]
    result = score([honest(t, 0, [0], {0: [0]}), b], moved)
    assert result.error_fused[1, 0] == pytest.approx(0.0, abs=1e-12)


def test_three_robots_score_every_pair_with_the_right_partner():
    t = truth(n_robots=3)
    a = honest(t, 0, [0, 1], {0: [0, K], 1: [1, K]})  # partner 0 is robot 1, partner 1 is robot 2
    b = honest(t, 1, [0, 1], {1: [1, 0]})  # partner 1 of robot 1 is robot 2
    c = honest(t, 2, [1, 0])
    result = score([a, b, c], t)
    by_pair = {(p.a, p.b): p.counts for p in result.pairs}
    assert by_pair == {(0, 1): Counts(1, 1, 2), (0, 2): Counts(1, 1, 2), (1, 2): Counts(2, 2, 2)}


def test_tie_takes_the_highest_overlap_first():
    boxes = np.array([[0.0, 0, 10, 10], [2, 0, 12, 10]])
    assert tie(boxes, np.array([[2.0, 0, 12, 10]]), np.array([100])).tolist() == [-1, 0]


def test_tie_ignores_objects_without_pixels():
    box = np.array([[0.0, 0, 10, 10]])
    assert tie(box, box, np.array([0])).tolist() == [-1]


def test_tight_boxes_by_numpy():
    rng = np.random.default_rng(0)
    instances = rng.integers(-1, 4, (12, 17)).astype(np.int32)
    boxes, pixels = tight_boxes(instances, 5)
    for j in range(4):
        v, u = np.nonzero(instances == j)
        np.testing.assert_array_equal(boxes[j], [u.min(), v.min(), u.max() + 1, v.max() + 1])
        assert pixels[j] == len(v)
    assert pixels[4] == 0
