"""The folder of a run: Parquet shards of each finished unit, `run.json` about the run, `rows.json` at its end.

A shard appears whole, by an atomic rename, and carries checksums: one that a full disk or a crash has spoilt is
recognised, removed and made anew.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from .files import replacing, write_json

RUN, ROWS = "run.json", "rows.json"
RECORDS, PICTURES = "records", "pictures"
"""Folders of shards: a unit's records, and the frames that a report shows of it."""
FACTS = b"covis"
"""Key of a table's schema metadata: JSON about the unit, see `covis.evaluation.engine.RunOne`."""


@dataclass(frozen=True)
class Shards:
    """The output folder of one run of `n` units."""

    out: Path
    n: int

    def open(self, plan: Mapping[str, Any], session: Mapping[str, Any], *, resume: bool, overwrite: bool) -> None:
        """Make the folder, or go on with the run in it.

        Args:
            plan: what the run consists of; a folder is resumed with the same one only.
            session: provenance of this call, added to those of earlier ones in run.json.
            resume: keep the shards that are there.
            overwrite: remove the run that is there.

        Raises:
            FileExistsError: the folder holds another run, or this one and `resume` is off.
        """
        file = self.out / RUN
        plan = json.loads(json.dumps(plan))
        before = json.loads(file.read_text()) if file.exists() else {}
        if before and overwrite:
            shutil.rmtree(self.out / RECORDS, ignore_errors=True)
            (self.out / ROWS).unlink(missing_ok=True)
            before = {}
        if before and before.get("plan") != plan:
            raise FileExistsError(
                f"{self.out} holds a run with other targets, methods or settings; "
                "choose another --out, or give --overwrite"
            )
        if before and not resume:
            raise FileExistsError(f"{self.out} holds this run already; give --resume to go on with it, or --overwrite")
        for folder in (RECORDS, PICTURES):
            (self.out / folder).mkdir(parents=True, exist_ok=True)
        sessions = [*before.get("sessions", []), dict(session)]
        write_json(file, {"format": "covis-run", "version": 1, "sessions": sessions, "plan": plan})

    def close(self, rows: Mapping[str, Any], cost: Sequence[Mapping[str, Any]]) -> None:
        """Write rows.json, and what the run has cost into run.json."""
        write_json(self.out / ROWS, rows)
        write_json(self.out / RUN, json.loads((self.out / RUN).read_text()) | {"cost": cost})

    def finished(self) -> set[int]:
        """Numbers of the units whose shard is there and whole; spoilt shards are removed."""
        return {number for number in range(self.n) if self.file(number).exists() and self._whole(number)}

    def read(self, number: int, folder: str = RECORDS) -> pa.Table:
        return pq.read_table(self.file(number, folder), page_checksum_verification=True)

    def schema(self, number: int) -> pa.Schema:
        return pq.read_schema(self.file(number))

    def write(self, number: int, tables: Mapping[str, pa.Table]) -> None:
        """The records last: a unit whose records are there is finished."""
        for folder in sorted(tables, key=lambda name: name == RECORDS):
            self._write(tables[folder], self.file(number, folder))

    def file(self, number: int, folder: str = RECORDS) -> Path:
        return self.out / folder / f"unit-{number:05d}.parquet"

    def _write(self, table: pa.Table, file: Path) -> None:
        with replacing(file) as temporary, temporary.open("wb") as stream:
            pq.write_table(table, stream, write_page_checksum=True)
            stream.flush()
            os.fsync(stream.fileno())

    def _whole(self, number: int) -> bool:
        try:
            for folder in (RECORDS, PICTURES):
                self.read(number, folder)
        except (pa.ArrowException, OSError):
            self.file(number).unlink(missing_ok=True)
            return False
        return True


def facts(schema: pa.Schema) -> dict[str, Any]:
    """What the schema of a unit's records says about their making."""
    return json.loads((schema.metadata or {}).get(FACTS, b"{}"))


def with_facts(table: pa.Table, **about: Any) -> pa.Table:
    return table.replace_schema_metadata({FACTS: json.dumps(about).encode()})
