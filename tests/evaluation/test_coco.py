"""COCO export: pycocotools reads it, and its boxes, masks and scores say what the dataset says."""

import json

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from covis.evaluation.coco import export_coco
from covis.evaluation.datasets import DatasetError
from covis.evaluation.recording import record
from covis.evaluation.settings import Settings


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recorded") / "boxes"
    record("box_world:BoxWorld", Settings(episodes=1, perception="simulated"), folder)
    return folder


@pytest.fixture(scope="module")
def exported(recorded):
    out = recorded.parent / "coco"
    done = export_coco(recorded, out)
    assert (done.images, len(list((out / "images").iterdir()))) == (50, 50)
    assert done.annotations == pq.read_metadata(recorded / "objects.parquet").num_rows
    assert done.detections == pq.read_metadata(recorded / "detections.parquet").num_rows
    return out


def test_pycocotools_finds_the_objects_in_the_images(exported):
    coco = COCO(exported / "annotations.json")
    assert [c["name"] for c in coco.loadCats(coco.getCatIds())] == ["red", "blue"]
    for number in coco.getImgIds()[:3]:
        image = coco.loadImgs(number)[0]
        pixels = cv2.imread(str(exported / "images" / image["file_name"]))
        assert pixels.shape[:2] == (image["height"], image["width"])
        annotations = coco.loadAnns(coco.getAnnIds(number))
        assert annotations
        for annotation in annotations:
            mask = coco.annToMask(annotation).astype(bool)
            assert mask.sum() == annotation["area"]
            v, u = np.nonzero(mask)
            assert annotation["bbox"] == [u.min(), v.min(), np.ptp(u) + 1, np.ptp(v) + 1]
            blue, _, red = np.median(pixels[mask], axis=0)
            assert annotation["category_id"] == (1 if red > blue else 2)
            assert annotation["iscrowd"] == (annotation["area"] < 60)


def test_coco_scores_truth_perfect_and_the_eyes_well(exported, tmp_path):
    coco = COCO(exported / "annotations.json")
    perfect = [{**a, "score": 1.0} for a in coco.dataset["annotations"] if not a["iscrowd"]]
    (tmp_path / "perfect.json").write_text(json.dumps(perfect))
    for results, least in ((tmp_path / "perfect.json", 1.0), (exported / "detections.json", 0.6)):
        evaluation = COCOeval(coco, coco.loadRes(str(results)), "bbox")
        evaluation.evaluate()
        evaluation.accumulate()
        evaluation.summarize()
        assert evaluation.stats[1] >= least - 1e-9  # AP50


def test_without_true_objects_the_detections_are_the_annotations(recorded, tmp_path):
    folder = tmp_path / "plain"
    folder.mkdir()
    for name in ("dataset.json", "robots.parquet", "detections.parquet"):
        (folder / name).write_bytes((recorded / name).read_bytes())
    done = export_coco(folder, tmp_path / "coco")
    assert done.annotations == done.detections > 0
    coco = COCO(tmp_path / "coco" / "annotations.json")
    box = pq.read_table(folder / "detections.parquet")["box"][0].as_py()
    assert coco.loadAnns(1)[0]["bbox"] == [box[0], box[1], box[2] - box[0], box[3] - box[1]]


def test_exports_are_not_overwritten_unasked(exported, recorded):
    before = (exported / "annotations.json").read_bytes()
    with pytest.raises(FileExistsError, match="is not empty; give --overwrite"):
        export_coco(recorded, exported)
    export_coco(recorded, exported, overwrite=True)
    assert (exported / "annotations.json").read_bytes() == before


def test_what_cannot_be_exported_is_said(small_dataset, recorded, tmp_path):
    with pytest.raises(DatasetError, match="has no images"):
        export_coco(small_dataset, tmp_path / "coco")
    folder = tmp_path / "odd"
    folder.mkdir()
    for name in ("dataset.json", "robots.parquet", "detections.parquet"):
        (folder / name).write_bytes((recorded / name).read_bytes())
    objects = pq.read_table(recorded / "objects.parquet").to_pylist()
    objects[2]["class"] = "green"
    pq.write_table(pa.Table.from_pylist(objects), folder / "objects.parquet")
    with pytest.raises(DatasetError, match=r"column 'class', row 2: 'green' is none of the classes red, blue"):
        export_coco(folder, tmp_path / "green")
    assert not (tmp_path / "green" / "annotations.json").exists()
