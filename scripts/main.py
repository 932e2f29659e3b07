"""The `covis` command: one file per subcommand."""

from __future__ import annotations

import typer

from .benchmark import benchmark
from .demo import demo

app = typer.Typer(
    name="covis",
    help="Collaborative multi-robot perception: environments, matching, fusion, benchmark.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
app.command()(demo)
app.command()(benchmark)


def main() -> None:
    app()
