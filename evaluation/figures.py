"""Figures for the documentation and for reports, by matplotlib (extra `viz`)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .methods import EVALUATION_ONLY
from .report import paper

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Row = dict[str, Any]

OURS = "#0072b2"
OTHERS = ("#e69f00", "#009e73", "#d55e00", "#cc79a7", "#8c564b", "#7f7f7f", "#bcbd22", "#9467bd", "#e377c2", "#444444")
MARKERS = "osD^vP*Xdph<>8"


def _figure(panels: int = 1, width: float = 5.2, height: float = 3.8) -> tuple[Figure, Any]:
    """A figure that no window and no global state knows of, its panels in rows of at most four."""
    from matplotlib.figure import Figure

    columns, rows = min(panels, 4), -(-panels // 4)
    figure = Figure(figsize=(width * columns, height * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for unused in axes[panels:]:
        unused.remove()
    axes = axes[:panels]
    for axis in axes:
        axis.spines[["top", "right"]].set_visible(False)
        axis.grid(alpha=0.25, linewidth=0.6)
    return figure, axes


def save(figure: Figure, file: Path) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=120)


def sensitivity_figure(rows: Sequence[Row]) -> Figure:
    """F1 over lambda_1 and lambda_2, a panel per target; the published pair is framed."""
    targets = list(dict.fromkeys(row["target"] for row in rows))
    figure, axes = _figure(len(targets), 4.4, 3.4)
    for axis, target in zip(axes, targets, strict=True):
        own = [row for row in rows if row["target"] == target]
        first = sorted({row["uncertainty_weight"] for row in own})
        second = sorted({row["noncovisibility_weight"] for row in own})
        grid = np.full((len(first), len(second)), np.nan)
        for row in own:
            grid[first.index(row["uncertainty_weight"]), second.index(row["noncovisibility_weight"])] = row["f1"]
        axis.grid(False)
        axis.imshow(grid, cmap="viridis", aspect="auto", origin="lower")
        middle = 0.5 * (np.nanmin(grid) + np.nanmax(grid))
        for (i, j), value in np.ndenumerate(grid):
            color = "black" if value > middle else "white"
            axis.text(j, i, f"{value:.3f}"[1:], ha="center", va="center", fontsize=8, color=color)
        if 0.1 in first and 0.4 in second:
            at = (second.index(0.4) - 0.5, first.index(0.1) - 0.5)
            axis.add_patch(_frame(at))
        axis.set_xticks(range(len(second)), [f"{x:g}" for x in second])
        axis.set_yticks(range(len(first)), [f"{x:g}" for x in first])
        axis.set_xlabel(r"$\lambda_2$ (non-covisibility)")
        axis.set_ylabel(r"$\lambda_1$ (uncertainty)")
        axis.set_title(f"{target}: F1 of rgm", fontsize=10)
    return figure


def benchmark_figure(rows: Sequence[Row]) -> Figure:
    """Rows of `covis benchmark`: robustness where methods were disturbed, else F1 of every method on every target.

    Raises:
        ValueError: no rows.
    """
    if not rows:
        raise ValueError("there are no rows to draw")
    return robustness_figure(rows) if any(row["disturbance"] for row in rows) else f1_figure(rows)


def f1_figure(rows: Sequence[Row]) -> Figure:
    """F1 with its 95 % interval, a panel per experiment, best first; a diamond is the paper's value."""
    groups = list(dict.fromkeys(row["experiment"] for row in rows))
    figure, axes = _figure(len(groups), 3.6, 1.2 + 0.24 * max(Counter(r["experiment"] for r in rows).values()))
    for axis, group in zip(axes, groups, strict=True):
        own = sorted((row for row in rows if row["experiment"] == group), key=lambda row: row["f1"])
        for y, row in enumerate(own):
            color = OURS if row["method"] == "bayes" else "0.6" if row["method"] in EVALUATION_ONLY else "0.2"
            axis.plot([row["f1_low"], row["f1_high"]], [y, y], color=color, linewidth=1.4)
            axis.plot(row["f1"], y, "o", color=color, markersize=5)
            published = None if row["options"] else paper.published(row["target"], row["method"])
            if published is not None:
                axis.plot(paper.f1(published), y, "D", markersize=5, markerfacecolor="none", markeredgecolor="#d55e00")
        axis.set_yticks(range(len(own)), [_label(row) for row in own], fontsize=8)
        axis.set_xlim(0, 1.02)
        axis.set_xlabel("F1")
        axis.set_title(group, fontsize=10)
    return figure


