"""Figures of runs, and of several seeds together."""

import json
import math
from pathlib import Path
from statistics import stdev

import pytest

from nerfloom.comparison.measures import measure, pareto, rows_of, whole_levels
from nerfloom.comparison.report import level_table
from nerfloom.comparison.runner import is_done
from tests.comparison.runs import CONDITIONS, finish, plan


def test_levels_are_met_on_straight_lines_between_evaluations() -> None:
    found = whole_levels(((10.0, 20.5), (20.0, 22.5), (30.0, 22.0), (40.0, 24.0)))
    assert found == {20: 10.0, 21: 12.5, 22: 17.5, 23: 35.0, 24: 40.0}
    assert whole_levels(()) == {}
    assert whole_levels(((5.0, 9.99),)) == {9: 5.0}


def test_figures_come_from_the_runs_files(tmp_path: Path) -> None:
    planned = plan(tmp_path, "kplanes --num-scales 2").runs()[0]
    assert measure(planned, CONDITIONS) is None
    finish(planned, 30.0)
    found = measure(planned, CONDITIONS)
    assert found is not None
    assert (found.psnr, found.ssim, found.lpips, found.views) == (30.0, 0.9, None, 16)
    assert found.render_seconds == 0.25
    assert found.curve == ((15.0, 27.0), (30.0, 28.0), (45.0, 29.0), (60.0, 30.0))
    assert found.seconds_to == {27: 15.0, 28: 30.0, 29: 45.0, 30: 60.0}
    assert found.command == "ns-train kplanes --num-scales 2 --machine.seed 42 --max-seconds 60.0"
    assert found.decisions == ("background: random, as there is <alpha>",)
    (planned.folder / "summary.json").write_text("{")
    assert measure(planned, CONDITIONS) is None


def test_surfaces_have_figures_where_there_was_a_reference(tmp_path: Path) -> None:
    judged, other = plan(tmp_path, "kplanes", "tensorf").runs()
    finish(judged, 30.0)
    finish(other, 30.0)
    evaluation = json.loads(judged.evaluation.read_text())
    scores = [{"distance": 0.1, "f_score": 0.4}, {"distance": 1.0, "f_score": 0.9}]
    geometry = {"chamfer_percent": 0.25, "f_scores": scores, "normals": {"degrees": 6.0, "cosine": 0.99}, "faces": 1234}
    judged.evaluation.write_text(json.dumps({**evaluation, "geometry": geometry}))
    found = measure(judged, CONDITIONS)
    assert found is not None
    assert (found.chamfer, found.f_score, found.normal_error, found.faces) == (0.25, 40.0, 6.0, 1234)
    without = measure(other, CONDITIONS)
    assert without is not None
    assert (without.chamfer, without.f_score, without.normal_error, without.faces) == (None,) * 4
    judged.evaluation.write_text(json.dumps({**evaluation, "geometry": {**geometry, "normals": None}}))
    bare = measure(judged, CONDITIONS)
    assert bare is not None
    assert bare.normal_error is None


def test_a_run_is_done_once_it_was_judged_and_is_finite(tmp_path: Path) -> None:
    whole, stopped, blown_up = plan(tmp_path, "tensorf", "kplanes", "nerfacto").runs()
    assert not is_done(whole)
    finish(whole, 30.0)
    finish(stopped, 30.0, interrupted=True)
    finish(blown_up, 30.0)
    evaluation = json.loads(blown_up.evaluation.read_text())
    evaluation["results"]["psnr"] = None
    blown_up.evaluation.write_text(json.dumps(evaluation))
    assert [is_done(planned) for planned in (whole, stopped, blown_up)] == [True, False, False]
    assert measure(blown_up, CONDITIONS) is None
    known = json.loads(whole.evaluation.read_text())
    for geometry, done in ((None, False), ({"chamfer_percent": 0.1}, True)):
        whole.evaluation.write_text(json.dumps({**known, "geometry": geometry}))
        assert is_done(whole)
        assert is_done(whole, judges_surface=True) is done


def test_seeds_are_put_together(tmp_path: Path) -> None:
    comparison = plan(tmp_path, "kplanes", "tensorf", repeats=3)
    values = {"kplanes": (30.0, 31.0, 32.5), "tensorf": (28.0,)}
    for planned in comparison.runs():
        number = planned.seed - 42
        if number < len(values[planned.contender.label]):
            finish(planned, values[planned.contender.label][number])
    runs = [run for run in (measure(planned, CONDITIONS) for planned in comparison.runs()) if run is not None]
    first, second, third = rows_of(["kplanes", "tensorf", "lost"], runs, {"tensorf": ["out of memory"]})
    assert first.mean("psnr") == pytest.approx(sum(values["kplanes"]) / 3)
    assert first.deviation("psnr") == pytest.approx(stdev(values["kplanes"]))
    assert first.seconds_to(28) is None  # one of the three had passed it when it was first judged
    assert first.seconds_to(30) == pytest.approx((60 + 45 + 22.5) / 3)
    assert [first.seconds_before(level) for level in (20, 27, 28)] == [15.0, None, None]
    assert third.seconds_before(20) is None
    table = level_table([first, second])  # from 25 dB on, which the second had at its first evaluation
    assert [cell.text for cell in table[0]["cells"][:3]] == ["< 15.0", "< 15.0", "–"]
    assert [cell.text for cell in table[1]["cells"][:3]] == ["15.0", "30.0", "45.0"]
    assert (second.deviation("psnr"), second.failures) == (None, ("out of memory",))
    assert second.mean("lpips") is None
    assert third.mean("psnr") is None


def test_the_front_against_its_definition() -> None:
    points = [(1.0, 20.0), (2.0, 25.0), (2.0, 24.0), (3.0, 25.0), (4.0, 30.0), (1.0, 20.0), (math.inf, 31.0)]
    assert pareto(points) == [True, True, False, False, True, True, True]
    assert pareto([]) == []
    assert pareto([(120.04, 33.0), (119.98, 29.0), (118.0, 28.0)]) == [True, False, True]  # one more step costs nothing
