"""Plans: contenders, conditions and commands."""

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest

from nerfloom.base.errors import ConfigError
from nerfloom.cli.compare import CompareFlags, plan_of
from nerfloom.comparison.crops import MAX_VIEWS
from nerfloom.comparison.plan import Conditions, Contender, Plan, PlannedRun, split_words, views_for
from nerfloom.comparison.runner import job_of
from nerfloom.jobs.job import Resources

CONDITIONS = Conditions("/data/lego", ("--downscale-factor", "2"), 120.0, None, None, 2, "cpu", 4, None)


def test_a_contender_is_a_method_and_its_flags() -> None:
    plain = Contender.of("instant-ngp")
    assert (plain.method, plain.flags, plain.slug) == ("instant-ngp", (), "instant-ngp")
    other = Contender.of('vanilla-nerf  --sampler occupancy --note "two words"')
    assert other.flags == ("--sampler", "occupancy", "--note", "two words")
    assert other.label == 'vanilla-nerf --sampler occupancy --note "two words"'
    assert other.slug.startswith("vanilla-nerf-sampler-occupancy-note-two-words-")


def test_labels_that_differ_have_folders_that_differ() -> None:
    labels = ["kplanes --num-scales 2", "kplanes --num-scales=2", "kplanes --num-scales -2", "kplanes"]
    labels.append("kplanes " + "--learning-rate 1 " * 20)
    labels.append("kplanes " + "--learning-rate 1 " * 21)
    slugs = {Contender.of(label).slug for label in labels}
    assert len(slugs) == len(labels)
    assert all(len(slug) < 80 for slug in slugs)


@pytest.mark.parametrize(
    ("text", "reason"),
    [("", "names no method"), ("kplane", "Did you mean 'kplanes'"), ('kplanes "open', "is invalid: No closing")],
)
def test_what_is_no_contender(text: str, reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        Contender.of(text)


def test_words_are_those_of_a_shell() -> None:
    assert split_words("--scale-factor 2 'a b'", "--data-flags") == ("--scale-factor", "2", "a b")
    with pytest.raises(ConfigError, match='--data-flags: "\'open" is invalid: No closing'):
        split_words("'open", "--data-flags")


@pytest.mark.parametrize("seconds", [math.nan, math.inf])
def test_a_budget_without_end_is_refused(seconds: float) -> None:
    """A recipe can have such a budget: YAML knows .nan and .inf."""
    with pytest.raises(ConfigError, match=r"--max-seconds is (nan|inf); it must be more than 0 and finite"):
        plan_of(CompareFlags(methods=("instant-ngp",), max_seconds=seconds))


def test_conditions_must_end_somewhere() -> None:
    with pytest.raises(ConfigError, match="set the training budget"):
        replace(CONDITIONS, max_seconds=None)
    nothings = ({"max_seconds": 0.0}, {"max_num_iterations": 0}, {"target_psnr": math.nan}, {"max_seconds": math.inf})
    for nothing in nothings:
        with pytest.raises(ConfigError, match="must be more than 0"):
            replace(CONDITIONS, **nothing)
    assert CONDITIONS.budget() == "120 s of training"
    assert replace(CONDITIONS, target_psnr=30.0).budget() == "120 s of training, until 30.0 dB on the validation views"


def test_commands_say_all_that_is_the_same_and_the_contenders_flags_count_last(tmp_path: Path) -> None:
    planned = PlannedRun(Contender.of("vanilla-nerf --machine.seed 7"), 43, tmp_path / "runs")
    words = planned.train_command(CONDITIONS)
    words = words[words.index("nerfloom.cli.train") + 1 :]
    assert words[0] == "vanilla-nerf"
    assert words[-4:] == ["--machine.seed", "7", "--downscale-factor", "2"]
    given = dict(zip(words[1::2], words[2::2], strict=False))
    assert given["--data"] == "/data/lego"
    assert given["--max-seconds"] == "120.0"
    assert given["--machine.num-threads"] == "2"
    assert float(given["--seconds-per-eval-all-images"]) == 15
    assert "--max-num-iterations" not in given
    folder = Path(given["--output-dir"]) / given["--experiment-name"] / "vanilla-nerf" / given["--timestamp"]
    assert folder == planned.folder
    train, judge = job_of(planned, CONDITIONS).steps
    assert list(train.command) == planned.train_command(CONDITIONS)
    assert train.started == planned.folder / "config.yml"
    assert train.resume[-2:] == ("--resume", str(planned.folder))
    assert list(judge.command) == planned.eval_command(CONDITIONS)
    assert job_of(planned, CONDITIONS).resources == Resources(cores=2, gpus=0)
    assert job_of(planned, replace(CONDITIONS, device_type="cuda", num_threads=None)).resources == Resources(None, 1)
    steps = replace(CONDITIONS, max_seconds=None, max_num_iterations=100)
    command = PlannedRun(Contender.of("kplanes"), 43, tmp_path / "runs").train_command(steps)
    assert command[command.index("--steps-per-eval-all-images") + 1] == "12"
    assert planned.eval_command(replace(CONDITIONS, max_eval_images=5))[-2:] == ["--max-images", "5"]


def test_runs_go_seed_by_seed(tmp_path: Path) -> None:
    plan = Plan((Contender.of("kplanes"), Contender.of("tensorf")), CONDITIONS, 2, tmp_path)
    assert [(planned.contender.label, planned.seed) for planned in plan.runs()] == [
        ("kplanes", 42),
        ("tensorf", 42),
        ("kplanes", 43),
        ("tensorf", 43),
    ]
    with pytest.raises(ConfigError, match="'kplanes' twice"):
        Plan((Contender.of("kplanes"), Contender.of("kplanes")), CONDITIONS, 1, tmp_path)
    with pytest.raises(ConfigError, match="--methods is empty"):
        Plan((), CONDITIONS, 1, tmp_path)
    with pytest.raises(ConfigError, match="--repeats is 0"):
        Plan((Contender.of("kplanes"),), CONDITIONS, 0, tmp_path)


def test_a_folder_belongs_to_its_conditions(tmp_path: Path) -> None:
    plan = Plan((Contender.of("kplanes"),), CONDITIONS, 1, tmp_path / "new")
    plan.claim_folder()
    plan.claim_folder()
    more = replace(plan, contenders=(Contender.of("tensorf"),), repeats=3)
    more.claim_folder()
    with pytest.raises(ConfigError, match=r"other conditions \(max_seconds 120.0, not 60.0\)"):
        replace(plan, conditions=replace(CONDITIONS, max_seconds=60.0)).claim_folder()
    assert json.loads((tmp_path / "new" / "conditions.json").read_text())["data_flags"] == ["--downscale-factor", "2"]
    (tmp_path / "new" / "conditions.json").write_text("{")
    with pytest.raises(ConfigError, match="cannot be read"):
        plan.claim_folder()
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="cannot write"):
        replace(plan, folder=tmp_path / "file" / "below").claim_folder()


