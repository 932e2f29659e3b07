"""Every method on every pair of robots of a scene's episodes, from pixels to displacement error.

All methods see the same frames: the robots move by the scene's own scripted controllers, which no claim influences, and
each robot's eyes look once per step. Claims are scored by the environment's own rules.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..agents.controllers import scripted_controls
from ..agents.localizer import Matchings, View, claims, look, relative_pose
from ..agents.perception import Perceptor, make_perceptor
from ..agents.perception.simulated import OCCLUSION, measure
from ..envs.claims import Claims, silent_actions
from ..envs.collaborative import CollaborativeEnv
from ..envs.scenes import parallel_env
from ..envs.scoring import PairScore, StepScore, Truth, score, tie
from ..matching.pose import invert, transform
from .matching_run import PairTruth, attempt
from .methods import Method
from .pictures import Page, PictureBook, Result, Sight, jpeg, rounded
from .records import Record
from .sequence import PairTrackers
from .settings import MIN_DETECTIONS, Settings, scene_preset


@dataclass(frozen=True, eq=False)
class SceneFrame:
    """One instant of a scene: what the robots brought, what each method made of it, and what is true.

    `occlusion` (N, m) is the share of each object's outline in each image that something nearer or the edge cuts off.
    """

    episode: int
    step: int
    views: list[View]
    matchings: dict[str, Matchings]
    match_ms: dict[str, dict[tuple[int, int], float]]
    failures: dict[str, dict[tuple[int, int], str | None]]
    claims: dict[str, list[Claims]]
    scores: dict[str, StepScore]
    truth: Truth
    occlusion: NDArray[np.float64]


def run_episodes(
    scene: str,
    episodes: Sequence[int],
    methods: Sequence[Method],
    settings: Settings,
    book: PictureBook | None = None,
) -> list[Record]:
    """Records of the given episodes, in order of time, pair and method; `book` gets to see every frame."""
    env = make_env(scene, settings)
    found: list[Record] = []
    try:
        for episode in episodes:
            for frame in play(env, episode, methods, settings):
                for method in methods:
                    found += records(scene, frame, method)
                if book is not None:
                    counts = {label: result.counts for label, result in frame.scores.items()}
                    book.see(episode, counts, partial(page, scene, env, frame), shared(env, frame))
        return found
    finally:
        env.close()


def make_env(scene: str, settings: Settings, **options: Any) -> CollaborativeEnv:
    preset = scene_preset(scene, settings)
    sensors = ("image", "depth", "instances") if settings.perception == "simulated" else ("image",)
    return parallel_env(scene, preset=preset, n_robots=settings.n_robots, sensors=sensors, **options)


def make_eyes(settings: Settings, env: CollaborativeEnv) -> Perceptor:
    """The run's perceptor. Learned eyes compute on one thread: sums of several would depend on their number."""
    if settings.perception != "simulated":
        import torch

        torch.set_num_threads(1)
    return make_perceptor(settings.perception, env)


def play(env: CollaborativeEnv, episode: int, methods: Sequence[Method], settings: Settings) -> Iterator[SceneFrame]:
    """The frames of one episode; between two of them the environment stands at the instant of the first."""
    perceive = make_eyes(settings, env)
    observations, _ = env.reset(seed=[settings.seed, episode])
    trackers = PairTrackers() if settings.sequence else None
    step = 0
    while env.agents:
        views = look_around(env, perceive, observations, (settings.seed, episode, step))
        if trackers is not None:
            trackers.begin(episode, {agent: np.asarray(o["odometry"], float) for agent, o in observations.items()})
        yield _match_frame(env, views, methods, settings, episode, step, trackers)
        observations = step_scripted(env)
        step += 1


def look_around(
    env: CollaborativeEnv, perceive: Perceptor, observations: Mapping[str, Any], stream: tuple[int, ...]
) -> list[View]:
    """What every robot's eyes make of its observation; `stream` seeds them."""
    eyes = np.random.default_rng(stream).spawn(len(env.agents))
    return [
        look(perceive, observations[agent], env.max_detections, rng)
        for agent, rng in zip(env.agents, eyes, strict=True)
    ]


def step_scripted(env: CollaborativeEnv) -> dict[str, Any]:
    """Move by the scene's scripted controllers, claiming nothing; the next observations."""
    observations, *_ = env.step(silent_actions(env.agents, scripted_controls(env.world), env.max_detections))
    return observations


def _match_frame(
    env: CollaborativeEnv,
    views: list[View],
    methods: Sequence[Method],
    settings: Settings,
    episode: int,
    step: int,
    trackers: PairTrackers | None,
) -> SceneFrame:
    truth = env.ground_truth()
    cameras = truth.T_world_camera
    identities = [identity(view, i, env) for i, view in enumerate(views)]
    frame = SceneFrame(episode, step, views, {}, {}, {}, {}, {}, truth, occlusion(env))
    for method in methods:
        found: Matchings = {}
        elapsed: dict[tuple[int, int], float] = {}
        failures: dict[tuple[int, int], str | None] = {}
        for number, (i, j) in enumerate(combinations(range(len(views)), 2)):
            if min(len(views[i].detections), len(views[j].detections)) < MIN_DETECTIONS:
                continue
            found[i, j], elapsed[i, j], failures[i, j] = attempt(
                method,
                views[i].detections.graph,
                views[j].detections.graph,
                PairTruth((identities[i], identities[j]), invert(cameras[i]) @ cameras[j]),
                relative_pose(views[i], views[j]) if settings.pose == "known" else None,
                (settings.seed, episode, step, number),
                f"{env.name}, episode {episode}, step {step}, robots {i} and {j}",
                None if trackers is None else trackers.of(method.label, f"robot_{i}", f"robot_{j}"),
            )
        said = claims(views, found, env.max_detections)
        frame.matchings[method.label] = found
        frame.match_ms[method.label] = elapsed
        frame.failures[method.label] = failures
        frame.claims[method.label] = said
        frame.scores[method.label] = score(said, truth)
    return frame


