"""`covis report`: a run's folder as one HTML page and a Markdown table."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..evaluation.report import write_report
from .console import fail, out


def report(
    folder: Annotated[Path, typer.Argument(help="Folder of covis benchmark ... --out DIR.", metavar="DIR")],
) -> None:
    """Write DIR/report.html, one self-contained page, and DIR/report.md."""
    try:
        written = write_report(folder)
    except (ValueError, OSError) as error:
        fail(error)
    out.print(f"{written.html}\n{written.markdown}", highlight=False, soft_wrap=True)
