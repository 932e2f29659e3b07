"""What the page and the Markdown say, against the rows they are made of."""

import json
import re
import shutil
from dataclasses import replace
from html import escape
from html.parser import HTMLParser

import numpy as np
import pytest

from covis.evaluation.pictures import to_table as pictures_table
from covis.evaluation.records import to_table as records_table
from covis.evaluation.report import RunFolderError, write_report
from covis.evaluation.report.charts import linear_axis, log_axis
from covis.evaluation.report.curves import average_precision, binned, pr_curve
from covis.evaluation.report.html import h, page
from covis.evaluation.report.leaderboard import signed, verdict
from covis.evaluation.report.robustness import figure_7, rates
from covis.evaluation.report.run import Entry, load
from covis.evaluation.report.topview import best_tracks, episodes, trajectories
from covis.evaluation.shards import Shards

from .conftest import METHODS, TARGETS, make_record, rows_of, write_run


class Outline(HTMLParser):
    """Table rows of each target, every tag, and all attributes that could fetch something."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.links: list[str] = []
        self.rows: list[list[str]] = []
        self._cell = False

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        self.links += [value for name, value in attributes if name in ("href", "src", "srcset", "xlink:href", "action")]
        if tag == "tr":
            self.rows.append([])
        self._cell = tag in ("td", "th") or self._cell
        if tag in ("td", "th"):
            self.rows[-1].append("")

    def handle_endtag(self, tag):
        if tag in ("td", "th"):
            self._cell = False

    def handle_data(self, data):
        if self._cell:
            self.rows[-1][-1] += data


@pytest.fixture(scope="module")
def report(run_folder):
    return write_report(run_folder)


@pytest.fixture(scope="module")
def outline(report):
    parser = Outline()
    parser.feed(report.html.read_text())
    return parser


def test_numbers_of_the_tables_are_those_of_the_rows(run_folder, outline, report):
    markdown = report.markdown.read_text()
    for row in rows_of(run_folder):
        keys = ("f1", "precision", "recall", "ece", "scene_recall", "displacement_single_m", "displacement_fused_m")
        figures = [f"{row[k]:.3f}" for k in keys]
        tables = [r for r in outline.rows if len(r) > 6 and r[0] == row["method"] and r[1] == figures[0]]
        assert any(all(figure in r for figure in figures) for r in tables), (row["target"], figures, tables)
        line = next(x for x in markdown.split("\n") if f"| {row['f1']:.3f} | {row['f1_low']:.3f} to" in x)
        assert f"| {row['recall']:.3f} |" in line


def test_the_paper_stands_beside_ours(tmp_path):
    folder = write_run(tmp_path)
    for file in (folder / "run.json", folder / "rows.json"):
        file.write_text(file.read_text().replace('"good"', '"mos"'))
    run = load(folder)
    text = write_report(folder).markdown.read_text()
    assert "0.641 |" in text.split("## a")[0]  # Table 1: MOS on S-MRC
    assert "0.641" not in text.split("## a")[1]
    assert "mos" in run.methods


def test_names_are_text_never_markup(report, outline):
    html = report.html.read_text()
    assert "<b>bold" not in html
    assert "<i>target" not in html
    assert "<script>alert" not in html
    assert "&lt;b&gt;bold&lt;/b&gt;" in html
    assert outline.tags.count("script") == 1
    assert not {"b", "i", "iframe", "object"} & set(outline.tags)
    assert r"\<b\>bold\</b\>" in report.markdown.read_text()


def test_the_page_asks_the_network_for_nothing(report, outline):
    assert all(link.startswith(("#", "data:")) for link in outline.links)
    html = report.html.read_text()
    assert not re.search(r"@import|url\(|fetch\(|XMLHttpRequest|//[a-z]", html)
    assert len(html) < 3e6


def test_every_image_is_there_once_and_every_use_finds_it(report):
    html = report.html.read_text()
    uses = set(re.findall(r'<use href="#(image-\d+)"', html))
    images = re.findall(r'<image id="(image-\d+)"', html)
    assert uses == set(images) == {"image-0"}


def test_every_section_is_there_and_linked(report):
    html = report.html.read_text()
    sections = re.findall(r'<section id="([\w-]+)"', html)
    assert sections == [
        "leaderboard",
        "precision-recall",
        "calibration",
        "matches",
        "observers",
        "trajectories",
        "error",
        "found",
        "runtime",
        "failures",
        "reproduce",
    ]
    assert all(f'<a href="#{name}"' in html for name in sections)
    assert "abc1234567" in html
    assert "suite trial (version 7)" in html
    assert "3.11.7" in html


@pytest.mark.parametrize("identifier", ["error", "found"])
def test_figures_without_legends_share_one(report, identifier):
    section = report.html.read_text().split(f'<section id="{identifier}">')[1].split("</section>")[0]
    (legend,) = re.findall('<ul class="legend">(.*?)</ul>', section)
    assert re.findall("<span>(.*?)</span>", legend) == [escape(name) for name in METHODS]


def test_names_of_tracks_are_drawn_over_all_tracks(run_folder):
    group = next(g for g in load(run_folder).groups if best_tracks(g, "good")[1])
    found = best_tracks(group, "good")[1]
    drawn = [child.get("class") for child in trajectories(group.name, [*found, *found], "fused")]
    assert drawn.index("tag") > max(k for k, kind in enumerate(drawn) if kind == "point fused")


def test_pictures_have_words_for_those_who_cannot_see_them(report):
    for tag in re.findall(r"<svg[^>]*>", report.html.read_text()):
        assert "aria-label=" in tag or 'aria-hidden="true"' in tag


def test_a_killed_run_is_reported_as_far_as_it_got(tmp_path):
    whole, folder = write_run(tmp_path / "whole"), write_run(tmp_path / "killed", rows=False)
    (folder / "records" / "unit-00001.parquet").unlink()
    html = write_report(folder).html.read_text()
    assert "not finished: 1 of 2 units" in html
    (group,) = load(folder).groups
    assert [e.f1 for e in group.entries] == [r["f1"] for r in rows_of(whole) if r["target"] == TARGETS[0]]


def test_bad_folders_are_named(tmp_path):
    with pytest.raises(RunFolderError, match=r"run\.json is missing"):
        write_report(tmp_path)
    (tmp_path / "run.json").write_text("{")
    with pytest.raises(RunFolderError, match="is not JSON"):
        write_report(tmp_path)
    (tmp_path / "run.json").write_text("{}")
    with pytest.raises(RunFolderError, match="is not of a run"):
        write_report(tmp_path)
    folder = write_run(tmp_path / "run")
    rows = (folder / "rows.json").read_text()
    (folder / "rows.json").write_text(rows.replace('"episodes"', '"eps"'))
    with pytest.raises(RunFolderError, match=r"rows\.json: a row of multi_robot has no 'episodes'"):
        write_report(folder)
    (folder / "rows.json").write_text(rows)
    (folder / "records" / "unit-00000.parquet").write_bytes(b"PAR1 no")
    with pytest.raises(RunFolderError, match=r"unit-00000\.parquet cannot be read as Parquet"):
        write_report(folder)
    shutil.rmtree(folder / "records")
    with pytest.raises(RunFolderError, match="no records yet"):
        write_report(folder)


def test_a_run_without_pictures_still_makes_a_report(tmp_path):
    folder = write_run(tmp_path)
    shutil.rmtree(folder / "pictures")
    html = write_report(folder).html.read_text()
    assert '<section id="failures"' not in html
    assert '<section id="leaderboard"' in html


# Who wins


def test_a_clear_lead_is_called_one_and_a_narrow_one_is_not(run_folder):
    group = load(run_folder).groups[0]
    assert group.best.label == "good"
    assert "good leads" in verdict(group)
    (rival,) = [e for e in group.competitors if e is not group.best]
    close = replace(rival, row=rival.row | {"ties_best": True})
    assert "No winner: good has the highest F1" in verdict(replace(group, entries=[group.best, close]))


def test_differences_are_those_of_the_rows(run_folder, outline):
    rows = [row for row in rows_of(run_folder) if row["method"] == "<b>bold</b>"]
    for row in rows:
        written = signed(row["f1_minus_best"]) + " to ".join(signed(row[f"f1_minus_best_{e}"]) for e in ("low", "high"))
        assert any(written in r for r in outline.rows)


def test_bayes_is_compared_with_where_it_is_not_the_best(tmp_path):
    folder = write_run(tmp_path)
    run = (folder / "run.json").read_text()
    (folder / "run.json").write_text(run.replace('"<b>bold</b>"', '"bayes"'))
    rows = rows_of(folder)
    for row in rows:
        if row["method"] == "<b>bold</b>":
            row |= {"method": "bayes", "f1_minus_bayes": 0.0, "f1_minus_bayes_low": None, "f1_minus_bayes_high": None}
        else:
            row |= {"f1_minus_bayes": 0.123, "f1_minus_bayes_low": -0.045, "f1_minus_bayes_high": 0.234}
    (folder / "rows.json").write_text(json.dumps({"rows": rows}))
    parser = Outline()
    parser.feed(write_report(folder).html.read_text())
    assert all("to bayes" in r for r in parser.rows if "to the best" in r)
    (first, *_) = [r for r in parser.rows if r and r[0] == "good" and len(r) > 6]
    assert first[3:5] == ["best", "+0.123−0.045 to +0.234"]


# Robustness


def test_robustness_follows_the_rates_of_the_rows(run_folder):
    group = load(run_folder).groups[0]
    best = group.best
    worse = [
        Entry(
            best.method,
            f"good@position_noise={rate}",
            best.row | {"disturbance": {"position_noise": rate}, "recall": r},
            [],
        )
        for rate, r in ((0.5, 0.2), (0.25, 0.4))
    ]
    group = replace(group, disturbed=worse)
    points = rates(group, best, "position_noise", "recall")
    assert points == [(0.0, best.row["recall"]), (25.0, 0.4), (50.0, 0.2)]
    section = figure_7([group])
    assert section is not None
    assert len(section.findall(".//figure")) == 2  # precision and recall
    assert figure_7([replace(group, disturbed=[])]) is None


def test_a_disturbed_method_without_its_undisturbed_self_is_a_method_like_others(tmp_path):
    folder = write_run(tmp_path)
    for file in (folder / "run.json", folder / "rows.json"):
        file.write_text(file.read_text().replace('"good"', '"rgm@position_noise=0.5"'))
    group = load(folder).groups[0]
    assert [e.label for e in group.entries] == ["rgm@position_noise=0.5", *METHODS[1:]]
    assert write_report(folder).html.exists()


def test_a_run_in_which_no_pair_was_matched_says_so_in_zeros(tmp_path):
    folder = write_run(tmp_path, rows=False)
    for number in range(2):
        empty = {"records": records_table([]), "pictures": pictures_table([])}
        Shards(folder, 2).write(number, empty)
    assert "| good | 0.000 |" in write_report(folder).markdown.read_text()


# Curves


def test_precision_recall_curve_of_a_case_done_by_hand():
    rng = np.random.default_rng(0)
    record = make_record("t", "good", 0, 0, rng).__class__(
        "t", "m", 0, 0, "a", "b", correct=2, retrieved=4, common=4, match_ms=1.0,
        scores=[0.9, 0.5, 0.7, 0.5], hits=[True, False, False, True],
    )  # fmt: skip
    recall, precision = pr_curve([record])
    np.testing.assert_allclose(recall, [0.25, 0.25, 0.5])
    np.testing.assert_allclose(precision, [1.0, 0.5, 0.5])
    assert average_precision(recall, precision) == pytest.approx(0.375)


def test_bins_hold_equal_numbers_and_small_samples_none():
    x = np.arange(24.0)
    assert binned(x, 2 * x) == [(3.5, 7.0), (11.5, 23.0), (19.5, 39.0)]
    assert binned(x[:15], x[:15]) == []


def test_axes_have_round_ticks_around_the_values():
    axis = linear_axis("m", [0.3, 2.9])
    assert (axis.low, axis.high, list(axis.ticks)) == (0, 3, [0, 1, 2, 3])
    assert list(log_axis("ms", [0.2, 30]).ticks) == [0.1, 1, 10, 100]


def test_tracks_follow_what_moves(run_folder):
    group = load(run_folder).groups[0]
    pages, (track,) = best_tracks(group, METHODS[0])
    assert [page.frame for page in pages] == [0, 1, 2, 3, 4]
    assert track.identity == 1
    assert len(track.truth) == len(track.single) == 5
    assert track.errors == pytest.approx((0.1, 0.05), abs=1e-6)
    _, still = best_tracks(group, METHODS[0], least_m=0.0)
    assert [track.identity for track in still] == [1, 2]  # the third was never matched rightly


def test_episodes_of_different_seeds_are_not_mixed(run_folder):
    group = load(run_folder).groups[0]
    again = [replace(page, seed=99) for page in group.pages]
    found = episodes(replace(group, pages=[*group.pages, *again]))
    assert [(pages[0].seed, len(pages)) for pages in found] == [(0, 5), (99, 5)]


def test_html_is_escaped_and_void_elements_stay_open():
    # A bare < inside a quoted attribute is plain HTML.
    assert page(h("p", {"title": '"<'}, "a < b", h("br"), "& c")) == (
        '<!doctype html>\n<p title="&quot;<">a &lt; b<br>&amp; c</p>\n'
    )
