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


def complain(error: BaseException | str) -> None:
    """One line on stderr."""
    err.print(f"[bold red]covis:[/] {_escape(str(error))}", highlight=False, soft_wrap=True)


def fail(error: BaseException | str) -> NoReturn:
    """One line on stderr, exit status 2."""
    complain(error)
    raise typer.Exit(2)


@contextmanager
def progress_bar(what: str) -> Iterator[Callable[[int, int], None]]:
    """A callback (done, total) that draws on stderr; silent where stderr is no terminal."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, TimeRemainingColumn(), console=err, transient=True, disable=not err.is_terminal) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def require_writable(*files: str | Path | None) -> None:
    """What a long run will be written to at its end is found out at its beginning; None and `-` are no files.

    Raises:
        OSError: a folder in a file's place, or no folder to put it into.
    """
    for file in (Path(f) for f in files if f is not None and str(f) != "-"):
        if file.is_dir():
            raise IsADirectoryError(f"{file} is a folder, not a file to write to")
        if not file.absolute().parent.is_dir():
            raise FileNotFoundError(f"there is no folder {file.parent} to write {file.name} into")


def require_writable_figure(file: Path) -> None:
    """A folder for it is made where there is none. Raises ValueError for a kind of picture that cannot be drawn."""
    from matplotlib.backend_bases import FigureCanvasBase

    kinds = FigureCanvasBase.get_supported_filetypes()
    if file.suffix.removeprefix(".") not in kinds:
        raise ValueError(f"a figure is written as .{', .'.join(sorted(kinds))}, not as {file.name!r}")


def write_rows(rows: Sequence[dict[str, Any]], json_target: str | None) -> None:
    """`{"rows": [...]}` to a file, or to standard output for `-`; nowhere for None."""
    write_json({"rows": list(rows)}, json_target)


def write_json(content: dict[str, Any], json_target: str | None) -> None:
    """JSON to a file, or to standard output for `-`; nowhere for None."""
    if json_target is None:
        return
    text = json.dumps(content, indent=1, allow_nan=False) + "\n"
    if json_target == "-":
        sys.stdout.write(text)
    else:
        Path(json_target).write_text(text, encoding="utf-8")


def _escape(text: str) -> str:
    return text.replace("[", r"\[")
