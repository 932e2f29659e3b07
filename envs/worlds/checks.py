"""What generators refuse: errors that name the parameter, what it must be and what it is."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection
from typing import Any

import numpy as np

Range = tuple[float, float]


def require(ok: bool, name: str, value: object, wanted: str) -> None:
    """Raise ValueError naming a parameter, what it must be and what it is, unless `ok`."""
    if not ok:
        raise ValueError(f"{name} must be {wanted}, got {value!r}")


def check_fields(params: Any) -> None:
    """Raise ValueError naming the first field of a dataclass that is not of its kind: whole, finite, (low, high)."""
    for field in dataclasses.fields(params):
        _check_field(field.name, str(field.type), getattr(params, field.name))


def check_names(name: str, value: object, known: Collection[str]) -> None:
    """Raise ValueError unless a parameter is a non-empty tuple or list of names, all `known`."""
    named = isinstance(value, tuple | list) and len(value) > 0 and all(isinstance(x, str) and x in known for x in value)
    require(named, name, value, f"a tuple of some of {', '.join(known)}")


def check_preset(scene: str, name: str, known: Collection[str]) -> str:
    """The name of a preset. Raises ValueError naming the scene and what it has, unless it is `known`."""
    if name not in known:
        raise ValueError(f"unknown preset {name!r}; {scene} has {', '.join(known)}")
    return name


def _check_field(name: str, kind: str, value: object) -> None:
    if kind == "int":
        require(_whole(value), name, value, "a whole number, not negative")
    elif kind == "float":
        require(_finite(value), name, value, "a finite number")
    elif kind in ("Range", "tuple[int, int]"):
        number, what = (_whole, "whole numbers") if kind != "Range" else (_finite, "finite numbers")
        pair = isinstance(value, tuple) and len(value) == 2 and all(map(number, value)) and value[0] <= value[1]
        require(pair, name, value, f"a pair (low, high) of {what} with low <= high")
        if isinstance(value, tuple) and not name.endswith("_deg"):
            require(value[0] >= 0, name, value, "a pair of non-negative numbers")


def _finite(value: object) -> bool:
    return isinstance(value, int | float | np.number) and not isinstance(value, bool) and math.isfinite(value)


def _whole(value: object) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool) and bool(value >= 0)