def test_the_final_evaluation_is_over_a_view_a_second_unless_the_user_says_how_many(tmp_path: Path) -> None:
    assert [views_for(seconds) for seconds in (5.0, 30.0, 120.4, None)] == [25, 30, 120, None]
    flags = CompareFlags(methods=("kplanes",), max_seconds=40.0, output_dir=tmp_path)
    assert plan_of(flags).conditions.max_eval_images == 40
    assert plan_of(replace(flags, max_eval_images=200)).conditions.max_eval_images == 200
    assert plan_of(replace(flags, max_seconds=None, target_psnr=30.0)).conditions.max_eval_images is None


def test_without_curve_images_nothing_is_evaluated_during_training(tmp_path: Path) -> None:
    for conditions in (CONDITIONS, replace(CONDITIONS, max_seconds=None, max_num_iterations=100)):
        words = PlannedRun(Contender.of("kplanes"), 42, tmp_path).train_command(replace(conditions, curve_images=0))
        assert words[words.index("--max-eval-images") + 1] == "0"
        assert not [word for word in words if "per-eval-all-images" in word]
    with pytest.raises(ConfigError, match="--curve-images must be at least 0"):
        replace(CONDITIONS, curve_images=-1)


def test_only_the_pictures_that_a_report_shows_are_written(tmp_path: Path) -> None:
    command = PlannedRun(Contender.of("kplanes"), 42, tmp_path).eval_command(CONDITIONS)
    assert command[command.index("--max-pictures") + 1] == str(MAX_VIEWS)


def test_surfaces_are_judged_by_the_same_reference(tmp_path: Path) -> None:
    pytest.importorskip("trimesh")
    file = tmp_path / "true.ply"
    file.write_text("ply")
    flags = CompareFlags(methods=("instant-ngp",), max_seconds=60, f_score_at=(0.1, 0.2), reference_mesh=file, crop=0.1)
    plan = plan_of(flags)
    words = ["--reference-mesh", str(file), "--f-score-at", "0.1", "0.2", "--crop", "0.1"]
    assert list(plan.conditions.geometry) == words
    assert plan.runs()[0].eval_command(plan.conditions)[-len(words) :] == words
    assert plan_of(CompareFlags(methods=("instant-ngp",), max_seconds=60, crop=0.1)).conditions.geometry == ()
    with pytest.raises(ConfigError, match=r"gone.ply is not a file"):
        plan_of(CompareFlags(methods=("instant-ngp",), max_seconds=60, reference_points=tmp_path / "gone.ply"))
