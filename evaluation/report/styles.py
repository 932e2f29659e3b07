"""How methods look: a number per method, the same in every report, that stands for a colour and a mark."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

PALETTE = (
    ("bayes", "#0b62a4", "#5cb0f0"),
    ("rgm", "#c8500a", "#ff9350"),
    ("rgm-no-uncertainty", "#b8860b", "#e6b84a"),
    ("rgm-no-covisibility", "#8a6d3b", "#c9ab74"),
    ("reid", "#b0508a", "#e48cc0"),
    ("mos", "#00805f", "#3cc79f"),
    ("rrwm", "#2a9fd0", "#8ad4f5"),
    ("icp", "#7b5aa6", "#b79be0"),
    ("bcagm", "#8c3a3a", "#d98a8a"),
    ("rrwhm", "#6b7f1f", "#b5c75a"),
    ("clipper", "#30505f", "#9db9c9"),
    ("hungarian", "#a03070", "#e878b4"),
    ("oracle", "#555555", "#c4c4c4"),
    ("random", "#9a9a9a", "#8a8a8a"),
)
"""Colours of known methods, light and dark, the same in every report; marks and dashes tell apart what they do not."""
SPARE = (
    ("#0072b2", "#56b4e9"),
    ("#d55e00", "#ff9350"),
    ("#009e73", "#3cc79f"),
    ("#cc79a7", "#e48cc0"),
    ("#7a6a00", "#e6c84a"),
)


def numbered(labels: Sequence[str]) -> dict[str, int]:
    """A number per label: that of a known method is its place in the palette, others follow after it."""
    known = {name: number for number, (name, _, _) in enumerate(PALETTE)}
    others = [label for label in labels if label not in known]
    return {label: known.get(label, len(PALETTE) + others.index(label) if label in others else 0) for label in labels}


def rules(methods: Mapping[str, int]) -> str:
    """A CSS rule per method."""
    return "\n".join(_rule(label, number) for label, number in methods.items())


def _rule(label: str, number: int) -> str:
    light, dark = PALETTE[number][1:] if number < len(PALETTE) else SPARE[number % len(SPARE)]
    dash = ";--dash:5 3" if label.startswith("rgm-") else ";--dash:2 3" if label in ("oracle", "random") else ""
    width = ";--width:2.6" if label == "bayes" else ""
    return f".c{number}{{--light:{light};--dark:{dark}{dash}{width}}}"
