"""`covis report`: a run's folder as one self-contained HTML page and a Markdown table."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ..files import write_atomically
from . import markdown, page
from .run import RunFolderError, load

__all__ = ["Report", "RunFolderError", "write_report"]


@dataclass(frozen=True)
class Report:
    """The files that were written."""

    html: Path
    markdown: Path


def write_report(folder: Path) -> Report:
    """Write `report.html` and `report.md` into the folder of a run of `covis benchmark --out`.

    Raises:
        RunFolderError: the folder holds no readable run.
    """
    run = load(folder)
    report = Report(folder / "report.html", folder / "report.md")
    write_atomically(report.html, page.render(run).encode())
    write_atomically(report.markdown, markdown.text(run).encode())
    return report
