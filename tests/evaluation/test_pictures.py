"""Frames a run keeps for its report."""

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from covis.evaluation.benchmark import benchmark
from covis.evaluation.methods import Method
from covis.evaluation.pictures import Page, PictureBook, Result, Sight, from_table, to_table
from covis.evaluation.records import from_table as records_from_table
from covis.evaluation.settings import Settings
from covis.matching.metrics import Counts


def make_page(frame: int, common: int = 4) -> Page:
    sight = Sight("robot_0", b"jpeg", None, [], [[1.0, 2.0, 3.0]], [7], [None])
    result = Result("a", [[0, 1]], [[0, 0]], [0.5], [True], common)
    return Page("t", 0, frame, "episode", [320, 240], [sight], [result])


def see(book: PictureBook, episode: int, frame: int, correct: dict[str, int], common: int = 4) -> None:
    counts = {method: Counts(right, 4, common) for method, right in correct.items()}
    book.see(episode, counts, lambda: make_page(frame, common))


def test_the_worst_frame_of_each_of_the_two_best_methods_is_kept():
    book = PictureBook(first_episode=0)
    for frame, correct in enumerate([{"a": 4, "b": 1, "c": 0}, {"a": 2, "b": 2, "c": 0}, {"a": 3, "b": 3, "c": 1}]):
        see(book, 1, frame, correct)
    assert [(p.frame, p.role) for p in book.pages()] == [(1, "worst"), (0, "worst")]


def test_frames_with_little_in_common_and_evaluation_only_methods_are_no_failures():
    book = PictureBook(first_episode=0)
    see(book, 1, 0, {"a": 0}, common=2)
    see(book, 1, 1, {"random": 0})
    assert book.pages() == []


def test_of_the_first_episode_one_frame_keeps_its_images():
    book = PictureBook(first_episode=5)
    for frame, common in enumerate([4, 6, 5]):
        see(book, 5, frame, {"oracle": 4}, common)
    pages = book.pages()
    assert [p.role for p in pages] == ["episode", "showcase", "episode"]
    assert [p.sights[0].image for p in pages] == [None, b"jpeg", None]


def test_the_rest_of_the_first_unit_is_followed_too_but_shows_no_images():
    book = PictureBook(first_episode=5)
    for episode, common in ((5, 4), (6, 9)):
        see(book, episode, episode, {"oracle": 4}, common)
    assert [(p.frame, p.role) for p in book.pages()] == [(5, "showcase"), (6, "episode")]
    other = PictureBook(first_episode=5)
    see(other, 6, 0, {"oracle": 4})
    assert other.pages() == []


def follow(book, episode, *paths):
    """One frame per place (m along x) of object 7; None where not both robots see it."""
    for frame, x in enumerate(paths):
        shared = {8: np.zeros(3)} | ({} if x is None else {7: np.array([x, 0.0, 0.0])})
        book.see(episode, {"a": Counts(4, 4, 2)}, lambda frame=frame: make_page(10 * episode + frame), shared)


def test_of_every_unit_the_longest_shared_view_of_something_that_moves_is_kept():
    book = PictureBook(first_episode=0)
    follow(book, 3, 0.0, 0.5, None, None, 1.0)
    follow(book, 4, 0.0, 0.5, 1.0, None, 1.5)
    follow(book, 5, 0.0, 0.01, 0.02, 0.03, 0.04)  # stands still, as object 8 does
    assert [(p.frame, p.role) for p in book.pages()] == [(40 + k, "episode") for k in range(5)]
    assert all(s.image is None for p in book.pages() for s in p.sights)
    short = PictureBook(first_episode=0)
    follow(short, 3, 0.0, 0.5)
    assert short.pages() == []


def test_pages_survive_parquet():
    pages = [make_page(0), make_page(1).without_images()]
    assert from_table(to_table(pages)) == pages


