"""Suites: experiments as data, with explicit seeds. A change that alters results raises the suite's version."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from .comparison import Ordering
from .experiments import Experiment
from .settings import Settings
from .synthetic import PREFIX

TABLE_1 = ("rrwm", "icp", "bcagm", "rrwhm", "reid", "mos", "rgm-no-uncertainty", "rgm-no-covisibility", "rgm")
"""The nine methods of the paper's Table 1, in its order."""
BASELINES = ("oracle", "random")
"""In every suite: what is possible at all, and what chance does."""
ALL = (*TABLE_1, "bayes", "clipper", *BASELINES)

SPATIAL = ("rrwm", "icp", "bcagm", "rrwhm")
ABLATIONS = ("rgm-no-uncertainty", "rgm-no-covisibility")
TABLE_1_ORDER = (
    Ordering("the paper: spatial methods below ReId (but for S-MRC)", SPATIAL, ("reid",)),
    Ordering("the paper: spatial methods below MOS", SPATIAL, ("mos",)),
    Ordering("the paper: ReId and MOS below rgm", ("reid", "mos"), ("rgm",)),
    Ordering("the paper: rgm above both ablations", ABLATIONS, ("rgm",)),
    Ordering("ours: bayes above all others", (*TABLE_1, "clipper"), ("bayes",)),
)

FIVE_SEEDS = (1001, 1002, 1003, 1004, 1005)
RATES = (0.03, 0.06, 0.09, 0.12, 0.15)
NOISE_RATES = (0.25, 0.5, 1.0)


@dataclass(frozen=True)
class Suite:
    """Experiments that belong together.

    Attributes:
        id: its name on the command line.
        version: raised by every change that alters results.
        title: one line on what it is.
        experiments: what is run; every method of an experiment sees the same frames.
        disturbances: every method but the baselines, which heed no graph, is run under each of them (see
            `covis.evaluation.disturbance`); "" is none.
        orderings: what the results are held against.
    """

    id: str
    version: int
    title: str
    experiments: tuple[Experiment, ...]
    disturbances: tuple[str, ...] = ("",)
    orderings: tuple[Ordering, ...] = ()

    def plan(self, more_methods: Sequence[str] = (), **changes: Any) -> list[Experiment]:
        """The experiments as they are run: with further methods, and with `changes` of their settings."""
        return [self._planned(experiment, more_methods, changes) for experiment in self.experiments]

    def _planned(self, experiment: Experiment, more: Sequence[str], changes: dict[str, Any]) -> Experiment:
        methods = dict.fromkeys((*experiment.methods, *more))
        return replace(
            experiment,
            methods=tuple(m + d for d in self.disturbances for m in methods if not (d and m in BASELINES)),
            settings=replace(experiment.settings, **changes),
        )


def _scene(
    scene: str, methods: tuple[str, ...], settings: Settings, seeds: tuple[int, ...], name: str | None = None
) -> Experiment:
    return Experiment(name or scene, "scene", scene, methods, settings, seeds)


def _synthetic(problem: str, methods: tuple[str, ...], pairs: int, seeds: tuple[int, ...]) -> Experiment:
    return Experiment(PREFIX + problem, "synthetic", problem, methods, Settings(episodes=pairs), seeds)


FROM_PIXELS = Settings(preset="paper", perception="learned", episodes=10)

SUITES: dict[str, Suite] = {
    "paper-table1": Suite(
        "paper-table1",
        1,
        "Table 1: three scenes, nine methods and ours, five runs of ten videos of 5 s, poses unknown, from pixels",
        (
            _scene("connected_driving", ALL, FROM_PIXELS, FIVE_SEEDS),
            _scene("multi_robot", ALL, FROM_PIXELS, FIVE_SEEDS),
            _scene("aerial_ground", ALL, FROM_PIXELS, FIVE_SEEDS),
        ),
        orderings=TABLE_1_ORDER,
    ),
    "paper-fig7": Suite(
        "paper-fig7",
        1,
        "Fig. 7: reported uncertainty 0 to 15 % higher, in attributes and in positions; and the noise itself higher",
        (_scene("connected_driving", ("mos", "rgm", "bayes", *BASELINES), FROM_PIXELS, (1101, 1102)),),
        (
            "",
            *(f"@attribute_uncertainty={rate}" for rate in RATES),
            *(f"@position_uncertainty={rate}" for rate in RATES),
            *(f"@attribute_noise={rate}" for rate in NOISE_RATES),
            *(f"@position_noise={rate}" for rate in NOISE_RATES),
        ),
    ),
    "paper-case-study": Suite(
        "paper-case-study",
        1,
        "Section 4.5: two observers, two targets, look-alike obstacles; poses known; single robots against fused",
        (
            _scene(
                "target_localization",
                (*TABLE_1, "bayes", "hungarian", "clipper", *BASELINES),
                Settings(pose="known", preset="paper", perception="learned", episodes=10),
                (1201, 1202, 1203),
            ),
        ),
    ),
    "paper-runtime": Suite(
        "paper-runtime",
        1,
        "Section 4.2: time of a solve at n = 15 with 200 proposals, one chain and parallel ones, and all other methods",
        (
            _synthetic(
                "n15",
                (
                    "rgm:proposals=200",
                    "rgm:proposals=200,workers=2",
                    *(m for m in ALL if m != "rgm"),
                ),
                60,
                (1301,),
            ),
        ),
    ),
    "matching-synthetic": Suite(
        "matching-synthetic",
        1,
        "Graphs generated on the spot: three kinds of place, four difficulties, no simulator",
        tuple(
            _synthetic(f"{place}-{difficulty}", ALL, 200, (1401,))
            for place in ("cad", "smrc", "rmrc")
            for difficulty in ("hard", "mid", "moderate", "mixed")
        ),
        orderings=TABLE_1_ORDER,
    ),
    "scaling-robots": Suite(
        "scaling-robots",
        1,
        "Two to six robots that look at one team: matches per pair of robots, and what fusing all of them gains",
        tuple(
            _scene(
                "multi_robot",
                ("mos", "rgm", "bayes", *BASELINES),
                Settings(preset="easy", perception="simulated", episodes=10, n_robots=n),
                (1501,),
                f"multi_robot-{n}",
            )
            for n in (2, 3, 4, 5, 6)
        ),
    ),
    "quick": Suite(
        "quick",
        1,
        "About a minute: two scenes and generated graphs",
        (
            *(
                _scene(
                    scene,
                    ("reid", "rgm", "bayes", *BASELINES),
                    Settings(preset="easy", perception="simulated", episodes=3),
                    (1601,),
                )
                for scene in ("multi_robot", "aerial_ground")
            ),
            _synthetic("cad-mid", ("reid", "rgm", "bayes", *BASELINES), 60, (1601,)),
        ),
    ),
}
