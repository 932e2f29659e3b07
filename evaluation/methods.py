"""From the text of `--method` to something the runner can call, evaluation-only baselines included."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..matching import Matcher, Matching, bayes, load_matcher
from .disturbance import Disturbance

EVALUATION_ONLY = ("oracle", "oracle-pose", "random")
"""The true matches; `bayes` that knows the true relative pose; chance."""


@dataclass(frozen=True)
class Method:
    """A matcher by name, with its options. `label` is the text it came from.

    `disturbance` makes the graphs worse that it gets to see, the same way for every method of that disturbance.
    """

    label: str
    name: str
    options: Mapping[str, Any] = field(default_factory=dict)
    disturbance: Disturbance = field(default_factory=Disturbance)

    @classmethod
    def parse(cls, text: str) -> Method:
        """`name`, `name:option=value,...`, `package.module:callable` or `package.module:callable:option=value,...`.

        Each of them may end in a disturbance, `@position_uncertainty=0.1,attribute_noise=0.5`.

        Raises:
            ValueError: an empty name, a malformed option, an unknown disturbance.
        """
        plain, at, disturbance = text.partition("@")
        head, separator, tail = plain.rpartition(":")
        name, options = (head, tail) if separator and "=" in tail else (plain, "")
        if not name or (at and not disturbance):
            raise ValueError(f"--method {text!r} names no {'disturbance after @' if name else 'method'}")
        return cls(text, name, _options(options, text), Disturbance.of(_options(disturbance, text)))

    def check(self) -> None:
        """Raises ValueError where there is no such matcher, or it does not take these options."""
        matcher = self.load()
        if matcher is None:
            taken: set[str] = set()
        else:
            try:
                parameters = inspect.signature(matcher).parameters.values()
            except ValueError:  # some builtins have none
                return
            if any(p.kind is p.VAR_KEYWORD for p in parameters):
                return
            taken = {p.name for p in parameters if p.kind is not p.POSITIONAL_ONLY}
        taken -= {"source", "target", "prior", "rng"}
        for option in self.options:
            if option not in taken:
                known = f"its options are {', '.join(sorted(taken))}" if taken else "it has none"
                raise ValueError(f"--method {self.label!r}: {self.name} has no option {option!r}; {known}")

    def load(self) -> Matcher | None:
        """The matcher, or None for `oracle` and `random`, which are none."""
        if self.name in EVALUATION_ONLY:
            return bayes if self.name == "oracle-pose" else None
        return _loaded(self.name)


@cache
def _loaded(name: str) -> Matcher:
    """Looking through installed packages takes longer than many a solve."""
    return load_matcher(name)


def oracle(source_identity: NDArray[np.int64], target_identity: NDArray[np.int64]) -> Matching:
    """The true matching of two views: every detection of an object that both detected."""
    common, i, j = np.intersect1d(source_identity, target_identity, return_indices=True)
    real = common >= 0
    return Matching(np.stack([i[real], j[real]], axis=1), np.ones(int(real.sum())))


def random_matching(n: int, m: int, rng: np.random.Generator) -> Matching:
    """As many matches as fit between n and m detections, drawn uniformly; each is right with chance 1/max(n, m)."""
    k = min(n, m)
    if k == 0:
        return Matching.empty()
    pairs = np.stack([rng.permutation(n)[:k], rng.permutation(m)[:k]], axis=1)
    return Matching(pairs, np.full(k, 1.0 / max(n, m)))


def _options(text: str, whole: str) -> dict[str, Any]:
    options: dict[str, Any] = {}
    for part in filter(None, text.split(",")):
        key, separator, value = part.partition("=")
        if not separator or not key.isidentifier():
            raise ValueError(f"--method {whole!r}: {part!r} is not option=value")
        options[key] = _value(value)
    return options


def _value(text: str) -> Any:
    """A Python literal where it is one, else the text itself."""
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError):
        return {"true": True, "false": False, "none": None}.get(text.lower(), text)
