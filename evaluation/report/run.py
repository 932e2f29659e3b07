"""A run's folder, read for its report: rows, records, pages, and where they come from."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from ..comparison import Entry as Compared
from ..comparison import compared
from ..methods import EVALUATION_ONLY, Method
from ..pictures import Page
from ..pictures import from_table as pages_from_table
from ..records import Record, summarise
from ..records import from_table as records_from_table
from ..shards import PICTURES, RECORDS, ROWS, RUN, Shards
from ..statistics import episode_sums
from .styles import numbered

NEEDED = ("target", "experiment", "method", "options", "episodes", "f1", "f1_low", "f1_high", "ece", "match_ms")
"""Columns of a row without which there is no report."""


class RunFolderError(ValueError):
    """A folder that holds no readable run; the message names the file."""


@dataclass(frozen=True, eq=False)
class Entry:
    """One method of one experiment: the number by which its looks go, its row of figures, the records behind it."""

    method: int
    label: str
    row: dict[str, Any]
    records: list[Record]

    @property
    def baseline(self) -> bool:
        """The oracle and chance take no part in the competition."""
        return self.row["method"] in EVALUATION_ONLY

    @property
    def f1(self) -> float:
        return float(self.row["f1"])

    def difference(self, to: str) -> tuple[float, float, float] | None:
        """F1 less that of `best` or `bayes`, and its 95 % interval; None for that one itself, or without it."""
        values = [self.row.get(f"f1_minus_{to}{end}") for end in ("", "_low", "_high")]
        return None if None in values else (float(values[0]), float(values[1]), float(values[2]))  # type: ignore[arg-type]

    @property
    def level(self) -> bool:
        """Noise alone may separate it from the best, or it is the best."""
        return bool(self.row.get("ties_best"))


@dataclass(frozen=True, eq=False)
class Group:
    """One experiment with every method: a table of the leaderboard, a panel of each figure.

    `target` is what its rows call it; `name` is that too, or its id where a target has several experiments. `disturbed`
    are those of its methods that also run undisturbed, among the other `entries`.
    """

    number: int
    id: str
    kind: str
    name: str
    target: str
    settings: dict[str, Any]
    seeds: list[int]
    entries: list[Entry]
    disturbed: list[Entry]
    pages: list[Page]

    @property
    def competitors(self) -> list[Entry]:
        return [entry for entry in self.entries if not entry.baseline]

    @property
    def best(self) -> Entry:
        """Highest F1; which is not to say that it won."""
        return max(self.competitors or self.entries, key=lambda entry: entry.f1)


@dataclass(frozen=True, eq=False)
class Run:
    """A whole run. `methods` maps every label to the number by which its looks go; `sessions` say how it was made."""

    folder: Path
    suite: str | None
    groups: list[Group]
    methods: dict[str, int]
    sessions: list[dict[str, Any]]
    n_units: int
    n_finished: int


def load(folder: Path) -> Run:
    """Read the folder of a `covis benchmark ... --out DIR`, finished or not.

    Raises:
        RunFolderError: no run there, nothing finished yet, or a file that cannot be read.
    """
    config = _json(folder / RUN)
    try:
        plan = config["plan"]
        experiments, units = list(plan["experiments"]), list(plan["units"])
        sessions = list(config["sessions"])
    except (KeyError, TypeError) as error:
        raise RunFolderError(f"{folder / RUN} is not of a run of covis benchmark: {error!r}") from error
    shards = Shards(folder, len(units))
    finished = [number for number in range(len(units)) if shards.file(number).exists()]
    if not finished:
        raise RunFolderError(f"{folder / RECORDS} holds no records yet")
    rows = _written_rows(folder / ROWS)
    methods = numbered(list(dict.fromkeys(undisturbed(label) for e in experiments for label in e["methods"])))
    groups: list[Group] = []
    for experiment in experiments:
        own = [number for number in finished if units[number][0] == experiment["id"]]
        if own:
            groups.append(_group(len(groups), experiment, methods, rows, [_shard(shards, n) for n in own]))
    suite = f"{plan['suite']} (version {plan.get('suite_version')})" if plan.get("suite") else None
    return Run(folder, suite, groups, methods, sessions, len(units), len(finished))


def _shard(shards: Shards, number: int) -> tuple[list[Record], list[Page]]:
    pictures = shards.file(number, PICTURES)
    pages = pages_from_table(_table(pictures)) if pictures.exists() else []
    return records_from_table(_table(shards.file(number))), pages


def _group(
    number: int,
    experiment: dict[str, Any],
    methods: Mapping[str, int],
    rows: Sequence[dict[str, Any]],
    shards: Sequence[tuple[list[Record], list[Page]]],
) -> Group:
    records = [record for found, _ in shards for record in found]
    # A run that is not finished has no rows.json yet.
    told = [row for row in rows if row["experiment"] == experiment["id"]] or _rows(experiment, records)
    entries = [
        Entry(methods[undisturbed(label)], label, row, [r for r in records if r.method == label])
        for label, row in zip(experiment["methods"], told, strict=True)
    ]
    target = str(told[0]["target"])
    # Beside its undisturbed self a disturbed method is a point of a curve; alone it is a method like others.
    disturbed = [
        e for e in entries if undisturbed(e.label) != e.label and undisturbed(e.label) in experiment["methods"]
    ]
    return Group(
        number=number,
        id=str(experiment["id"]),
        kind=str(experiment["kind"]),
        name=target if experiment["kind"] == "dataset" else str(experiment["id"]),
        target=target,
        settings=dict(experiment["settings"]),
        seeds=list(experiment["seeds"]),
        entries=[e for e in entries if e not in disturbed],
        disturbed=disturbed,
        pages=[page for _, found in shards for page in found],
    )


def _written_rows(file: Path) -> list[dict[str, Any]]:
    """Rows of a finished run, none of another."""
    rows = list(_json(file)["rows"]) if file.exists() else []
    for row in rows:
        missing = [key for key in NEEDED if key not in row]
        if missing:
            raise RunFolderError(f"{file}: a row of {row.get('target')} has no {missing[0]!r}; another version's?")
    return rows


def undisturbed(label: str) -> str:
    """The method, without the disturbance of what it gets to see."""
    return label.partition("@")[0]


def _rows(experiment: dict[str, Any], records: Sequence[Record]) -> list[dict[str, Any]]:
    """Rows as the finished run will have them, over what is there."""
    entries = []
    for label in experiment["methods"]:
        method, own = Method.parse(label), [r for r in records if r.method == label]
        sums = episode_sums([(r.seed, r.episode) for r in own], [r.counts for r in own])
        names = {"target": records[0].target if records else experiment["target"], "method": method.name}
        more = {"options": dict(method.options), "disturbance": method.disturbance.rates(), "episodes": len(sums)}
        entries.append(Compared(method, names | more | summarise(own), sums))
    return compared(entries)


def _json(file: Path) -> Any:
    try:
        return json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise RunFolderError(f"{file} is missing: the folder holds no run of covis benchmark") from error
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise RunFolderError(f"{file} is not JSON: {error}") from error


def _table(file: Path) -> pa.Table:
    try:
        return pq.read_table(file, page_checksum_verification=True)
    except (pa.ArrowException, OSError) as error:
        raise RunFolderError(f"{file} cannot be read as Parquet (truncated or corrupt?): {error}") from error
