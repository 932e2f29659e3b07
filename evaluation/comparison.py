"""Methods against each other on the same frames: differences of F1 to `bayes`, to the best, to undisturbed input."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

from .methods import EVALUATION_ONLY, Method
from .statistics import Array, paired_difference

REFERENCE = "bayes"


@dataclass(frozen=True, eq=False)
class Entry:
    """One method's row, and correct, retrieved, common (3,) of each of its episodes."""

    method: Method
    row: dict[str, Any]
    sums: Mapping[Hashable, Array]

    @property
    def competes(self) -> bool:
        return self.method.name not in EVALUATION_ONLY and bool(self.sums)


@dataclass(frozen=True)
class Ordering:
    """Somebody's word on F1: every method of `higher` is ahead of every method of `lower`."""

    says: str
    lower: tuple[str, ...]
    higher: tuple[str, ...]


BORNE_OUT, CONTRADICTED, OPEN = "borne out", "contradicted", "open"


def judged(ordering: Ordering, entries: Sequence[Entry]) -> dict[str, Any]:
    """What the data say of an ordering, in one experiment.

    Returns:
        `says`; `verdict`: "borne out" where every pair differs as said and by more than noise, "contradicted" where
        some pair differs the other way by more than noise, else "open"; `pairs`: for each, `higher`, `lower`,
        `difference` of F1 with `low`, `high` and `p_value`.
    """
    known = {e.method.label: e for e in entries if e.sums}
    pairs = []
    verdict = BORNE_OUT
    for high, low in product(ordering.higher, ordering.lower):
        if high not in known or low not in known:
            return {"says": ordering.says, "verdict": OPEN, "pairs": []}
        d = paired_difference(known[high].sums, known[low].sums)
        if not d.noise and d.value < 0:
            verdict = CONTRADICTED
        elif d.noise and verdict == BORNE_OUT:
            verdict = OPEN
        pairs.append(
            {"higher": high, "lower": low, "difference": d.value, "low": d.low, "high": d.high, "p_value": d.p_value}
        )
    return {"says": ordering.says, "verdict": verdict, "pairs": pairs}


def compared(entries: Sequence[Entry]) -> list[dict[str, Any]]:
    """The rows of one experiment, with what sets them apart.

    Where `bayes` runs without options: `f1_minus_bayes` with `_low`, `_high` and `p_value`; the highest F1 of those
    under the same disturbance: `f1_minus_best` with `_low`, `_high`, `p_value_best`, and `ties_best`, true for the best
    and for every method that noise alone may separate from it; under a disturbance: `f1_minus_undisturbed` with `_low`,
    `_high`, `p_value_undisturbed`. The oracle and chance are never the best.
    """
    return [entry.row | _compared(entry, entries) for entry in entries]


def _compared(entry: Entry, entries: Sequence[Entry]) -> dict[str, Any]:
    peers = [e for e in entries if e.competes and e.method.disturbance == entry.method.disturbance]
    found: dict[str, Any] = {}
    reference = [e for e in peers if e.method.name == REFERENCE and not e.method.options]
    if reference:
        found |= _difference(entry, reference[0], "f1_minus_bayes", "p_value")
    if peers:
        best = max(peers, key=lambda e: e.row["f1"])
        found |= _difference(entry, best, "f1_minus_best", "p_value_best")
        found["ties_best"] = entry.competes and (entry is best or _noise(entry, best))
    if entry.method.disturbance.rates():
        base = [e for e in entries if _same_but_undisturbed(e.method, entry.method)]
        if base:
            found |= _difference(entry, base[0], "f1_minus_undisturbed", "p_value_undisturbed")
    return found


def _difference(entry: Entry, other: Entry, key: str, p_key: str) -> dict[str, Any]:
    if entry is other or entry.sums.keys() != other.sums.keys() or not entry.sums:
        return {key: 0.0 if entry is other else None, f"{key}_low": None, f"{key}_high": None, p_key: None}
    d = paired_difference(entry.sums, other.sums)
    return {key: d.value, f"{key}_low": d.low, f"{key}_high": d.high, p_key: d.p_value}


def _noise(entry: Entry, best: Entry) -> bool:
    return entry.sums.keys() == best.sums.keys() and paired_difference(entry.sums, best.sums).noise


def _same_but_undisturbed(base: Method, method: Method) -> bool:
    same = base.name == method.name and dict(base.options) == dict(method.options)
    return same and not base.disturbance.rates()
