"""What a run leaves behind: one record per pair of views and method, in Arrow; and the rows made of them."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from ..matching.graph import Matching
from ..matching.metrics import (
    Counts,
    count,
    expected_calibration_error,
    f1_per_pair,
    is_correct,
    recall_at_precision,
)
from .statistics import bootstrap_interval

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
        ("positions_scored", pa.bool_()),
        ("error_single_m", pa.list_(pa.float64())),
        ("error_fused_m", pa.list_(pa.float64())),
        ("error_range_m", pa.list_(pa.float64())),
        ("error_occlusion", pa.list_(pa.float64())),
        ("common_range_m", pa.list_(pa.float64())),
        ("common_occlusion", pa.list_(pa.float64())),
        ("common_found", pa.list_(pa.bool_())),
        ("failure", pa.string()),
    ]
)


@dataclass(frozen=True)
class Record:
    """One pair of views matched by one method.

    `experiment` and `seed` say of which part of a run; `visible` counts objects that both cameras could see (None on
    datasets that do not know); `scores` and `hits` run over the emitted matches; the errors (m) over objects both
    localised, where `positions_scored`, each with the object's distance from the robot that errs and how much of it is
    hidden there (0 to 1; empty on datasets, which do not know). `common_...` runs over the objects both detected: the
    larger distance, the larger occlusion (empty on datasets), and whether they were matched rightly. `failure` is what
    the method failed of on this pair, on which it then counts as having found nothing.
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
    positions_scored: bool = False
    error_single_m: list[float] = field(default_factory=list)
    error_fused_m: list[float] = field(default_factory=list)
    error_range_m: list[float] = field(default_factory=list)
    error_occlusion: list[float] = field(default_factory=list)
    common_range_m: list[float] = field(default_factory=list)
    common_occlusion: list[float] = field(default_factory=list)
    common_found: list[bool] = field(default_factory=list)
    failure: str | None = None
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


