from __future__ import annotations

import dataclasses
import html
import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.engine.labelled import Images, fake_predictor
from trilitenet.engine.compare import compare_reports
from trilitenet.engine.evaluate import evaluate
from trilitenet.engine.figures import FIGURES
from trilitenet.engine.page import percent
from trilitenet.engine.published_rows import PUBLISHED_ROWS
from trilitenet.engine.report import SAVED, Figure, Report, read_report
from trilitenet.engine.robustness import CORRUPTED, corrupted_figures, figures_by_size
from trilitenet.errors import ConfigError, DataError, OutputError
from trilitenet.processing.letterbox import Letterbox


@pytest.fixture(scope="module")
def report() -> Report:
    images = Images(40)
    about = {"model": "m<1>.onnx", "data": "d", "split": "val", "data_sha256": {"images": "ab"}}
    return evaluate(fake_predictor(images, drift=2), images, protocol="both", resamples=60, worst=2, about=about)


def test_the_json_form_holds_everything_but_pictures(report: Report, tmp_path: Path) -> None:
    path = tmp_path / "deep" / "report.json"
    report.save_json(path)
    mapping = json.loads(path.read_text(), parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    assert mapping["schema"] == 1
    assert [(row["value"], row["few"]) for row in mapping["conditions"]] == [
        ("daytime", False),
        ("night", True),
    ]  # 30, 10
    assert set(mapping["provenance"]) >= {"model", "model_sha256", "data_sha256", "thresholds", "versions", "hardware"}
    again = read_report(path)
    assert str(again.fair) == str(report.fair)
    assert str(again.paper) == str(report.paper)
    known = {key for key, figure in report.figures.items() if not math.isnan(figure.value)}
    assert report.figures.keys() - known == {"fair/detection/ap_medium", "fair/detection/ap_large"}  # no such boxes
    assert {key: again.figures[key] for key in known} == {key: report.figures[key] for key in known}
    assert str(again.values()) == str(report.values())
    assert str(again.conditions) == str(report.conditions)
    assert again.plots == report.plots
    assert again.provenance == report.provenance
    assert [dataclasses.replace(frame, picture=b"") for frame in report.worst] == list(again.worst)


def test_every_figure_has_a_formula(report: Report) -> None:
    assert set(report.figures) <= set(FIGURES)
    assert all(FIGURES[key].formula for key in report.figures)


def test_the_page_is_self_contained_and_escaped(report: Report, tmp_path: Path) -> None:
    report.save_html(tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text()
    assert "m&lt;1&gt;.onnx" in text
    assert "m<1>" not in text
    assert not re.search(r"(src|href)=\"(?!data:)", text)
    assert "<script" not in text
    assert text.count("data:image/jpeg;base64,") == 6  # two a task
    assert "Worst images: lane" in text
    assert re.search(r"<tr class=few><td>night", text)
    assert "$" not in text  # no placeholder left
    for tag in ("table", "div", "section", "figure", "svg", "tr", "td"):
        assert len(re.findall(f"<{tag}[ >]", text)) == text.count(f"</{tag}>"), tag


def test_the_confusion_of_many_classes_has_the_width_of_the_page(report: Report, tmp_path: Path) -> None:
    assert report.plots is not None
    for count, wide in ((2, False), (10, True)):
        names = ("background", *(f"<{number}>" for number in range(1, count)))  # a class may be called so, too
        confusion = tuple(tuple(range(count + 1)) for _ in range(count + 1))
        plots = dataclasses.replace(report.plots, class_names=(*names, "background"), confusion=confusion)
        dataclasses.replace(report, plots=plots).save_html(tmp_path / "report.html")
        page = (tmp_path / "report.html").read_text()
        assert ('class="card wide"' in page) == wide
        head, *rows = re.findall("<tr>(.*?)</tr>", page.partition("Confusion at")[2].partition("</table>")[0])
        words = [html.escape(name) for name in names]
        assert re.findall("<th>(.*?)</th>", head)[1:] == [*words, "missed"]
        assert [row.split("</th>")[0].removeprefix("<th>") for row in rows] == [*words, "nothing there"]
        assert re.findall("<td>(.*?)</td>", rows[0]) == [str(number) for number in range(count + 1)]
        assert re.findall("<td>(.*?)</td>", rows[-1])[-1] == ""


def test_the_terminal_form_names_every_figure(report: Report, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    text = report.summary()
    assert "fair protocol" in text
    assert "paper protocol" in text
    assert "95% interval" in text
    assert f"{percent(report.figures['fair/drivable/miou'].value)} " in text
    assert re.search(r"night +10 +\(", text)  # few images stand in brackets
    assert "\x1b" not in text  # no colours into a pipe
    assert max(map(len, text.splitlines())) <= 100
    assert text.count("timeofday") == 2  # once a protocol
    monkeypatch.setenv("COLUMNS", "250")
    fair, paper = report.summary().split("paper protocol")
    assert (fair.count("mean over batches"), paper.count("mean over batches")) == (0, 8)


def test_on_a_narrow_terminal_nothing_is_cut_off(report: Report, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    named = dataclasses.replace(report.conditions[0], attribute="source", value="traffic_light_samples")
    elsewhere = dataclasses.replace(report.provenance, data=f"/home/{'somebody' * 9}/bdd100k")
    long = dataclasses.replace(report, conditions=(named,), provenance=elsewhere)
    conditions = long.summary().partition("by condition, fair")[2]
    published = compare_reports({"a": long}, resamples=0, published=True).summary().partition("beside published")[2]
    for text, last in ((conditions, "mples"), (published, "72.3")):
        assert last in text
        assert "\N{HORIZONTAL ELLIPSIS}" not in text
        assert max(map(len, text.splitlines())) <= 80


def test_what_is_no_report_is_refused(tmp_path: Path, report: Report) -> None:
    path = tmp_path / "report.json"
    with pytest.raises(DataError, match="cannot be read"):
        read_report(path)
    for content in ("", "[]", "{}", '{"schema": 1}'):
        path.write_text(content)
        with pytest.raises(DataError, match="not a report"):
            read_report(path)
    figure = {"value": 10**400, "low": None, "high": None}
    path.write_text(json.dumps(report.to_dict() | {"figures": {"fair/lane/iou": figure}}))
    with pytest.raises(DataError, match="not a report"):
        read_report(path)
    path.write_text(json.dumps(report.to_dict() | {"schema": "one"}))
    with pytest.raises(DataError, match="not a report"):
        read_report(path)
    whole = report.to_dict()
    for part, key, value in (
        ("provenance", "model", ["tiny"]),
        ("provenance", "settings", []),
        ("provenance", "settings", {"paper_thresholds": 3}),
        ("provenance", "data_sha256", 3),
        ("provenance", "thresholds", {"confidence": "much"}),
        ("state", "fair", []),
    ):
        path.write_text(json.dumps(whole | {part: whole[part] | {key: value}}))
        with pytest.raises(DataError, match="not a report"):
            read_report(path)
    path.write_text(json.dumps(whole | {"images": whole["images"][1:]}))
    with pytest.raises(DataError, match="not a report"):
        read_report(path)
    path.write_text(json.dumps(report.to_dict() | {"schema": 99}))
    with pytest.raises(DataError, match=r"report\.json: report schema 99 is newer than 1; upgrade trilitenet$"):
        read_report(path)
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be written"):
        report.save_json(tmp_path / "file" / "report.json")


def test_a_model_does_not_differ_from_itself(report: Report) -> None:
    comparison = compare_reports({"a": report, "b": report}, resamples=50)
    assert len(comparison.differences) == len(report.figures) - 2  # medium and large boxes, which there are none of
    assert all(one.value == 0 and not one.real for one in comparison.differences)


def test_real_differences_are_told_from_chance(report: Report) -> None:
    images = Images(40)
    better = evaluate(fake_predictor(images), images, protocol="both", resamples=0)
    comparison = compare_reports({"drifting": report, "exact": better}, resamples=200)
    lane = comparison.difference("exact", "fair/lane/iou")
    assert lane is not None
    assert lane.real
    assert lane.low <= lane.value <= lane.high
    assert lane.low > 0
    # The same images are drawn for both, so the difference is surer than the two intervals would tell.
    apart = report.figures["fair/drivable/iou"]
    together = comparison.difference("exact", "fair/drivable/iou")
    assert together is not None
    assert apart.high is not None
    assert apart.low is not None
    assert together.high - together.low <= apart.high - apart.low + 1e-9
    text = comparison.summary()
    assert "exact" in text
    assert "*" in text
    assert f"({100 * lane.low:+.1f} to {100 * lane.high:+.1f})*" in " ".join(text.split())
    worse = compare_reports({"exact": better, "drifting": report}, resamples=200).difference(
        "drifting", "fair/lane/iou"
    )
    assert worse is not None
    assert (worse.value, worse.real) == (-lane.value, True)
    assert worse.low <= worse.value <= worse.high < 0


def test_reports_of_other_images_or_labels_are_not_paired(report: Report) -> None:
    images = Images(12)
    other = evaluate(fake_predictor(images), images, resamples=0)
    relabelled = dataclasses.replace(
        report, provenance=dataclasses.replace(report.provenance, data_sha256={"images": "cd"})
    )
    comparison = compare_reports({"a": report, "b": other, "c": relabelled}, resamples=10)
    assert not comparison.differences
    assert "other images" in comparison.unpaired["b"]
    assert "other images under the same names" in comparison.unpaired["c"]
    hashes = dict.fromkeys(("images", "drivable", "lane", "boxes"), "ab")
    first, other_boxes = (
        dataclasses.replace(report, provenance=dataclasses.replace(report.provenance, data_sha256=found))
        for found in (hashes, {**hashes, "boxes": "cd"})
    )
    comparison = compare_reports({"a": first, "b": other_boxes}, resamples=10)
    assert "other labels of boxes; no paired differences of detection figures" in comparison.unpaired["b"]
    assert {one.figure.split("/")[1] for one in comparison.differences} == {"drivable", "lane"}
    lanes_alone = dataclasses.replace(
        other_boxes, figures={key: one for key, one in report.figures.items() if "/lane/" in key}
    )
    comparison = compare_reports({"a": first, "b": lanes_alone}, resamples=10)
    assert not comparison.unpaired
    assert list(comparison.confidence) == ["a"]
    others = dataclasses.replace(report, names=tuple(f"other {name}" for name in report.names))
    assert not compare_reports({"a": report, "b": others}, resamples=10).differences  # as many, but not the same
    settings = {**report.provenance.settings, "paper_batch": 3}
    batches = dataclasses.replace(report, provenance=dataclasses.replace(report.provenance, settings=settings))
    fair = report.state["fair"]
    renamed = {**report.state, "fair": {**fair, "detection": {**fair["detection"], "class_names": ["lorry"]}}}
    saved = dataclasses.replace(report, provenance=dataclasses.replace(report.provenance, runtime=SAVED))
    comparison = compare_reports(
        {"a": report, "b": batches, "c": dataclasses.replace(report, state=renamed), "d": saved}, resamples=10
    )
    assert "batches of 3" in comparison.unpaired["b"]
    assert "tells lorry" in comparison.unpaired["c"]
    assert "saved predictions" in comparison.unpaired["d"]
    for name in ("b", "d"):
        assert comparison.difference(name, "fair/drivable/iou") is not None
        assert comparison.difference(name, "paper/drivable/miou") is None
        assert f"{name}: {comparison.unpaired[name]}" in " ".join(comparison.summary().split())
    with pytest.raises(ConfigError, match="at least one"):
        compare_reports({})


def test_differences_are_drawn_by_the_groups_of_the_images(report: Report, tmp_path: Path) -> None:
    images = Images(40)
    better = evaluate(fake_predictor(images), images, protocol="both", resamples=0)
    grouped = dataclasses.replace(report, groups=tuple(index // 8 for index in range(40)), group="sequence")
    key = "fair/drivable/iou"
    plain = compare_reports({"a": report, "b": better}, resamples=100)
    whole = compare_reports({"a": grouped, "b": better}, resamples=100)
    one, other = plain.difference("b", key), whole.difference("b", key)
    assert one is not None
    assert other is not None
    assert one.value == other.value
    assert (one.low, one.high) != (other.low, other.high)
    assert whole.drawn == "5 groups of images (by sequence)"
    assert whole.drawn in " ".join(whole.summary().split())
    grouped.save_json(tmp_path / "report.json")
    again = read_report(tmp_path / "report.json")
    assert (again.groups, again.group, again.drawn) == (grouped.groups, "sequence", grouped.drawn)
    alone = compare_reports({"a": dataclasses.replace(report, groups=(0,) * 40), "b": better}, resamples=20)
    assert not alone.differences
    assert "1 group of images" in alone.unpaired["b"]


def test_a_report_of_before_a_figure_was_known_is_compared_in_the_others(report: Report, tmp_path: Path) -> None:
    mapping = report.to_dict()
    new = [key for key in mapping["figures"] if re.search(r"_(small|medium|large|best|025)$", key)]
    assert len(new) == 9
    for key in new:
        del mapping["figures"][key], mapping["meanings"][key]
    del mapping["state"]["fair"]["detection"]["lowest"], mapping["provenance"]["settings"]["paper_thresholds"]
    path = tmp_path / "report.json"
    path.write_text(json.dumps(mapping))
    older = read_report(path)
    for pair in ({"a": older, "b": report}, {"a": report, "b": older}):
        comparison = compare_reports(pair, resamples=10)
        assert {one.figure for one in comparison.differences} == older.figures.keys()
        assert "best F1" in comparison.summary()
    assert older.thresholds().keys() == {"fair"}
    older.save_html(tmp_path / "report.html")


def test_of_the_published_protocol_alone_plots_pixels_and_counts_are_its_own(tmp_path: Path) -> None:
    images = Images(12)
    images._samples[3] = dataclasses.replace(images[3], lane=None)
    alone = evaluate(fake_predictor(images, drift=2), images, protocol="paper", resamples=0)
    assert alone.paper is not None
    boxes, lane = alone.paper.detection, alone.paper.lane
    assert boxes is not None
    assert lane is not None
    assert alone.plots is not None
    assert (sum(alone.plots.right) + sum(alone.plots.wrong), alone.plots.confusion) == (boxes.boxes, ())
    assert alone.plots.recall[-1] == pytest.approx(boxes.recall)
    assert alone.plots.precision[-1] == pytest.approx(boxes.precision)
    text = alone.summary()
    assert "paper  with confidence 0.001, iou 0.6, max_boxes 300, drivable 0.5, lane 0.5\n" in text
    assert "fair   with" not in text
    assert "lane: 11 images count, 1 not labelled" in text
    assert "\n\n" not in text
    alone.save_html(tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert all(
        part in page for part in ("Precision and recall", "Confidence of right", "Drivable area", "Lane marking")
    )
    assert f"{lane.true_positive:,}".replace(",", " ") in page
    assert "Confusion at" not in page
    assert "The confusion of boxes and the worst images need the fair protocol" in page
    assert "<dt>paper with</dt><dd>confidence 0.001, iou 0.6" in page
    alone.save_json(tmp_path / "report.json")
    assert str(read_report(tmp_path / "report.json").plots) == str(alone.plots)
    assert not compare_reports({"a": alone, "b": alone}, resamples=0).confidence


def test_each_protocol_is_told_with_what_it_decided_by(report: Report, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "160")  # no line is broken
    assert report.thresholds() == {
        "fair": "confidence 0.3, iou 0.6, max_boxes 300, drivable 0.5, lane 0.5",
        "paper": "confidence 0.001, iou 0.6, max_boxes 300, drivable 0.5, lane 0.5",
    }
    assert "fair   with confidence 0.3" in report.summary()
    assert "best F1 at confidence 0.81" in report.summary()


@pytest.mark.parametrize("groups", [[0, 1], [-1] * 40, ["a"] * 40])
def test_groups_that_are_none_are_refused(report: Report, tmp_path: Path, groups: list[object]) -> None:
    path = tmp_path / "report.json"
    path.write_text(json.dumps(report.to_dict() | {"groups": groups}))
    with pytest.raises(DataError, match="not a report"):
        read_report(path)


def test_published_rows_stand_beside_with_their_protocol(report: Report, tmp_path: Path) -> None:
    comparison = compare_reports({"mine": report}, published=True, resamples=10)
    text = comparison.summary()
    assert "YOLOPX" in text
    assert "recall at confidence 0.001" in " ".join(text.split())
    comparison.save(tmp_path)
    mapping = json.loads((tmp_path / "comparison.json").read_text())
    assert len(mapping["published"]) == len(PUBLISHED_ROWS)
    assert all(row["protocol"] for row in mapping["published"])
    page = (tmp_path / "comparison.html").read_text()
    assert "A-YOLOM (n)" in page
    assert "Che and Lam, " in page
    assert '<td class="n">13.61</td><td class="n">19.22</td>' in page


def test_published_rows_name_the_paper_and_their_table(report: Report, monkeypatch: pytest.MonkeyPatch) -> None:
    comparison = compare_reports({"mine": report}, published=True, resamples=0)
    for width, base in ((110, r"92\.4 +82\.3 +29\.8 +2\.35 +7\.72\n"), (80, r"92\.4 +82\.3 +29\.8\n")):
        monkeypatch.setenv("COLUMNS", str(width))
        text = comparison.summary().partition("beside published")[2]
        assert re.search(rf"TriLiteNet base \[1\] .* {base}", re.sub(" +\n", "\n", text))
        told = " ".join(text.split())
        assert "measured here: mine on d val published: Che and Lam, " in told
        assert "[1] table of configurations; paper: 640x384" in told
        assert "[2] table of precision levels (captioned base, holds small's values); paper: " in told
        assert "[3] table of comparison; as the paper prints it" in told
        assert "TriLiteNet small INT8 [2]" in told
        assert "YOLOPX [3]" in told


def test_what_cannot_stand_beside_published_rows_says_what_it_lacks(report: Report, tmp_path: Path) -> None:
    fair = dataclasses.replace(report, figures={key: f for key, f in report.figures.items() if key.startswith("fair")})
    for reports, lacking in (({"a": fair, "b": fair}, "a, b: "), ({"a": fair, "b": report}, "a: ")):
        comparison = compare_reports(reports, published=True, resamples=0)
        comparison.save(tmp_path)
        note = f"{lacking}evaluate with --protocol paper (or both) to stand beside published rows"
        assert f"\n{note}" in comparison.summary()
        assert f" {note}." in (tmp_path / "comparison.html").read_text()
    comparison = compare_reports({"b": report}, published=True, resamples=0)
    comparison.save(tmp_path)
    assert not any("--protocol" in text for text in (comparison.summary(), (tmp_path / "comparison.html").read_text()))


def test_notes_stand_below_the_plots(report: Report, tmp_path: Path) -> None:
    surer = {**report.provenance.thresholds, "confidence": 0.9}
    boxes = {**report.provenance.data_sha256, "boxes": "cd"}
    first, other = (
        dataclasses.replace(report, provenance=dataclasses.replace(report.provenance, **fields))
        for fields in ({"data_sha256": boxes}, {"data_sha256": {**boxes, "boxes": "ef"}, "thresholds": surer})
    )
    compare_reports({"a": first, "b": other}, resamples=10).save(tmp_path)
    plots, _, below = (tmp_path / "comparison.html").read_text().partition("</svg></div></div>")
    notes = ("stated at other confidences", "b: measured with other labels of boxes")
    assert all(note in below.partition("</section>")[0] and note not in plots for note in notes)


def test_what_is_the_same_is_not_called_chance(report: Report, tmp_path: Path) -> None:
    comparison = compare_reports({"a": report, "b": report}, resamples=10)
    comparison.save(tmp_path)
    page = (tmp_path / "comparison.html").read_text()
    assert "may be chance" not in page
    assert page.count('<span class="note">no difference</span>') == len(comparison.differences) > 0
    assert comparison.summary().count("(no difference)") == len(comparison.differences)
    slight = dataclasses.replace(comparison.differences[0], low=-1e-5, high=1e-5)
    dataclasses.replace(comparison, differences=(slight,)).save(tmp_path)
    assert "-0.0 to +0.0, may be chance" in (tmp_path / "comparison.html").read_text()


def test_brackets_and_colons_in_names_are_no_markup(report: Report) -> None:
    names = ("tiny[int8].onnx", "a:car:b", "c[/d]")
    shown = compare_reports(dict.fromkeys(names, report), published=True, resamples=0).summary()
    assert all(name in shown.split("beside published")[0] for name in names)
    assert "[1]" in shown


def test_published_rows_are_those_of_the_paper() -> None:
    rows = {row.name: row for row in PUBLISHED_ROWS}
    base = rows["TriLiteNet base"]
    assert (base.recall, base.map50, base.miou, base.acc, base.iou) == (85.6, 72.3, 92.4, 82.3, 29.8)
    # The slip in the table of cost (n and s swapped) is not in the table of comparison.
    assert (rows["A-YOLOM (n)"].parameters, rows["A-YOLOM (s)"].parameters) == (4.43, 13.61)
    assert rows["YOLOPv2"].printed == ["91.1", "83.4", "93.2", "-", "27.25"]
    assert rows["TriLiteNet tiny"].figures["paper/lane/iou"] == pytest.approx(0.242)
    assert len(rows) == len(PUBLISHED_ROWS)


def test_corruptions_are_measured_and_averaged(tmp_path: Path) -> None:
    images = Images(6)
    predictor = fake_predictor(images)
    clean = evaluate(predictor, images, resamples=0)
    passes: list[str] = []
    rows = corrupted_figures(
        predictor, images, clean, corruptions=("contrast", "pixelate"), severities=(1, 5), on_pass=passes.append
    )
    assert passes == ["contrast 1", "contrast 5", "pixelate 1", "pixelate 5"]
    shown = {row.name: row.figures for row in rows if not row.detail}
    detail = {row.name: row.figures for row in rows if row.detail}
    key = "fair/drivable/miou"
    assert list(shown) == ["clean", "contrast", "pixelate", "mean of corruptions", "mean corruption drop"]
    assert shown["contrast"][key] == pytest.approx((detail["contrast 1"][key] + detail["contrast 5"][key]) / 2)
    mean = (shown["contrast"][key] + shown["pixelate"][key]) / 2
    assert shown["mean corruption drop"][key] == pytest.approx(1.0 - mean)
    varied = dataclasses.replace(clean, variations=rows)
    text = varied.summary().split(CORRUPTED)[1]
    assert text.count("mIoU") == 1  # no column of a protocol that was not asked for
    varied.save_html(tmp_path / "report.html")
    for shown_form in (text, (tmp_path / "report.html").read_text()):
        assert "pixelate" in shown_form
        assert "pixelate 1" not in shown_form
    varied.save_json(tmp_path / "report.json")
    assert str(read_report(tmp_path / "report.json").variations) == str(rows)
    assert all(row.kind == CORRUPTED for row in rows)


def test_input_sizes_are_swept(tmp_path: Path) -> None:
    images = Images(4)
    sizes = {96: fake_predictor(images), 192: fake_predictor(images)}
    sizes[192].long_side = 192
    # The fake network knows boxes at 96 pixels only.
    rows = figures_by_size(sizes, images)
    assert [row.name for row in rows] == ["96", "192"]
    assert rows[0].figures["fair/drivable/miou"] == 1.0
    assert rows[1].figures["fair/drivable/miou"] > 0.95
    report = dataclasses.replace(evaluate(sizes[96], images, resamples=0), variations=rows)
    report.save_json(tmp_path / "report.json")
    report.save_html(tmp_path / "report.html")
    assert str(read_report(tmp_path / "report.json").variations) == str(rows)
    assert "Input sizes" in (tmp_path / "report.html").read_text()


def test_undefined_figures_are_a_dash() -> None:
    assert percent(float("nan")) == percent(None) == "-"
    assert percent(np.float64(0.1234)) == "12.3"


def test_undefined_figures_have_neither_interval_nor_verdict(tmp_path: Path) -> None:
    images = Images(3)
    images._samples = [dataclasses.replace(sample, drivable=None) for sample in images._samples]
    report = evaluate(fake_predictor(images), images, protocol="both", resamples=10)
    assert (Figure(0.5, 0.25, 0.75).spread, Figure(0.5).spread) == ("25.0 to 75.0", "")
    report.save_html(tmp_path / "report.html")
    comparison = compare_reports({"a": report, "b": report}, resamples=10)
    comparison.save(tmp_path)
    assert {one.figure.split("/")[1] for one in comparison.differences} == {"detection", "lane"}
    pages = [(tmp_path / f"{name}.html").read_text() for name in ("report", "comparison")]
    assert not any("- to -" in text for text in (report.summary(), comparison.summary(), *pages))


def test_a_report_from_where_the_system_tells_no_memory_is_shown(report: Report, tmp_path: Path) -> None:
    provenance = dataclasses.replace(report.provenance, peak_memory_mib=float("nan"))
    dataclasses.replace(report, provenance=provenance).save_json(tmp_path / "report.json")
    again = read_report(tmp_path / "report.json")
    assert math.isnan(again.provenance.peak_memory_mib)
    assert "memory" in again.summary()


def test_every_image_has_noise_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    images = Images(3)
    coded = images[1].image
    images._samples = [dataclasses.replace(images[index], image=np.full_like(coded, 100)) for index in (1, 2)]
    predictor = fake_predictor(images)
    seen: list[NDArray[np.uint8]] = []
    plain = predictor.preprocess

    def preprocess(image: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], Letterbox]:
        seen.append(image)
        return plain(coded)  # the fake network reads the number of the image in it

    monkeypatch.setattr(predictor, "preprocess", preprocess)
    clean = evaluate(predictor, images, resamples=0)
    corrupted_figures(predictor, images, clean, corruptions=("gaussian_noise",), severities=(3,))
    assert len(seen) == 4
    assert np.array_equal(seen[0], seen[1])
    assert not np.array_equal(seen[2], seen[3])


def test_undefined_figures_stay_undefined_in_a_file(tmp_path: Path) -> None:
    images = Images(3)
    images._samples = [dataclasses.replace(sample, drivable=None) for sample in images._samples]
    report = evaluate(fake_predictor(images), images, resamples=0)
    rows = figures_by_size({96: fake_predictor(images)}, images)
    dataclasses.replace(report, variations=rows).save_json(tmp_path / "report.json")
    again = read_report(tmp_path / "report.json")
    key = "fair/drivable/miou"
    assert math.isnan(report.figures[key].value)
    assert math.isnan(again.figures[key].value)
    tables = [row.figures for row in again.conditions] + [row.figures for row in again.variations]
    assert len(tables) == 3
    assert all(math.isnan(figures[key]) for figures in tables)