def robustness_figure(rows: Sequence[Row]) -> Figure:
    """The paper's Fig. 7: precision (solid) and recall (dashed) against the rate, a panel per kind of disturbance."""
    kinds = list(dict.fromkeys(kind for row in rows for kind in row["disturbance"]))
    plain = [row for row in rows if not row["disturbance"] and row["method"] not in EVALUATION_ONLY]
    figure, axes = _figure(len(kinds), 3.4, 3.6)
    for axis, kind in zip(axes, kinds, strict=True):
        for k, base in enumerate(plain):
            own = [row for row in rows if _label(row) == _label(base) and set(row["disturbance"]) <= {kind}]
            own = [row for row in own if row["experiment"] == base["experiment"]]
            own.sort(key=lambda row: row["disturbance"].get(kind, 0.0))
            color = OURS if base["method"] == "bayes" else OTHERS[k % len(OTHERS)]
            rate = [100 * row["disturbance"].get(kind, 0.0) for row in own]
            for measure, line in (("precision", "-"), ("recall", "--")):
                label = _label(base) if measure == "precision" else None
                values = [row[measure] for row in own]
                axis.plot(rate, values, line, color=color, marker=MARKERS[k % len(MARKERS)], markersize=4, label=label)
        axis.set_xlabel(kind.replace("_", " ") + ", % more")
        axis.set_ylim(0, 1)
    axes[0].set_ylabel("precision (solid), recall (dashed)")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), fontsize=8, frameon=False)
    return figure


def _label(row: Row) -> str:
    options = ",".join(f"{key}={value}" for key, value in row["options"].items())
    return row["method"] + (f":{options}" if options else "")


def scaling_figure(rows: Sequence[Row]) -> Figure:
    """Time of a solve and peak memory against the number of objects, a line per method.

    Rows hold `what`, `n`, `ours` (solves per second) and, where measured, `memory_mib`.
    """
    methods = list(dict.fromkeys(row["what"] for row in rows))
    sizes = sorted({row["n"] for row in rows})
    figure, (time, memory) = _figure(2, 5.6, 4.2)
    for k, method in enumerate(methods):
        own = sorted((row for row in rows if row["what"] == method), key=lambda row: row["n"])
        style: dict[str, Any] = {"marker": MARKERS[k % len(MARKERS)], "markersize": 4, "linewidth": 1.1}
        style["color"] = OTHERS[k % len(OTHERS)]
        if method == "bayes":
            style |= {"color": OURS, "linewidth": 2.4, "zorder": 5}
        time.loglog([row["n"] for row in own], [1e3 / row["ours"] for row in own], label=method, **style)
        used = [row for row in own if row.get("memory_mib") is not None]
        memory.loglog([row["n"] for row in used], [max(row["memory_mib"], 0.1) for row in used], label=method, **style)
    time.set_ylabel("time of a solve, ms")
    memory.set_ylabel("peak memory above the start, MiB")
    for axis in (time, memory):
        axis.set_xlabel("objects a side")
        axis.set_xticks(sizes, [str(n) for n in sizes])
        axis.minorticks_off()
    memory.axhline(1024, color="0.6", linewidth=0.8, linestyle="--")
    memory.set_ylim(0.08, 2000)
    time.legend(fontsize=7, ncol=2, frameon=False)
    return figure


def team_figure(rows: Sequence[Row]) -> Figure:
    """Error of a robot on all it sees against the size of its team; rows of `covis localize team`."""
    sizes = sorted((row for row in rows if row.get("what") == "size"), key=lambda row: row["robots"])
    robots = [row["robots"] for row in sizes]
    figure, (error, nees) = _figure(2, 4.4, 3.4)
    for key, label, color in (
        ("fused_m", "mean", OURS),
        ("fused_median_m", "median", OTHERS[1]),
        ("fused_p95_m", "95 %", OTHERS[0]),
    ):
        error.plot(robots, [row[key] for row in sizes], marker="o", markersize=4, color=color, label=label)
    error.set_ylim(bottom=0)
    error.set_ylabel("displacement error, m")
    error.legend(fontsize=8, frameon=False)
    nees.axhspan(0.8, 1.2, color="0.9", zorder=0)
    nees.plot(robots, [row["nees_per_dof"] for row in sizes], marker="o", markersize=4, color=OURS)
    nees.set_ylim(0.5, 1.5)
    nees.set_ylabel("NEES per degree of freedom")
    for axis in (error, nees):
        axis.set_xlabel("robots")
        axis.set_xticks(robots)
    return figure


def reliability_figure(curves: dict[str, Sequence[Any]]) -> Figure:
    """Share of right matches against their score, a line per method; `curves` maps a name to its ReliabilityBins."""
    figure, (axis,) = _figure(1, 4.2, 4.0)
    axis.plot([0, 1], [0, 1], color="0.6", linewidth=0.8, linestyle="--")
    for k, (name, bins) in enumerate(curves.items()):
        axis.plot([b.score for b in bins], [b.accuracy for b in bins], marker=MARKERS[k % len(MARKERS)], label=name)
    axis.set_xlabel("mean score of the bin")
    axis.set_ylabel("share that was right")
    axis.legend(fontsize=8, frameon=False)
    return figure


def _frame(at: tuple[float, float]) -> Any:
    from matplotlib.patches import Rectangle

    return Rectangle(at, 1, 1, fill=False, edgecolor="red", linewidth=1.8)
