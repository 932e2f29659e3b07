"""The `covis` command: one file per subcommand."""

from __future__ import annotations

import typer

from .benchmark import benchmark

app = typer.Typer(
    name="covis",
    help="Collaborative multi-robot perception: environments, matching, fusion, benchmark.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
app.command()(benchmark)


@app.callback()
def _root() -> None:
    """Keeps subcommands named even where there is only one."""


def main() -> None:
    app()
