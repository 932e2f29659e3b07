"""ObjectGraph and Matching validate once, at construction, and name what is wrong."""

import numpy as np
import pytest

from covis.matching import Matching, ObjectGraph


def graph(n=3, **changes):
    fields = {
        "positions": np.arange(3.0 * n).reshape(n, 3),
        "attributes": np.full((n, 2), 0.5),
        "position_variance": np.full(n, 0.1),
        "attribute_variance": np.full(n, 0.01),
    }
    return ObjectGraph(**(fields | changes))


def test_empty_graph_is_valid():
    empty = ObjectGraph.from_positions(np.zeros((0, 3)))
    assert len(empty) == 0
    assert empty.full_covariances().shape == (0, 3, 3)
    assert len(ObjectGraph.from_positions([])) == 0


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("positions", np.zeros((3, 2)), r"positions must have shape \(n, 3\), got \(3, 2\)"),
        ("positions", np.full((3, 3), np.nan), r"positions must be finite, got nan at \(0, 0\)"),
        ("attributes", np.ones((2, 2)), r"attributes must have shape \(3, c\)"),
        ("attributes", -np.ones((3, 2)), "attributes must be non-negative, got -1"),
        ("position_variance", np.array([1.0, -2.0, 1.0]), "position_variance must be non-negative, got -2.0 at 1"),
        ("attribute_variance", np.array([1.0, 1.0, np.nan]), "attribute_variance must be non-negative, got nan at 2"),
        ("positions", [[0.0, 1], [2]], "positions must be a regular array of numbers"),
        ("positions", [["a", "b", "c"]] * 3, "positions must be real numbers, got <U1"),
        ("positions", None, "positions must be real numbers, got object None"),
        ("positions", np.ones((3, 3)) * 1j, "positions must be real numbers, got complex128"),
        ("attributes", ["car", "bus", "car"], r"attributes must be real numbers, got <U3 \['car', 'bus', 'car'\]"),
        ("attributes", [0, 1, 0], r"attributes must have shape \(3, c\) with c >= 1, got \(3,\)"),
        (
            "covariances",
            [np.eye(3), [[1.0, 2, 0], [0, 1, 0], [0, 0, 1]], np.eye(3)],
            r"covariances must be symmetric, got \[\[1.0, 2.0, 0.0\].* at 1",
        ),
        ("covariances", [np.eye(3)] * 2 + [np.diag([1, 1, -2])], "positive semidefinite, got an eigenvalue -2 at 2"),
        ("covariances", np.eye(3), r"covariances must have shape \(3, 3, 3\), got \(3, 3\)"),
        ("positions", np.full((3, 3), 1e13), r"positions must not exceed 1e\+12, got 1e\+13 at \(0, 0\)"),
        ("attributes", np.full((3, 2), 1e300), r"attributes must not exceed 1e\+12, got 1e\+300 at \(0, 0\)"),
        ("positions", np.ma.masked_equal(np.eye(3), 1), "positions must not be masked, got 3 masked values"),
        ("up", np.array([0.0, 0.0, 2.0]), "up must be a unit vector, its length is 2"),
        ("embedding", np.ones((2, 4)), r"embedding must have shape \(3, e\)"),
        ("intrinsics", np.zeros((3, 3)), "positive focal lengths"),
        ("image_size", (0, 10), r"image_size must be \(width, height\) >= 1"),
        ("image_size", (640,), r"image_size must be \(width, height\) >= 1 in whole pixels, got \(640,\)"),
        ("image_size", (640.5, 480), "in whole pixels"),
        ("horizontal_fov_rad", "wide", "horizontal_fov_rad must be real numbers"),
        ("horizontal_fov_rad", [1.0, 2.0], r"horizontal_fov_rad must have shape \(\), got \(2,\)"),
        ("horizontal_fov_rad", 7.0, r"horizontal_fov_rad must lie in \(0, 2 pi\], got 7.0"),
    ],
)
def test_bad_fields_are_named(field, value, message):
    with pytest.raises(ValueError, match=message):
        graph(**{field: value})


