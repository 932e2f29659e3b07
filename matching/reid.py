"""Re-identification: appearance alone (after Zhao et al. 2019, the paper's ReId baseline)."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

from .checks import check_interval
from .graph import Matching, ObjectGraph, check_comparable
from .pose import Array, RelativePose
from .similarity import attribute_similarity


def reid(
    source: ObjectGraph,
    target: ObjectGraph,
    *,
    prior: RelativePose | None = None,
    rng: np.random.Generator | None = None,
    use_embedding: bool = True,
    min_similarity: float = 0.0,
) -> Matching:
    """Assign objects by cosine similarity of their appearance, each to at most one, maximising the total.

    Args:
        source, target: the two robots' graphs.
        prior, rng: not used.
        use_embedding: compare `embedding` where both graphs carry one, else (and otherwise) `attributes`, Eq. (1).
        min_similarity: pairs below it are not matched.

    Returns:
        Matches with the similarity, clipped to [0, 1], as score. Identical objects are matched arbitrarily.

    Raises:
        ValueError: min_similarity out of range, different attribute classes, embeddings of different lengths.
    """
    check_comparable(source, target, prior)
    check_interval("min_similarity", min_similarity, "[0, 1]")
    if len(source) == 0 or len(target) == 0:
        return Matching.empty()
    A = _appearance(source, target, use_embedding)
    rows, cols = linear_sum_assignment(A, maximize=True)
    keep = A[rows, cols] >= min_similarity
    rows, cols = rows[keep], cols[keep]
    return Matching(np.stack([rows, cols], axis=1), np.clip(A[rows, cols], 0.0, 1.0))


def _appearance(source: ObjectGraph, target: ObjectGraph, use_embedding: bool) -> Array:
    """Cosine similarities (n, n')."""
    if use_embedding and source.embedding is not None and target.embedding is not None:
        if source.embedding.shape[1] != target.embedding.shape[1]:
            raise ValueError(
                f"embeddings differ in length: {source.embedding.shape[1]} and {target.embedding.shape[1]}"
            )
        return attribute_similarity(source.embedding, target.embedding)
    return attribute_similarity(source.attributes, target.attributes)
