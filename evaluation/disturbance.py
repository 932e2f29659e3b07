"""Robustness: what a robot reports, or what it measured, made worse after perception and before matching.

The paper raises reported uncertainties by a rate (section 4.2, Fig. 7). Beyond it, the noise itself can be raised while
the reports stay as they were.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..matching import ObjectGraph
from ..matching.pose import Array

LEAST_CONFIDENCE = 1e-6


@dataclass(frozen=True)
class Disturbance:
    """Rates; 0.15 is 15 % more, 0 leaves things alone.

    Attributes:
        attribute_uncertainty: reported v times 1 + rate.
        position_uncertainty: reported u, and full covariances, times 1 + rate.
        attribute_noise: noise is added to the attributes, so that their errors (1 sigma, by their report) grow to
            1 + rate times what they were; v stays.
        position_noise: the same for positions; u stays.
    """

    attribute_uncertainty: float = 0.0
    position_uncertainty: float = 0.0
    attribute_noise: float = 0.0
    position_noise: float = 0.0

    def __post_init__(self) -> None:
        for name, rate in vars(self).items():
            if isinstance(rate, bool) or not isinstance(rate, int | float) or not (np.isfinite(rate) and rate >= 0):
                raise ValueError(f"{name} must be a finite, non-negative rate, got {rate!r}")

    @classmethod
    def of(cls, rates: Mapping[str, Any]) -> Disturbance:
        """From names and rates. Raises ValueError for an unknown name or a bad rate."""
        unknown = sorted(set(rates) - set(cls.__dataclass_fields__))
        if unknown:
            known = ", ".join(cls.__dataclass_fields__)
            raise ValueError(f"{unknown[0]!r} is no disturbance; there are {known}")
        return cls(**rates)

    def rates(self) -> dict[str, float]:
        """Those that are not 0."""
        return {name: rate for name, rate in vars(self).items() if rate}

    def apply(self, graph: ObjectGraph, rng: np.random.Generator) -> ObjectGraph:
        """The graph as it is after the disturbance; `rng` draws the added noise."""
        if not self.rates() or len(graph) == 0:
            return graph
        along_with_it = 1 + self.position_uncertainty
        covariances = graph.covariances
        return replace(
            graph,
            positions=self._positions(graph, rng),
            attributes=self._attributes(graph, rng),
            position_variance=along_with_it * graph.position_variance,
            attribute_variance=(1 + self.attribute_uncertainty) * graph.attribute_variance,
            covariances=None if covariances is None else along_with_it * covariances,
        )

    def _positions(self, graph: ObjectGraph, rng: np.random.Generator) -> Array:
        if not self.position_noise:
            return graph.positions
        draws = rng.standard_normal((len(graph), 3))
        if graph.covariances is not None:
            values, vectors = np.linalg.eigh(graph.covariances)
            error = np.einsum("nij,nj,nj->ni", vectors, np.sqrt(np.maximum(values, 0)), draws)
        else:
            distance = np.maximum(np.linalg.norm(graph.positions, axis=1), 1e-9)
            along = np.sqrt(np.where(np.isfinite(graph.position_variance), graph.position_variance, 0.0))
            error = graph.positions / distance[:, None] * (along * draws[:, 0])[:, None]
        return graph.positions + _added(self.position_noise) * error

    def _attributes(self, graph: ObjectGraph, rng: np.random.Generator) -> Array:
        if not self.attribute_noise:
            return graph.attributes
        std = np.sqrt(np.where(np.isfinite(graph.attribute_variance), graph.attribute_variance, 0.0))
        draws = rng.standard_normal(graph.attributes.shape)
        noisy = graph.attributes + _added(self.attribute_noise) * std[:, None] * draws
        positive = np.maximum(noisy, LEAST_CONFIDENCE)
        return positive / positive.sum(axis=1, keepdims=True) * graph.attributes.sum(axis=1, keepdims=True)


def _added(rate: float) -> float:
    """Standard deviation of added noise, in units of what is there, that makes the whole 1 + rate times as large."""
    return float(np.sqrt((1 + rate) ** 2 - 1))