@dataclass(frozen=True, eq=False)
class Tally:
    """What rows need of many records of one method: little enough that a million frames fit into memory.

    Attributes:
        episodes: by seed and episode, how many matches were correct, were retrieved, were there to be found (3,).
        frames, pairs: how many.
        n_failed: pairs on which the method failed.
        counts: (pairs, 3) correct, retrieved and common matches of each pair.
        match_ms: (pairs,).
        scores, hits: of all emitted matches.
        visible: objects that both cameras could see; None where no record knows.
        positions_scored: whether any record's positions are scored.
        errors_m: sums of displacement errors of one robot alone and fused; `n_errors` is their number.
    """

    episodes: dict[Hashable, NDArray[np.float64]]
    frames: int
    pairs: int
    n_failed: int
    counts: NDArray[np.int64]
    match_ms: NDArray[np.float64]
    scores: NDArray[np.float64]
    hits: NDArray[np.bool_]
    visible: int | None
    positions_scored: bool
    errors_m: tuple[float, float]
    n_errors: int

    @classmethod
    def of(cls, table: pa.Table) -> Tally:
        """Of records as `to_table` makes them."""
        where = np.stack([table[key].to_numpy() for key in ("seed", "episode", "frame")], axis=1)
        counts = np.stack([table[key].to_numpy() for key in ("correct", "retrieved", "common")], axis=1)
        keys, group = np.unique(where[:, :2], axis=0, return_inverse=True)
        sums = np.zeros((len(keys), 3))
        np.add.at(sums, group.ravel(), counts)
        visible = table["visible"].drop_null()
        single, fused = _flat(table, "error_single_m"), _flat(table, "error_fused_m")
        return cls(
            episodes={(int(seed), int(episode)): row for (seed, episode), row in zip(keys, sums, strict=True)},
            frames=len(np.unique(where, axis=0)),
            pairs=len(table),
            n_failed=len(table["failure"].drop_null()) if "failure" in table.column_names else 0,
            counts=counts.astype(np.int64),
            match_ms=table["match_ms"].to_numpy(),
            scores=_flat(table, "scores"),
            hits=_flat(table, "hits").astype(bool),
            visible=int(visible.to_numpy().sum()) if len(visible) else None,
            positions_scored=bool(table["positions_scored"].to_numpy().any()),
            errors_m=(float(single.sum()), float(fused.sum())),
            n_errors=len(single),
        )

    @classmethod
    def pool(cls, tallies: Sequence[Tally]) -> Tally:
        """All of them together; no two of them share a frame."""
        episodes: dict[Hashable, NDArray[np.float64]] = {}
        for tally in tallies:
            for episode, row in tally.episodes.items():
                episodes[episode] = episodes[episode] + row if episode in episodes else row
        visible = [tally.visible for tally in tallies if tally.visible is not None]
        return cls(
            episodes=episodes,
            frames=sum(t.frames for t in tallies),
            pairs=sum(t.pairs for t in tallies),
            n_failed=sum(t.n_failed for t in tallies),
            counts=np.concatenate([np.zeros((0, 3), dtype=np.int64), *(t.counts for t in tallies)]),
            match_ms=np.concatenate([np.zeros(0), *(t.match_ms for t in tallies)]),
            scores=np.concatenate([np.zeros(0), *(t.scores for t in tallies)]),
            hits=np.concatenate([np.zeros(0, dtype=bool), *(t.hits for t in tallies)]),
            visible=sum(visible) if visible else None,
            positions_scored=any(t.positions_scored for t in tallies),
            errors_m=(sum(t.errors_m[0] for t in tallies), sum(t.errors_m[1] for t in tallies)),
            n_errors=sum(t.n_errors for t in tallies),
        )

    def row(self) -> dict[str, Any]:
        """The figures of one row."""
        correct, retrieved, common = (int(x) for x in sum(self.episodes.values(), np.zeros(3)))
        total = Counts(correct, retrieved, common)
        low, high = bootstrap_interval(self.episodes)
        row: dict[str, Any] = {
            "frames": self.frames,
            "pairs": self.pairs,
            "episodes": len(self.episodes),
            "precision": total.precision,
            "recall": total.recall,
            "f1": total.f1,
            "f1_low": low,
            "f1_high": high,
            "f1_per_pair": _number(f1_per_pair(self.counts)),
            "recall_at_95_precision": recall_at_precision(self.scores, self.hits, common, 0.95),
            "ece": _number(expected_calibration_error(self.scores, self.hits)),
            "match_ms": float(np.median(self.match_ms)) if self.pairs else None,
            "n_correct": correct,
            "n_retrieved": retrieved,
            "n_covisible": common,
            "n_failed": self.n_failed,
        }
        if self.visible is not None:
            row |= {"n_visible": self.visible, "scene_recall": correct / self.visible if self.visible else 0.0}
        if self.positions_scored:
            single, fused = self.errors_m
            row |= {
                "displacement_single_m": single / self.n_errors if self.n_errors else None,
                "displacement_fused_m": fused / self.n_errors if self.n_errors else None,
            }
        return row


def tallies(table: pa.Table) -> dict[str, Tally]:
    """By method, of records as `to_table` makes them."""
    methods = table["method"].unique().to_pylist()
    return {method: Tally.of(table.filter(pc.equal(table["method"], method))) for method in methods}


def failures(records: Sequence[Record]) -> dict[str, str]:
    """By method that failed on some pair, of what it did first."""
    found: dict[str, str] = {}
    for record in records:
        if record.failure is not None:
            found.setdefault(record.method, record.failure)
    return found


def summarise(records: Sequence[Record]) -> dict[str, Any]:
    """The figures of one row: pooled over the records of one target and one method."""
    return Tally.of(to_table(records)).row()


def _flat(table: pa.Table, column: str) -> NDArray[np.float64]:
    """The values of a column of lists, one after the other."""
    return pc.list_flatten(table[column]).to_numpy()


def _number(value: float) -> float | None:
    """NaN has no place in JSON."""
    return None if np.isnan(value) else value
