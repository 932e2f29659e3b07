"""`covis speed`: rates against peers, measured alternately in one process on one thread."""

from __future__ import annotations

import os
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import typer

from ..evaluation.extras import require
from ..evaluation.figures import save, scaling_figure
from ..evaluation.memory_matching import add_memory
from .console import fail, out, progress_bar, require_writable, require_writable_figure, write_rows
from .tables import Column, print_rows, words

AREAS = {
    "matching": ("speed_matching", None),
    "envs": ("speed_envs", "envs"),
    "fusion": ("speed_fusion", None),
    "perception": ("speed_perception", "learned"),
}
MEMORY: dict[str, str] = {"envs": "memory_envs", "matching": "memory_matching"}


def speed(
    area: Annotated[str, typer.Argument(help=f"{' | '.join(AREAS)}.")],
    json_target: Annotated[str | None, typer.Option("--json", help="Write rows to FILE; - prints them.")] = None,
    figure: Annotated[Path | None, typer.Option(help="matching: figure of time and memory against size.")] = None,
    memory: Annotated[
        bool,
        typer.Option(
            "--memory", help="Instead: envs, growth over resets and steps; matching, peak at the largest size accepted."
        ),
    ] = False,
    resets: Annotated[int, typer.Option(help="envs --memory: resets of each scene.")] = 1_000,
    steps: Annotated[int, typer.Option(help="envs --memory: steps of each scene.")] = 100_000,
    scene: Annotated[
        list[str] | None, typer.Option(help="envs --memory: only this scene; may be given several times.")
    ] = None,
) -> None:
    """Rates per second against peers, side by side in this process, on one thread."""
    if area not in AREAS:
        fail(f"no area is called {area!r}; there are {', '.join(AREAS)}")
    if memory and area not in MEMORY:
        fail(f"--memory is for {' and '.join(MEMORY)}, not for {area}")
    if scene and not (memory and area == "envs"):
        fail(f"--scene is for envs --memory, not for {area}{' --memory' if memory else ''}")
    if figure is not None and (memory or area != "matching"):
        fail(f"--figure is for matching without --memory, not for {area}{' --memory' if memory else ''}")
    module, extra = AREAS[area]
    # Before the libraries that read them are imported.
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ[variable] = "1"
    try:
        if extra is not None:
            require(extra)
        if memory:
            measure = import_module(f"covis.evaluation.{MEMORY[area]}").rows
            if area == "envs":
                measure = partial(measure, resets=resets, steps=steps, **({"scenes": scene} if scene else {}))
        else:
            measure = import_module(f"covis.evaluation.{module}").rows
        require_writable(json_target)
        if figure is not None:
            require("viz")
            require_writable_figure(figure)
        with progress_bar(f"speed {area}") as progress:
            rows = measure(progress)
        if figure is not None:
            rows = add_memory(rows)
            save(scaling_figure(rows), figure)
    except (ValueError, RuntimeError, OSError) as error:
        fail(error)
    write_rows(rows, json_target)
    if json_target != "-":
        print_speed(rows)


COLUMNS = (
    Column("what", words("what"), label=True),
    Column("n", words("n")),
    Column("ours", lambda row: _quantity(row["ours"], row["unit"])),
    Column("peer's", lambda row: "" if row["peer_value"] is None else _quantity(row["peer_value"], row["unit"])),
    Column("ratio", lambda row: _ratio(row["ratio"], row["unit"])),
)


def print_speed(rows: list[dict[str, Any]]) -> None:
    """The rows for a person, and below them who the peers are."""
    print_rows(rows, COLUMNS)
    for peer in dict.fromkeys(row["peer"] for row in rows if row["peer"]):
        against = ", ".join(dict.fromkeys(row["what"] for row in rows if row["peer"] == peer))
        out.print(f"peer of {against}: {peer}", highlight=False, soft_wrap=True)


def _ratio(ratio: float | None, unit: str) -> str:
    return "" if ratio is None else f"{ratio:.1f}x" if unit == "1/s" else f"{ratio - 1:+.2%}"


def _quantity(value: float, unit: str) -> str:
    return f"{value:.4g}/s" if unit == "1/s" else f"{value:.1f} {unit}"
