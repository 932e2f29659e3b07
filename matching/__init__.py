"""Who is who: correspondence between the detections of two robots.

    from covis.matching import METHODS, ObjectGraph, hungarian, reid

Every matcher is a function `(source, target, *, prior=None, rng=None, **options) -> Matching`.
"""

from .bayes import bayes
from .graph import Hypothesis, Matcher, Matching, ObjectGraph, PriorRequiredError
from .hungarian import hungarian
from .pose import RelativePose
from .registry import METHODS, load_matcher
from .reid import reid
from .rgm import rgm

__all__ = [
    "METHODS",
    "Hypothesis",
    "Matcher",
    "Matching",
    "ObjectGraph",
    "PriorRequiredError",
    "RelativePose",
    "bayes",
    "hungarian",
    "load_matcher",
    "reid",
    "rgm",
]
