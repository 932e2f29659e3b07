"""The `covis` command: one file per subcommand."""

from __future__ import annotations

import sys
from importlib import metadata
from typing import Annotated

import typer

from .benchmark import benchmark
from .demo import demo
from .export_data import app as export_data
from .import_data import app as import_data
from .localize import localize
from .record import check, record
from .report import report
from .sensitivity import sensitivity
from .speed import speed
from .train import app as train
from .tune import tune
from .view import view


def _version(asked: bool) -> None:
    if asked:
        print(f"covis {metadata.version('covis')}")
        raise typer.Exit


app = typer.Typer(
    name="covis",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
app.command()(demo)
app.command()(benchmark)
app.command()(record)
app.command()(check)
app.command()(report)
app.command()(view)
app.command()(localize)
app.command()(speed)
app.command()(sensitivity)
app.command()(tune)
app.add_typer(import_data, name="import")
app.add_typer(export_data, name="export")
app.add_typer(train, name="train")


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", help="The installed version.", is_eager=True, callback=_version)
    ] = False,
) -> None:
    """Collaborative multi-robot perception: environments, matching, fusion, benchmark."""


def main() -> None:
    sys.path.append("")  # so that `--method mine:match` finds mine.py of the folder where it is called
    app()
