"""The layout that a recording of `covis view` opens with: the world and the text, pairs of cameras, curves."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

from ..envs.colors import CANVAS
from ..matching.pose import Array
from .view_shapes import pair_path, part

FIGURES = {
    "precision": ("precision", True),
    "recall": ("recall", False),
    "fused": ("fused", True),
    "single": ("one robot", False),
}
"""Figure -> its name in the legend, and whether its curve is the strong one of its plot."""


def layout(
    robots: Sequence[str],
    pairs: Sequence[tuple[str, str]],
    methods: Sequence[str],
    figures: Collection[str],
    eye: tuple[Array, Array] | None,
) -> Any:
    """The blueprint.

    Args:
        robots: names of those seen.
        pairs: robots whose cameras are shown side by side.
        methods: labels; the first one's matches are visible at the start.
        figures: those of FIGURES that the recording has.
        eye: where the world is looked at from, and what point (3,), (3,) m.
    """
    import rerun.blueprint as rrb

    hidden = {
        f"{kind}/{part(label)}": rrb.EntityBehavior(visible=False)
        for label in methods[1:]
        for kind in ("/world/matches", "/world/estimates")
    }
    controls = None if eye is None else rrb.EyeControls3D(position=eye[0], look_target=eye[1], eye_up=(0, 0, 1))
    flat = [f"- /world/{part(robot)}/sensor/camera/boxes" for robot in robots]
    world = rrb.Spatial3DView(
        origin="/world",
        name="World",
        contents=["+ /world/**", *flat],
        overrides=hidden,
        eye_controls=controls,
        background=list(CANVAS),
    )
    left = rrb.Tabs(world, rrb.TextDocumentView(origin="/about", name="About"), active_tab="World")
    beside = [
        rrb.Spatial2DView(
            origin=pair_path(a, b),
            name=f"{a} and {b}",
            overrides={f"/{pair_path(a, b)}/{part(m)}": rrb.EntityBehavior(visible=False) for m in methods[1:]},
        )
        for a, b in pairs
    ]
    cameras = [rrb.Spatial2DView(origin=f"/world/{part(r)}/sensor/camera", name=r) for r in robots if pairs]
    plots = [
        rrb.TimeSeriesView(
            origin="/metrics",
            name=name,
            contents=[f"+ /metrics/{figure}/**" for figure in shown],
            axis_y=None if span is None else rrb.ScalarAxis(range=span),
            plot_legend=rrb.PlotLegend(corner),
        )
        for name, shown, span, corner in (
            ("Precision and recall", ("precision", "recall"), (0.0, 1.05), "LeftBottom"),
            ("Displacement error, m", ("fused", "single"), None, "LeftTop"),
        )
        if set(figures) & set(shown)
    ]
    pictures = [rrb.Tabs(*beside)] if pairs else []
    pictures += [rrb.Horizontal(*cameras)] if 0 < len(cameras) <= 3 else [rrb.Tabs(*cameras)] if cameras else []
    right = rrb.Vertical(*pictures, rrb.Horizontal(*plots))
    return rrb.Blueprint(
        rrb.Horizontal(left, right, column_shares=[1, 1]),
        rrb.TimePanel(timeline="frame", state="collapsed", fps=5, play_state="playing", loop_mode="all"),
        collapse_panels=True,
    )
