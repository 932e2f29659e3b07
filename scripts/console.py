"""What every subcommand shares: progress, errors in one line, JSON out."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

err = Console(stderr=True)
out = Console() if Console().is_terminal else Console(width=180)


def fail(error: BaseException | str) -> NoReturn:
    """One line on stderr, exit status 2."""
    err.print(f"[bold red]covis:[/] {_escape(str(error))}", highlight=False, soft_wrap=True)
    raise typer.Exit(2)


@contextmanager
def progress_bar(what: str) -> Iterator[Callable[[int, int], None]]:
    """A callback (done, total) that draws on stderr; silent where stderr is no terminal."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, TimeRemainingColumn(), console=err, transient=True, disable=not err.is_terminal) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def write_rows(rows: Sequence[dict[str, Any]], json_target: str | None) -> None:
    """`{"rows": [...]}` to a file, or to standard output for `-`."""
    if json_target is None:
        return
    text = json.dumps({"rows": list(rows)}, indent=1, allow_nan=False)
    if json_target == "-":
        sys.stdout.write(text + "\n")
    else:
        Path(json_target).write_text(text + "\n", encoding="utf-8")


def _escape(text: str) -> str:
    return text.replace("[", r"\[")
