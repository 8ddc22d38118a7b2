"""The report: complete, self-contained, and with missing values marked."""

import base64
import csv
import io
import json
import re
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
from rich.console import Console

from nerfloom.comparison import plots
from nerfloom.comparison.crops import data_uri, views, worst_square
from nerfloom.comparison.measures import measure, rows_of
from nerfloom.comparison.plan import Plan
from nerfloom.comparison.report import COLUMNS, console_table, write_report
from tests.comparison.runs import CONDITIONS, draw, finish, plan

LABELS = ("instant-ngp", "kplanes --num-scales 2", "tensorf")


@pytest.fixture
def compared(tmp_path: Path) -> Plan:
    """Two methods that worked, one that failed."""
    comparison = plan(tmp_path, *LABELS)
    for number, planned in enumerate(comparison.runs()[:2]):
        finish(planned, 30.0 + number, 60.0 + number)
        draw(planned, number)
    runs = [run for run in (measure(planned, CONDITIONS) for planned in comparison.runs()) if run is not None]
    write_report(comparison, rows_of(LABELS, runs, {"tensorf": ["seed 42: <out> of memory (x.log)"]}))
    return comparison


def test_the_page_holds_everything_and_needs_nothing(compared: Plan) -> None:
    page = (compared.folder / "report.html").read_text()
    assert not re.findall(r'(?:src|href)="(?!data:image/png;base64,|#)', page)
    assert "&lt;out&gt; of memory" in page
    assert "there is &lt;alpha&gt;" in page
    assert page.count("kplanes --num-scales 2") >= 4
    assert "31.00" in page
    assert "abacus" in page
    assert page.count('<img class="crop"') == 2 * (1 + 2 + 2)
    if plots.available():
        assert "<svg" in page
    assert "{{" not in page


def test_what_has_not_run_yet_has_not_failed_and_machines_that_were_shared_are_named(compared: Plan) -> None:
    runs = [run for run in (measure(planned, CONDITIONS) for planned in compared.runs()) if run is not None]
    write_report(compared, rows_of(LABELS, runs, {}), "2 runs at a time on one machine.")
    text = (compared.folder / "report.md").read_text()
    assert "| tensorf | not run |" in text
    assert "- 2 runs at a time on one machine. " in text
    page = (compared.folder / "report.html").read_text()
    assert "2 runs at a time on one machine. " in page
    assert ">not run</td>" in page


def test_tables_in_markdown_and_csv_and_json(compared: Plan) -> None:
    text = (compared.folder / "report.md").read_text()
    row = next(line for line in text.splitlines() if line.startswith("| kplanes"))
    assert "**31.00**" in row
    assert next(line for line in text.splitlines() if line.startswith("| instant-ngp")).startswith("| instant-ngp* |")
    assert "| tensorf | failed |" in text
    assert "- Kernels: avx2." in text
    assert "**tensorf failed**: seed 42" in text
    rows = list(csv.DictReader(io.StringIO((compared.folder / "results.csv").read_text())))
    assert [row["label"] for row in rows] == list(LABELS[:2])
    assert float(rows[1]["seconds to 31 dB"]) == 60.0
    assert rows[0]["seconds to 31 dB"] == ""
    content = json.loads((compared.folder / "results.json").read_text())
    assert content["runs"][0]["seconds_to"] == {"27": 15.0, "28": 30.0, "29": 45.0, "30": 60.0}
    assert content["runs"][1]["curve"][-1] == [60.0, 31.0]
    assert content["failures"] == {"tensorf": ["seed 42: <out> of memory (x.log)"]}


def test_the_terminal_s_table_fits_eighty_columns() -> None:
    """The table has six methods, one of them with a long name."""
    labels = [*LABELS, "kplanes", "nerfacto", "dnerf --sampler occupancy --canonical hash-grid"]
    table = console_table(rows_of(labels, [], {label: ["no luck"] for label in labels}))
    console = Console(width=80, file=io.StringIO())
    console.print(table)
    assert isinstance(console.file, io.StringIO)
    lines = console.file.getvalue().splitlines()
    assert sum("failed" in line for line in lines) == len(COLUMNS)
    assert any("PSNR, dB" in line for line in lines)


def test_what_nobody_has_measured_has_no_column(compared: Plan) -> None:
    lines = (compared.folder / "report.md").read_text().splitlines()
    head = next(line for line in lines if line.startswith("| method"))
    assert "PSNR, dB" in head
    assert "floaters" not in head  # no run has sparse points


def test_surfaces_have_columns_and_say_how_they_were_compared(tmp_path: Path) -> None:
    comparison = plan(tmp_path / "out", "kplanes", "tensorf")
    for planned, chamfer in zip(comparison.runs(), (0.25, 0.5), strict=True):
        finish(planned, 30.0)
        evaluation = json.loads(planned.evaluation.read_text())
        evaluation["geometry"] = {
            "reference": "/data/solids/reference.ply", "side": 2.0, "chamfer_percent": chamfer, "faces": 1234,
            "f_scores": [{"distance": 0.005, "f_score": 0.4}], "normals": {"degrees": 6.0, "cosine": 0.99},
        }  # fmt: skip
        planned.evaluation.write_text(json.dumps(evaluation))
    runs = [run for run in (measure(planned, CONDITIONS) for planned in comparison.runs()) if run is not None]
    write_report(comparison, rows_of(["kplanes", "tensorf"], runs, {}))
    text = (comparison.folder / "report.md").read_text()
    head = next(line for line in text.splitlines() if line.startswith("| method")).split(" | ")
    row = next(line for line in text.splitlines() if line.startswith("| kplanes")).split(" | ")
    assert row[head.index("Chamfer, % of side")] == "**0.250**"
    assert row[head.index("F-score, %")] == "40.0"
    assert row[head.index("normals, °")] == "6.00"
    assert row[head.index("faces")] == "1,234"
    assert "Surfaces are compared with reference.ply (longest side 2); F-score at 0.005, both in" in text
    (csv_row, _) = csv.DictReader(io.StringIO((comparison.folder / "results.csv").read_text()))
    assert csv_row["chamfer"] == "0.25"


def test_all_may_have_failed(tmp_path: Path) -> None:
    comparison = plan(tmp_path, "tensorf")
    page = write_report(comparison, rows_of(["tensorf"], [], {"tensorf": ["no luck"]})).read_text()
    assert "no luck" in page
    assert "<svg" not in page


def test_crops_are_where_the_methods_are_wrong(tmp_path: Path) -> None:
    wrong = np.zeros((60, 90))
    wrong[20:40, 50:70] = 1
    top, left, edge = worst_square(wrong)
    assert edge == 32
    assert wrong[top : top + edge, left : left + edge].sum() == wrong.sum()
    assert worst_square(np.ones((5, 7))) == (0, 0, 5)
    all_planned = plan(tmp_path, "kplanes", "tensorf").runs()
    draw(all_planned[0], 0, ("a", "b", "c"))
    draw(all_planned[1], 1, ("b", "c", "d"))
    found = views([(planned.contender.label, planned.pictures) for planned in all_planned])
    assert [view.name for view in found] == ["b", "c"]
    assert views([("x", tmp_path / "nowhere")]) == []
    image = np.random.default_rng(0).integers(0, 256, (3, 4, 3), dtype=np.uint8)
    assert np.array_equal(iio.imread(base64.b64decode(data_uri(image).split(",")[1])), image)
