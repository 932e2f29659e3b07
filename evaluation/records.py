"""What a run leaves behind: one record per pair of views and method, in Arrow; and the rows made of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyarrow as pa

from ..matching.graph import Matching
from ..matching.metrics import Counts, count, expected_calibration_error, is_correct, pooled
from .statistics import bootstrap_f1

SCHEMA = pa.schema(
    [
        ("experiment", pa.string()),
        ("seed", pa.int64()),
        ("target", pa.string()),
        ("method", pa.string()),
        ("episode", pa.int64()),
        ("frame", pa.int64()),
        ("source", pa.string()),
        ("partner", pa.string()),
        ("correct", pa.int64()),
        ("retrieved", pa.int64()),
        ("common", pa.int64()),
        ("visible", pa.int64()),
        ("match_ms", pa.float64()),
        ("scores", pa.list_(pa.float64())),
        ("hits", pa.list_(pa.bool_())),
        ("error_single_m", pa.list_(pa.float64())),
        ("error_fused_m", pa.list_(pa.float64())),
        ("error_range_m", pa.list_(pa.float64())),
        ("error_occlusion", pa.list_(pa.float64())),
        ("common_range_m", pa.list_(pa.float64())),
        ("common_occlusion", pa.list_(pa.float64())),
        ("common_found", pa.list_(pa.bool_())),
    ]
)


@dataclass(frozen=True)
class Record:
    """One pair of views matched by one method.

    `experiment` and `seed` say of which part of a run; `visible` counts objects that both cameras could see (None on
    datasets, which do not know); `scores` and `hits` run over the emitted matches; the errors (m) over objects both
    localised, where positions are scored, each with the object's distance from the robot that errs and how much of it
    is hidden there (0 to 1). `common_...` runs over the objects both detected: the larger distance, the larger
    occlusion, and whether they were matched rightly; the occlusion is empty on datasets, which do not know it.
    """

    target: str
    method: str
    episode: int
    frame: int
    source: str
    partner: str
    correct: int
    retrieved: int
    common: int
    match_ms: float
    scores: list[float] = field(default_factory=list)
    hits: list[bool] = field(default_factory=list)
    visible: int | None = None
    error_single_m: list[float] = field(default_factory=list)
    error_fused_m: list[float] = field(default_factory=list)
    error_range_m: list[float] = field(default_factory=list)
    error_occlusion: list[float] = field(default_factory=list)
    common_range_m: list[float] = field(default_factory=list)
    common_occlusion: list[float] = field(default_factory=list)
    common_found: list[bool] = field(default_factory=list)
    experiment: str = ""
    seed: int = 0

    @classmethod
    def of_matching(
        cls, matching: Matching, source_identity: Any, target_identity: Any, match_ms: float, **where: Any
    ) -> Record:
        counts = count(matching, source_identity, target_identity)
        return cls(
            correct=counts.correct,
            retrieved=counts.retrieved,
            common=counts.common,
            match_ms=match_ms,
            scores=matching.scores.tolist(),
            hits=is_correct(matching, source_identity, target_identity).tolist(),
            **where,
        )

    @property
    def counts(self) -> Counts:
        return Counts(self.correct, self.retrieved, self.common)


def to_table(records: Sequence[Record]) -> pa.Table:
    return pa.Table.from_pylist([vars(record) for record in records], schema=SCHEMA)


def from_table(table: pa.Table) -> list[Record]:
    return [Record(**row) for row in table.to_pylist()]


def summarise(records: Sequence[Record], bootstrap_seed: int = 0) -> dict[str, Any]:
    """The figures of one row: pooled over the records of one target and one method."""
    total = pooled([r.counts for r in records])
    low, high = bootstrap_f1([(r.seed, r.episode) for r in records], [r.counts for r in records], seed=bootstrap_seed)
    scores = np.array([s for r in records for s in r.scores])
    hits = np.array([h for r in records for h in r.hits], dtype=bool)
    row: dict[str, Any] = {
        "frames": len({(r.seed, r.episode, r.frame) for r in records}),
        "pairs": len(records),
        "precision": total.precision,
        "recall": total.recall,
        "f1": total.f1,
        "f1_low": low,
        "f1_high": high,
        "ece": _number(expected_calibration_error(scores, hits)),
        "match_ms": float(np.median([r.match_ms for r in records])) if records else None,
        "n_correct": total.correct,
        "n_retrieved": total.retrieved,
        "n_covisible": total.common,
    }
    visible = [r.visible for r in records if r.visible is not None]
    if visible:
        n_visible = sum(visible)
        single = np.array([e for r in records for e in r.error_single_m])
        fused = np.array([e for r in records for e in r.error_fused_m])
        row |= {
            "n_visible": n_visible,
            "scene_recall": total.correct / n_visible if n_visible else 0.0,
            "displacement_single_m": float(single.mean()) if len(single) else None,
            "displacement_fused_m": float(fused.mean()) if len(fused) else None,
        }
    return row


def _number(value: float) -> float | None:
    """NaN has no place in JSON."""
    return None if np.isnan(value) else value