def test_a_run_on_a_dataset_writes_pages_that_agree_with_its_records(small_dataset, tmp_path):
    methods = [Method.parse("oracle"), Method.parse("random")]
    benchmark([str(small_dataset)], methods, Settings(), out=tmp_path / "run")
    pages = from_table(pq.read_table(tmp_path / "run" / "pictures" / "unit-00000.parquet"))
    records = records_from_table(pq.read_table(tmp_path / "run" / "records" / "unit-00000.parquet"))
    fused = [np.array(r) - s.truth for p in pages for s, r in zip(p.sights, p.results[0].fused, strict=True)]
    assert np.linalg.norm(np.concatenate(fused), axis=1).mean() < 0.15
    assert [p.frame for p in pages] == [0, 1, 2, 3, 4, 5]  # the first unit
    for page in pages:
        for result in page.results:
            own = [r for r in records if (r.frame, r.method) == (page.frame, result.method)]
            assert sum(result.hits) == sum(r.correct for r in own)
            assert len(result.hits) == sum(r.retrieved for r in own)
        sight = page.sights[0]
        error = np.linalg.norm(np.array(sight.places) - np.array(sight.truth), axis=1)
        assert error.max() < 0.5  # detections err by 0.05 m an axis: places are in the world frame


def with_pictures(folder, width=40, height=30):
    """Adds an image per robot and frame, and a box per detection, to a dataset folder."""
    png = cv2.imencode(".png", np.zeros((height, width, 3), np.uint8))[1].tobytes()
    robots, detections = (pq.read_table(folder / f"{name}.parquet") for name in ("robots", "detections"))
    pq.write_table(robots.append_column("image", pa.array([png] * len(robots))), folder / "robots.parquet")
    boxes = [[float(k), 0.0, k + 5.0, 9.0] for k in detections["detection"].to_pylist()]
    pq.write_table(detections.append_column("box", pa.array(boxes)), folder / "detections.parquet")


def test_pages_of_recorded_datasets_carry_images_and_boxes_in_the_order_of_the_detections(small_dataset, tmp_path):
    with_pictures(small_dataset)
    benchmark([str(small_dataset)], [Method.parse("oracle")], Settings(), out=tmp_path / "run")
    pages = from_table(pq.read_table(tmp_path / "run" / "pictures" / "unit-00000.parquet"))
    (shown,) = [p for p in pages if p.role == "showcase"]
    assert shown.image_size == [40, 30]
    stored = pq.read_table(small_dataset / "detections.parquet").to_pylist()
    for sight in shown.sights:
        assert sight.image.startswith(b"\xff\xd8")
        own = {r["identity"]: r["box"] for r in stored if (r["frame"], r["robot"]) == (shown.frame, sight.robot)}
        assert [own[identity] for identity in sight.identity] == sight.boxes
    assert all(s.image is None for p in pages if p.role == "episode" for s in p.sights)


def test_found_flags_count_what_was_matched_rightly(small_dataset, tmp_path):
    benchmark([str(small_dataset)], [Method.parse("random")], Settings(), out=tmp_path / "run")
    for record in records_from_table(pq.read_table(tmp_path / "run" / "records" / "unit-00000.parquet")):
        assert sum(record.common_found) == record.correct
        assert len(record.common_found) == len(record.common_range_m) == record.common


def test_scene_records_tell_range_and_occlusion_and_pages_carry_images(tmp_path):
    pytest.importorskip("pybullet")
    methods = [Method.parse("oracle")]
    benchmark(["multi_robot"], methods, Settings(episodes=1, seed=7003, perception="simulated"), out=tmp_path / "run")
    records = records_from_table(pq.read_table(tmp_path / "run" / "records" / "unit-00000.parquet"))
    assert records
    for record in records:
        assert all(record.common_found)
        assert len(record.error_range_m) == len(record.error_occlusion) == len(record.error_single_m)
        assert len(record.error_range_m) == 2 * record.correct
        assert all(0 <= x <= 1 for x in record.error_occlusion + record.common_occlusion)
        assert min(record.error_range_m) > 0
    pages = from_table(pq.read_table(tmp_path / "run" / "pictures" / "unit-00000.parquet"))
    (shown,) = [p for p in pages if p.role == "showcase"]
    assert all(s.image is not None and s.image.startswith(b"\xff\xd8") for s in shown.sights)
    fused = np.array(list(shown.result("oracle").fused[0]))
    assert fused.shape == np.array(shown.sights[0].places).shape