def identity(view: View, robot: int, env: CollaborativeEnv) -> NDArray[np.int64]:
    """True object (n,) of each detection by the rules of scoring; -1 = none."""
    truth = env.ground_truth()
    tied = tie(view.detections.boxes, truth.boxes[robot], truth.pixels[robot])
    return np.where(tied >= 0, truth.identity[tied], -1) if len(truth.identity) else np.full(len(tied), -1)


def records(scene: str, frame: SceneFrame, method: Method) -> Iterator[Record]:
    """One record per pair of robots that was matched."""
    result = frame.scores[method.label]
    given: set[tuple[int, int]] = set()
    distance = np.linalg.norm(frame.truth.positions - frame.truth.T_world_camera[:, None, :3, 3], axis=2)
    for pair in result.pairs:
        if (pair.a, pair.b) not in frame.matchings[method.label]:
            continue
        slots = _scored_slots(pair, given)
        common = _common(pair, result)
        yield Record(
            target=scene,
            method=method.label,
            episode=frame.episode,
            frame=frame.step,
            source=f"robot_{pair.a}",
            partner=f"robot_{pair.b}",
            correct=pair.counts.correct,
            retrieved=pair.counts.retrieved,
            common=pair.counts.common,
            visible=pair.n_visible,
            match_ms=frame.match_ms[method.label][pair.a, pair.b],
            scores=pair.scores.tolist(),
            hits=pair.hits.tolist(),
            positions_scored=True,
            error_single_m=[float(result.error_single[slot]) for slot in slots],
            error_fused_m=[float(result.error_fused[slot]) for slot in slots],
            error_range_m=[float(distance[robot, result.tied[robot, k]]) for robot, k in slots],
            error_occlusion=[float(frame.occlusion[robot, result.tied[robot, k]]) for robot, k in slots],
            common_range_m=distance[[pair.a, pair.b]][:, common].max(axis=0).tolist(),
            common_occlusion=frame.occlusion[[pair.a, pair.b]][:, common].max(axis=0).tolist(),
            common_found=np.isin(common, result.tied[pair.a, pair.assertions[pair.hits, 0]]).tolist(),
            failure=frame.failures[method.label][pair.a, pair.b],
        )


def _scored_slots(pair: PairScore, given: set[tuple[int, int]]) -> list[tuple[int, int]]:
    """Robot and slot of the pair's right matches; a slot that several pairs match counts with the first alone."""
    slots = []
    for match in pair.assertions[pair.hits].tolist():
        for key in zip((pair.a, pair.b), match, strict=True):
            if key not in given:
                given.add(key)
                slots.append(key)
    return slots


def _common(pair: PairScore, result: StepScore) -> NDArray[np.int64]:
    """Objects (c,) that both robots of the pair detected."""
    common = np.intersect1d(result.tied[pair.a], result.tied[pair.b])
    return common[common >= 0]


def occlusion(env: CollaborativeEnv) -> NDArray[np.float64]:
    """Hidden share (N, m) of each object's outline in each robot's present image, as the simulated eyes define it."""
    m = len(env.ground_truth().identity)
    # The cameras count objects from 0, `measure` counts the background as 0.
    seen = [measure(camera.instances + np.int32(1), camera.depth, m + 1) for camera in env.camera_frames()]
    return np.stack([row[1:, OCCLUSION] for row in seen])


def shared(env: CollaborativeEnv, frame: SceneFrame) -> dict[int, NDArray[np.float64]]:
    """True places (3,) m of the objects that the first two robots both detected."""
    seen = set.intersection(*(set(identity(frame.views[i], i, env).tolist()) for i in (0, 1)))
    places = zip(frame.truth.identity.tolist(), frame.truth.positions, strict=True)
    return {name: place for name, place in places if name in seen}


def page(scene: str, env: CollaborativeEnv, frame: SceneFrame) -> Page:
    """The frame for the report; the environment still stands at its instant."""
    place = dict(zip(frame.truth.identity.tolist(), frame.truth.positions.tolist(), strict=True))
    sights, poses = [], frame.truth.T_world_camera
    for i, (view, camera) in enumerate(zip(frame.views, env.camera_frames(), strict=True)):
        identities = identity(view, i, env)
        sights.append(
            Sight(
                robot=env.possible_agents[i],
                image=jpeg(camera.rgb),
                pose=rounded(poses[i].ravel()),
                boxes=rounded(view.detections.boxes),
                places=rounded(transform(poses[i], view.detections.graph.positions)),
                identity=identities.tolist(),
                truth=[place.get(int(k)) for k in identities],
            )
        )
    size = [env.width, env.height]
    results = [_result(label, frame) for label in frame.scores]
    return Page(scene, frame.episode, frame.step, "episode", size, sights, results)


def _result(label: str, frame: SceneFrame) -> Result:
    score, said = frame.scores[label], frame.claims[label]
    poses = frame.truth.T_world_camera
    return Result(
        method=label,
        robots=[[p.a, p.b] for p in score.pairs for _ in p.hits],
        pairs=[slots for p in score.pairs for slots in p.assertions.tolist()],
        scores=[float(s) for p in score.pairs for s in p.scores],
        hits=[bool(h) for p in score.pairs for h in p.hits],
        common=score.counts.common,
        fused=[
            rounded(transform(poses[i], said[i].positions[: len(view.detections)]))
            for i, view in enumerate(frame.views)
        ],
    )
