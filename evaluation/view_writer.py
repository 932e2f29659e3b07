"""Logs instants into a Rerun recording, for `covis view`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from ..envs.colors import FAINT, RIGHT, WRONG, Color, class_color, robot_color
from ..matching.pose import Array, transform
from . import view_shapes as shapes
from .moments import Moment, Result, Sighting, Things
from .view_layout import FIGURES, layout

if TYPE_CHECKING:
    import rerun as rr

TRAIL = 100
"""Instants of a trajectory that are drawn."""
MOST_LABELS = 8
"""More labels in one picture would cover one another; they show under the pointer."""
EPISODE_PAUSE_S = 0.2
"""Between the end of an episode and the next one's start, on the time line of all."""
LINES: tuple[Color, ...] = ((64, 156, 255), (255, 140, 46), (46, 204, 134), (226, 122, 196), (245, 200, 66))
"""Of the methods' curves."""


@dataclass
class Writer:
    """Logs moments one after another; every entity anew at each, so that nothing old stays on screen."""

    recording: rr.RecordingStream
    classes: tuple[str, ...]
    methods: list[str]
    robots: list[str] = field(default_factory=list)
    pairs: list[tuple[str, str]] = field(default_factory=list)
    trails: dict[str, list[Array]] = field(default_factory=dict)
    frames: int = 0
    episode: int | None = None
    clock: float = 0.0
    offset: float = 0.0
    eye: tuple[Array, Array] | None = None
    scale: float = 1.0
    figures: set[str] = field(default_factory=set)

    def write(self, moment: Moment) -> None:
        """Log one instant."""
        if self.episode is None:
            self._begin(moment)
        self._set_time(moment)
        self._log_things(moment.things)
        for sighting in moment.sightings:
            self._log_robot(sighting)
        for absent in set(self.robots) - {s.robot for s in moment.sightings}:
            self._log(f"world/{shapes.part(absent)}", shapes.rerun().Clear(recursive=True))
        for label in self.methods:
            self._log_result(label, moment, moment.results[label])

    def _log(self, path: str, *what: Any, static: bool = False) -> None:
        self.recording.log(path, *what, static=static)

    def _begin(self, moment: Moment) -> None:
        """What never changes: axes, names of the curves; and where to look from."""
        rr = shapes.rerun()
        self._log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for name, (title, strong) in FIGURES.items():
            for k, label in enumerate(self.methods):
                color = LINES[k % len(LINES)]
                if not strong:
                    color = shapes.faint(color)
                style = rr.SeriesLines(colors=[color], names=[f"{label} {title}"], widths=[2.5 if strong else 1.5])
                self._log(f"metrics/{name}/{shapes.part(label)}", style, static=True)
        places = [s.place[:3, 3] for s in moment.sightings if s.place is not None]
        for s in moment.sightings:
            if s.place is not None and len(s.graph):
                places += list(transform(s.place, s.graph.positions))
        low, high = np.quantile(np.array(places or [np.zeros(3)]), (0.05, 0.95), axis=0)
        centre = 0.5 * (low + high)
        reach = max(2.0, 0.5 * float(np.linalg.norm(high - low)))
        self.eye = (centre + reach * np.array([-1.1, -1.1, 1.6]), centre)
        self.scale = reach

    def _set_time(self, moment: Moment) -> None:
        """`frame` counts through, `dataset_frame` is as numbered, `time` runs on over episodes with a short pause."""
        self.recording.set_time("frame", sequence=self.frames)
        self.recording.set_time("dataset_frame", sequence=moment.frame)
        self.frames += 1
        if moment.episode != self.episode:
            self.episode, self.trails = moment.episode, {}
            if moment.time is not None:
                self.offset = 0.0 if moment.time > self.clock else self.clock + EPISODE_PAUSE_S - moment.time
        if moment.time is not None:
            self.clock = moment.time + self.offset
            self.recording.set_time("time", duration=self.clock)
        self._log("metrics/episode", shapes.rerun().Scalars(moment.episode))

    def _log_things(self, things: Things) -> None:
        rr = shapes.rerun()
        colors = [class_color(int(kind)) for kind in things.kind]
        labels = [f"{self.classes[kind]} {name}" for kind, name in zip(things.kind, things.identity, strict=True)]
        if things.sizes is None or things.headings is None:
            shown: Any = rr.Points3D(
                things.positions, colors=colors, labels=labels, show_labels=False, radii=0.015 * self.scale
            )
        else:
            half = np.zeros((len(things.headings), 4))
            half[:, 2], half[:, 3] = np.sin(things.headings / 2), np.cos(things.headings / 2)
            shown = rr.Boxes3D(
                centers=things.positions,
                half_sizes=things.sizes / 2,
                quaternions=half,
                colors=colors,
                labels=labels,
                show_labels=False,
            )
        self._log("world/objects", shown)

    def _log_robot(self, sighting: Sighting) -> None:
        rr = shapes.rerun()
        if sighting.robot not in self.robots:
            self.robots.append(sighting.robot)
        base = f"world/{shapes.part(sighting.robot)}"
        color = robot_color(self.robots.index(sighting.robot))
        if sighting.place is None:
            self._log(base, rr.Clear(recursive=True))
            return
        T = sighting.place
        self._log(f"{base}/sensor", rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
        self._log_camera(f"{base}/sensor", sighting, color)
        self._log_detections(f"{base}/sensor", sighting, color)
        trail = self.trails.setdefault(sighting.robot, [])
        trail.append(T[:3, 3])
        del trail[:-TRAIL]
        self._log(f"{base}/trajectory", rr.LineStrips3D([np.array(trail)], colors=[color], radii=shapes.points(2.5)))
        if sighting.pose is not None and sighting.pose_truth is not None:
            reported = sighting.pose[:3, 3]
            spread = shapes.ellipsoids(reported[None], shapes.world_spread(sighting)[None], [(*color, 120)], None)
            self._log(f"{base}/reported_position", spread)

    def _log_camera(self, base: str, sighting: Sighting, color: Color) -> None:
        rr = shapes.rerun()
        if sighting.graph.intrinsics is None or sighting.size is None:
            self._log(base, rr.TransformAxes3D(0.1 * self.scale))
            return
        pinhole = rr.Pinhole(
            image_from_camera=sighting.graph.intrinsics,
            resolution=sighting.size,
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=0.25 * self.scale,
            color=color,
            line_width=0.002 * self.scale,
        )
        self._log(f"{base}/camera", pinhole)
        if sighting.image is not None:
            self._log(f"{base}/camera/image", shapes.picture(sighting.image))

    def _log_detections(self, base: str, sighting: Sighting, color: Color) -> None:
        rr = shapes.rerun()
        graph = sighting.graph
        labels = shapes.class_labels(self.classes, graph.attributes)
        ellipsoids = shapes.ellipsoids(graph.positions, graph.full_covariances(), [(*color, 90)] * len(graph), labels)
        self._log(f"{base}/detections", ellipsoids)
        if sighting.boxes is None or sighting.size is None:
            return
        kinds = graph.attributes.argmax(axis=1) if len(graph) else []
        colors = [class_color(int(k)) for k in kinds]
        boxes = rr.Boxes2D(
            array=sighting.boxes,
            array_format=rr.Box2DFormat.XYXY,
            labels=labels,
            show_labels=len(labels) <= MOST_LABELS,
            colors=colors,
            radii=0.75,
        )
        self._log(f"{base}/camera/boxes", boxes)

    def _log_result(self, label: str, moment: Moment, result: Result) -> None:
        rr = shapes.rerun()
        name = shapes.part(label)
        strips, colors = shapes.match_lines(moment.sightings, result)
        self._log(f"world/matches/{name}", rr.LineStrips3D(strips, colors=colors, radii=shapes.points(2.0)))
        self._log_estimates(f"world/estimates/{name}", moment, result)
        for pair in result.matchings:
            self._log_pair(label, pair, moment, result)
        self.figures |= set(result.figures)
        for figure in FIGURES:
            path = f"metrics/{figure}/{name}"
            value = result.figures.get(figure)
            self._log(path, rr.Clear(recursive=False) if value is None else rr.Scalars(value))

    def _log_estimates(self, base: str, moment: Moment, result: Result) -> None:
        """Fused objects of two robots and more; they hang on the place of the robot in whose frame they are."""
        fused = result.fused
        if fused is None:
            return
        place = moment.sightings[fused.frame].place
        assert place is not None
        shared = np.flatnonzero((fused.members >= 0).sum(axis=1) >= 2)
        R = place[:3, :3]
        positions = transform(place, fused.positions[shared])
        names = [shapes.identities(moment.sightings, row) for row in fused.members[shared]]
        colors = [(*(RIGHT if len(n) == 1 and min(n) >= 0 else WRONG), 110) for n in names]
        labels = [shapes.agreed_class(self.classes, moment.sightings, row) for row in fused.members[shared]]
        self._log(base, shapes.ellipsoids(positions, R @ fused.covariances[shared] @ R.T, colors, labels))

    def _log_pair(self, label: str, pair: tuple[int, int], moment: Moment, result: Result) -> None:
        """Two cameras side by side, and the matches between them."""
        rr = shapes.rerun()
        a, b = (moment.sightings[i] for i in pair)
        if a.boxes is None or b.boxes is None or a.size is None or b.size is None:
            return
        if (a.robot, b.robot) not in self.pairs:
            self.pairs.append((a.robot, b.robot))
        base = shapes.pair_path(a.robot, b.robot)
        if label == self.methods[0] and a.image is not None and b.image is not None:
            self._log(
                f"{base}/image",
                rr.EncodedImage(contents=shapes.side_by_side(a.image, b.image), media_type="image/jpeg"),
            )
        shift = np.array([a.size[0] + shapes.GAP_PX, 0, a.size[0] + shapes.GAP_PX, 0])
        matching, hits = result.matchings[pair], result.hits[pair]
        boxes = [a.boxes, b.boxes + shift]
        ends = [0.5 * (side[:, :2] + side[:, 2:]) for side in boxes]
        lines = np.stack([ends[0][matching.pairs[:, 0]], ends[1][matching.pairs[:, 1]]], axis=1)
        colors = [RIGHT if hit else WRONG for hit in hits]
        scores = [f"{s:.2f}" for s in matching.scores]
        strips = rr.LineStrips2D(lines, colors=colors, radii=1.0, labels=scores, show_labels=False)
        self._log(f"{base}/{shapes.part(label)}/matches", strips)
        shades: list[Color] = [FAINT] * (len(boxes[0]) + len(boxes[1]))
        for (i, j), color in zip(matching.pairs.tolist(), colors, strict=True):
            shades[i] = shades[len(boxes[0]) + j] = color
        outlines = rr.Boxes2D(array=np.concatenate(boxes), array_format=rr.Box2DFormat.XYXY, colors=shades, radii=0.75)
        self._log(f"{base}/{shapes.part(label)}/boxes", outlines)

    def finish(self, about: str) -> None:
        """The Markdown text that explains the recording, and the layout it opens with."""
        self._log("about", shapes.rerun().TextDocument(about, media_type="text/markdown"), static=True)
        self.recording.send_blueprint(layout(self.robots, self.pairs, self.methods, self.figures, self.eye))