@pytest.mark.parametrize(
    ("positions", "options", "message"),
    [
        ([1.0, 2.0, 3.0], {}, r"positions must have shape \(n, 3\), got \(3,\)"),
        (np.zeros((0, 2)), {}, r"positions must have shape \(n, 3\), got \(0, 2\)"),
        (np.zeros((4, 2)), {}, r"positions must have shape \(n, 3\), got \(4, 2\)"),
        (5.0, {}, r"positions must have shape \(n, 3\), got \(\)"),
        (
            np.eye(3),
            {"position_variance": [1, 2]},
            r"position_variance must be one number or have shape \(3,\), got \(2,\)",
        ),
        (
            np.eye(3),
            {"position_variance": np.ones((3, 3))},
            r"position_variance must be one number or have shape \(3,\)",
        ),
        (np.eye(3), {"position_variance": -1}, "position_variance must be non-negative, got -1.0 at 0"),
        (np.eye(3), {"attribute_variance": "low"}, "attribute_variance must be real numbers"),
    ],
)
def test_bad_positions_and_variances_are_named(positions, options, message):
    with pytest.raises(ValueError, match=message):
        ObjectGraph.from_positions(positions, **options)


@pytest.mark.parametrize("kind", [list, np.float32, np.int64])
def test_any_kind_of_numbers_becomes_float64(kind):
    given = [[1, 2, 3], [4, 5, 6]] if kind is list else np.array([[1, 2, 3], [4, 5, 6]], dtype=kind)
    g = ObjectGraph.from_positions(given, position_variance=[1, 2])
    assert g.positions.dtype == g.position_variance.dtype == np.float64
    assert g.positions.tolist() == [[1, 2, 3], [4, 5, 6]]


def test_infinite_variance_means_unknown():
    g = graph(position_variance=np.array([np.inf, 0.0, 1.0]))
    covariances = g.full_covariances(unknown_variance=100.0)
    assert np.isfinite(covariances).all()
    ray = g.positions[0] / np.linalg.norm(g.positions[0])
    assert ray @ covariances[0] @ ray == pytest.approx(100.0)


def test_covariance_follows_the_ray():
    g = ObjectGraph.from_positions([[3.0, 4.0, 0.0]], position_variance=0.25)
    (covariance,) = g.full_covariances(bearing_std_rad=0.01)
    along, across = np.array([0.6, 0.8, 0]), np.array([-0.8, 0.6, 0])
    assert along @ covariance @ along == pytest.approx(0.25)
    assert across @ covariance @ across == pytest.approx((5 * 0.01) ** 2)
    assert along @ covariance @ across == pytest.approx(0)


def test_transformed_moves_everything_that_has_a_direction():
    T = np.array([[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
    g = graph(up=np.array([1.0, 0, 0]), forward=np.array([0.0, 1, 0]))
    moved = g.transformed(T)
    np.testing.assert_allclose(moved.positions[1], T[:3, :3] @ g.positions[1] + T[:3, 3])
    np.testing.assert_allclose(moved.up, [0, 1, 0])
    np.testing.assert_allclose(moved.forward, [-1, 0, 0])
    expected = T[:3, :3] @ g.full_covariances() @ T[:3, :3].T
    np.testing.assert_allclose(moved.full_covariances(), expected)


def test_take_keeps_rows_together():
    g = graph(covariances=np.stack([np.eye(3) * k for k in (1, 2, 3)]), embedding=np.eye(3))
    taken = g.take(np.array([2, 0]))
    np.testing.assert_array_equal(taken.positions, g.positions[[2, 0]])
    assert taken.covariances[0, 0, 0] == 3
    assert taken.embedding[1, 0] == 1


def test_empty_matching_has_shape_0_2():
    assert Matching.empty().pairs.shape == (0, 2)
    assert Matching([], []).pairs.shape == (0, 2)


@pytest.mark.parametrize(
    ("pairs", "scores", "message"),
    [
        ([[0, 1, 2]], [1.0], r"pairs must be integers of shape \(k, 2\)"),
        ([[0.5, 1.0]], [1.0], "pairs must be integers"),
        ([[0, 1]], [1.0, 1.0], r"scores must have shape \(1,\)"),
        ([[-1, 1]], [1.0], "pairs must be non-negative, got -1"),
        ([[0, 1], [0, 2]], [1.0, 1.0], "pairs repeat an index in column 0"),
        ([[0, 1], [2, 1]], [1.0, 1.0], "pairs repeat an index in column 1"),
        ([[0, 1]], [1.5], r"scores must lie in \[0, 1\]"),
        ([[0, 1]], [np.nan], r"scores must lie in \[0, 1\]"),
    ],
)
def test_bad_matchings_are_refused(pairs, scores, message):
    with pytest.raises(ValueError, match=message):
        Matching(np.array(pairs), np.array(scores))
