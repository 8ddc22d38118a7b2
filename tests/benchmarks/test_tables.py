"""Tables of results: their rows, their runs, the kept results, and the figures that they show."""

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from importlib import import_module
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

import pytest

from benchmarks import timed
from benchmarks.__main__ import main
from benchmarks.made import PROGRAMS
from benchmarks.table_text import LOADING, estimate
from benchmarks.tables import Row, read_table
from nerfloom.base.errors import ConfigError
from nerfloom.benchmarks.results import add_row
from nerfloom.cli.train import run_of
from nerfloom.comparison.plan import PlannedRun
from nerfloom.jobs.job import Failure, Job
from nerfloom.jobs.launcher import Ledger, nothing
from nerfloom.jobs.processes import Processes
from nerfloom.registry import registered
from tests.cli.helpers import done_here
from tests.comparison.runs import at_once, finish
from tests.conftest import Refused
from tests.site.commands import Checker, found

TABLES = sorted((Path(__file__).parents[2] / "configs" / "tables").glob("*.yml"))
FORMATS = {
    "fern": "llff", "statue_of_liberty": "llff", "record3d_door": "record3d", "bouncingballs": "dnerf",
    "standup": "dnerf", "fox": "nerfstudio", "snowmiku": "nerfstudio",
    **dict.fromkeys(("lego", "lego800", "solids", "mirror", "metal", "varnish", "together"), "blender"),
}  # fmt: skip
"""Folders of the tables' data, and the formats that would be recognised."""
ROWS = """
images: {first: r_0.png}
rows:
  - data: {ball: shapes/ball --downscale-factor 2, embedded: ""}
    methods: {ngp: instant-ngp, planes: kplanes --num-scales 2}
    seconds: [10, 45]
    seeds: 2
"""


def write(folder: Path, text: str = ROWS) -> Path:
    path = folder / "table.yml"
    path.write_text(text)
    return path


SURFACES = """
rows:
  - data: {solids: shapes}
    methods: {ngp: instant-ngp, planes: kplanes}
    seconds: [10]
    geometry: {reference_mesh: shapes/true.ply, f_score_at: [0.5], crop: 0.1}
  - data: {ball: ball}
    methods: {ngp: instant-ngp}
    seconds: [10]
"""

MADE = """
rows:
  - data: {ball: ball}
    methods: {ngp: instant-ngp}
    seconds: [10]
    seeds: 2
  - data: {ball: ball}
    methods: {octree: ns-bake RUN --max-megabytes 5, pupil: kilo-nerf --teacher RUN}
    seconds: [20]
    seeds: 2
    after: ngp-10s
  - data: {street: --street 2}
    methods: {blocks: ns-blocks --max-cameras 9}
    seconds: [5]
"""


def psnr_of(planned: PlannedRun, seconds: float) -> float:
    """A PSNR that differs between rows."""
    return 20 + len(planned.contender.label) / 10 + seconds / 100 + (planned.seed - 42) / 4


@pytest.fixture
def ran(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, float, int]]:
    """Label, seconds and seed of each run; they end at once, with the PSNR of `psnr_of`; kplanes fails after 45 s."""
    asked: list[tuple[str, float, int]] = []

    def outcome(planned: PlannedRun, seconds: float) -> str | None:
        asked.append((planned.contender.label, seconds, planned.seed))
        if planned.contender.method == "kplanes" and seconds == 45:
            return "its planes have crashed"
        finish(planned, psnr_of(planned, seconds), seconds + 0.5)
        return None

    monkeypatch.setattr(Processes, "run", at_once(outcome))
    return asked


def bench(monkeypatch: pytest.MonkeyPatch, folder: Path, *flags: object) -> None:
    """Run python -m benchmarks tables with all of its folders in `folder`."""
    folders = ("--data-root", folder / "data", "--run-dir", folder / "runs", "--output-dir", folder / "results")
    words = ("benchmarks", "tables", "--tables", folder / "table.yml", *folders, *flags)
    monkeypatch.setattr(sys, "argv", list(map(str, words)))
    main()


def test_a_row_for_each_data_set_method_budget_and_seed(tmp_path: Path) -> None:
    table = read_table(write(tmp_path), tmp_path / "data", tmp_path / "runs", 0.1)
    names = [row.name for row in table.rows]
    assert len(names) == len(set(names)) == 16
    assert names[:5] == ["ball-ngp-1s", "ball-planes-1s", "ball-ngp-4.5s", "ball-planes-4.5s", "embedded-ngp-1s"]
    assert names[8] == "ball-ngp-1s-seed43"
    planes, embedded = table.rows[1], table.rows[4]
    words = planes.planned.train_command(planes.conditions)
    assert words[words.index("--data") + 1] == str(tmp_path / "data" / "shapes" / "ball")
    assert words[words.index("--max-seconds") + 1] == "1.0"
    assert words[words.index("--machine.seed") + 1] == "42"
    assert words[-4:] == ["--num-scales", "2", "--downscale-factor", "2"]
    assert planes.planned.eval_command(planes.conditions)[-2:] == ["--max-images", "3"]
    whole = read_table(tmp_path / "table.yml", tmp_path, tmp_path).rows[0]
    assert whole.name == "ball-ngp-10s"
    assert "--max-images" not in whole.planned.eval_command(whole.conditions)
    assert "--data" not in embedded.planned.train_command(embedded.conditions)
    assert len({row.planned.folder for row in table.rows}) == 16


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("rows: 3", "has a list of 'rows'"),
        ("rows: []\nextra: 1", "nothing else"),
        ("rows: [7]", "it must have data, methods"),
        ("rows: [{data: {a: b}, methods: {c: kplanes}}]", "has no rows"),
        ("rows: [{data: {a: b}, methods: [kplanes], seconds: [1]}]", "must have names with a text each"),
        ("rows: [{data: {a: b}, methods: {c: kplanez}, seconds: [1]}]", "Did you mean 'kplanes'"),
        ("rows: [{data: {../a: b}, methods: {c: kplanes}, seconds: [1]}]", "is not a name for a row"),
        ("rows: [{data: {a: b}, methods: {c: kplanes}, seconds: [1, 1]}]", "two rows are called a-c-1s"),
        ("rows: [{data: {a: b}, methods: {c: kplanes}, second: [1]}]", "unknown key"),
        (
            "rows: [{data: {a: b}, methods: {c: kplanes}, seconds: [1], geometry: {referenc_mesh: a.ply}}]",
            "geometry: unknown key 'referenc_mesh'. Did you mean 'reference_mesh'",
        ),
        ("rows: [{data: {a: b}, methods: {c: ns-bake RUN}, seconds: [1]}]", "'after' belong together"),
        ("rows: [{data: {a: b}, methods: {c: kplanes}, seconds: [1], after: d-1s}]", "'after' belong together"),
        (
            "rows: [{data: {a: b}, methods: {c: ns-bake RUN}, seconds: [1], after: d-1s}]",
            "no row above is 'd-1s' of a with seed 42",
        ),
        ("rows: [{data: {a: ''}, methods: {c: ns-blocks}, seconds: [1], seeds: 2}]", "ns-blocks has no seed"),
        (
            "rows: [{data: {a: b --x 1}, methods: {c: kplanes}, seconds: [1]}, "
            "{data: {a: b --x 1}, methods: {d: ns-bake RUN}, seconds: [1], after: c-1s}]",
            "needs the name of the data format before '--x 1'",
        ),
    ],
)
def test_what_is_no_table(text: str, reason: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=reason):
        read_table(write(tmp_path, text), tmp_path, tmp_path)


def some_of(rows: Sequence[Row]) -> Iterator[Row]:
    """Each wording of a method and each of data at least once, and every method with every format."""
    seen: set[tuple[str, ...]] = set()
    for row in rows:
        method, _, place = row.planned.contender.label.partition(" on ")
        folder, *words = place.split()
        named = [word for word in words if word in registered("dataparsers")]
        of_format = named[0] if named else FORMATS.get(folder, "nerfstudio")
        asked = {("method", method), ("data", place), ("both", method.split()[0], of_format)}
        if not asked <= seen:
            yield row
        seen |= asked


@pytest.mark.parametrize("which", ["some", pytest.param("all", marks=pytest.mark.slow)])
@pytest.mark.parametrize("path", TABLES, ids=lambda path: path.stem)
def test_every_row_of_our_tables_is_understood(path: Path, which: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """By the commands that are run, which are parsed as they will be; the data need not be there."""

    def here(data: Path | None, named: str | None = None) -> tuple[Path | None, str]:
        return (data, named or FORMATS[data.name]) if data else found(data, named)

    monkeypatch.setattr("nerfloom.training.data_folder.find_data", here)
    rows = [
        row for row in read_table(path, Path("data"), Path("runs")).rows if row.planned.contender.method not in PROGRAMS
    ]
    understood = list({row.planned.contender.label: row for row in rows}.values())
    for row in understood if which == "all" else some_of(understood):
        words = row.planned.train_command(row.conditions)
        method, *flags = words[words.index("nerfloom.cli.train") + 1 :]
        run = run_of(method, flags)
        assert run.config.max_seconds == row.seconds
        assert run.config.machine.seed == row.planned.seed
    assert rows


def test_what_other_commands_make_in_our_tables_is_understood(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    checker, checked = Checker(monkeypatch, tmp_path), set[str]()
    for path in TABLES:
        for row in read_table(path, tmp_path, tmp_path / "runs").rows:
            if (program := PROGRAMS.get(row.planned.contender.method)) is not None:
                words = row.planned.train_command(row.conditions)
                checker.check([row.planned.contender.method, *words[words.index(program.module) + 1 :]])
                words = row.planned.eval_command(row.conditions)
                checker.check(["ns-eval", *words[words.index("nerfloom.cli.evaluate") + 1 :]])
                checked.add(row.planned.contender.method)
    assert checked == set(PROGRAMS)


def test_rows_of_one_name_are_one_run() -> None:
    """A sentence and a cell name a row without its table, and the run of a row is shared by all tables."""
    labels: dict[str, str] = {}
    for path in TABLES:
        for row in read_table(path, Path("data"), Path("runs")).rows:
            assert labels.setdefault(row.name, row.planned.contender.label) == row.planned.contender.label, row.name


def rows_of(folder: Path) -> dict[str, Any]:
    """The kept rows of `write`'s table."""
    return json.loads((folder / "table.json").read_text())["rows"]


def test_rows_that_are_there_are_not_run_again(
    ran: list[tuple[str, float, int]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    write(tmp_path)
    bench(monkeypatch, tmp_path, "--only", "^ball-ngp")
    assert [seconds for _, seconds, _ in ran] == [10, 45, 10, 45]
    with pytest.raises(SystemExit):
        bench(monkeypatch, tmp_path, "--only", "ball")
    assert "ball-planes-45s: its planes have crashed" in capsys.readouterr().err
    assert len(ran) == 8
    content = rows_of(tmp_path / "results")["ball-planes-10s-seed43"]
    assert content["run"]["command"].startswith(
        "ns-train kplanes --num-scales 2 --downscale-factor 2 --machine.seed 43"
    )
    assert content["run"]["command"].endswith("--data shapes/ball --max-seconds 10.0")
    assert content["run"]["steps"] == 1000
    assert content["run"]["machine"]["processor"] == "abacus"
    assert content["experiment_name"] == "ball"
    assert str(tmp_path) not in json.dumps(content)
    bench(monkeypatch, tmp_path, "--show", "rows")
    listed = capsys.readouterr().out
    assert "10 of 16 rows are to be run" in listed
    assert len(ran) == 8
    write(tmp_path, ROWS.replace("--num-scales 2", "--num-scales 3"))
    with pytest.raises(SystemExit):
        bench(monkeypatch, tmp_path)
    assert "belongs to 'kplanes --num-scales 2 on" in capsys.readouterr().err


def test_a_finished_run_without_its_row_is_only_written(
    ran: list[tuple[str, float, int]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(tmp_path)
    bench(monkeypatch, tmp_path, "--only", "^embedded-ngp-10s$")
    file = tmp_path / "results" / "table.json"
    before = file.read_text()
    file.unlink()
    bench(monkeypatch, tmp_path, "--only", "^embedded-ngp-10s$")
    assert len(ran) == 1
    assert file.read_text() == before


def test_means_and_spreads_over_seeds(
    ran: list[tuple[str, float, int]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = write(tmp_path)
    bench(monkeypatch, tmp_path, "--only", "ngp")
    rows = rows_of(tmp_path / "results")
    for content in rows.values():
        content["per_image"] = [{"name": "r_0.png", "psnr": content["results"]["psnr"] - 1}]
        content["results"]["by_size"] = {"1/2": {"psnr": 30.0}, "1": {"psnr": 29.0}}
    (tmp_path / "results" / "table.json").write_text(json.dumps({"rows": rows}))
    bench(monkeypatch, tmp_path, "--show", "markdown", "--only", "^ball")
    head, _, *lines = capsys.readouterr().out.splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in (head, *lines)]
    titles = ["run", "test PSNR", "SSIM", "size 1", "size 1/2", "first", "steps"]
    assert cells[0] == [*titles, "training rays/s", "peak memory", "render", "images/s", "result"]
    assert [row[0] for row in cells[1:]] == [
        f"ball, {method}, {seconds} s" for seconds in (10, 45) for method in ("ngp", "planes")
    ]
    (row,) = [row for row in read_table(path, tmp_path, tmp_path).rows if row.name == "ball-ngp-45s"]
    psnrs = [psnr_of(PlannedRun(row.planned.contender, seed, tmp_path), 45.0) for seed in (42, 43)]
    spread = f"{stdev(psnrs):.2f} dB"
    assert cells[3][1] == f"{fmean(psnrs):.2f} ± {spread}"
    assert cells[3][2:6] == ["0.900", "29.00 ± 0.00 dB", "30.00 ± 0.00 dB", f"{fmean(psnrs) - 1:.2f} ± {spread}"]
    assert cells[3][6:] == ["1,000", "22,000", "1.0 GiB", "0.25 s/image", "4", "`ball-ngp-45s`"]
    assert cells[2][1:] == [""] * 11


def test_surfaces_are_judged_by_the_reference_of_their_block(tmp_path: Path) -> None:
    rows = read_table(write(tmp_path, SURFACES), tmp_path / "data", tmp_path / "runs").rows
    reference = str((tmp_path / "data" / "shapes" / "true.ply").resolve())
    words = ["--reference-mesh", reference, "--f-score-at", "0.5", "--crop", "0.1"]
    for row in rows[:2]:
        assert row.planned.eval_command(row.conditions)[-len(words) :] == words
    assert "--reference-mesh" not in rows[2].planned.eval_command(rows[2].conditions)


def test_a_reference_that_is_not_there_is_refused_before_a_run(
    ran: list[tuple[str, float, int]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    write(tmp_path, SURFACES)
    with pytest.raises(SystemExit):
        bench(monkeypatch, tmp_path)
    assert "true.ply is not a file" in capsys.readouterr().err
    assert ran == []
    bench(monkeypatch, tmp_path, "--only", "ball")
    assert len(ran) == 1


def test_figures_of_surfaces_are_kept_and_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("trimesh")
    reference = tmp_path / "data" / "shapes" / "true.ply"
    reference.parent.mkdir(parents=True)
    reference.touch()

    def outcome(planned: PlannedRun, seconds: float) -> None:
        finish(planned, 30.0, seconds)
        if "shapes" in planned.contender.label:
            evaluation = json.loads(planned.evaluation.read_text())
            normals = {"degrees": 6.0, "cosine": 0.99} if planned.contender.method == "kplanes" else None
            evaluation["geometry"] = {
                "reference": str(reference), "chamfer_percent": 0.25, "faces": 1234, "seconds": 70.0,
                "f_scores": [{"distance": 0.5, "f_score": 0.4}], "normals": normals,
            }  # fmt: skip
            planned.evaluation.write_text(json.dumps(evaluation))

    monkeypatch.setattr(Processes, "run", at_once(outcome))
    path = write(tmp_path, SURFACES)
    bench(monkeypatch, tmp_path)
    rows = rows_of(tmp_path / "results")
    assert rows["solids-ngp-10s"]["geometry"]["reference"] == "true.ply"
    assert str(tmp_path) not in json.dumps(rows)
    capsys.readouterr()
    bench(monkeypatch, tmp_path, "--show", "markdown")
    head, _, *lines = capsys.readouterr().out.splitlines()
    titles, *cells = ([cell.strip() for cell in line.strip("|").split("|")] for line in (head, *lines))
    first = titles.index("Chamfer")
    assert titles[first : first + 4] == ["Chamfer", "F-score", "normals", "faces"]
    assert [row[first : first + 4] for row in cells] == [
        ["0.250 %", "40.0 %", "", "1,234"], ["0.250 %", "40.0 %", "6.00°", "1,234"], ["", "", "", ""]
    ]  # fmt: skip
    known = {row.name: row for row in read_table(path, tmp_path, tmp_path).rows}
    done = [(known["solids-ngp-10s"], rows["solids-ngp-10s"])]
    assert estimate(known["solids-planes-10s"], done) == LOADING + 10 + 16 / 4 + 70  # images and surface


def test_a_row_is_a_line(tmp_path: Path) -> None:
    file = tmp_path / "results" / "table.json"
    rows: dict[str, Any] = {name: {"results": {"psnr": 30.0, "of each": [1.5, None]}} for name in ("planes", "ngp")}
    for name, row in rows.items():
        add_row(file, name, row)
    assert json.loads(file.read_text()) == {"rows": rows}
    first, ngp, planes, last = file.read_text().splitlines()
    assert (first, last) == ('{"rows": {', "}}")
    assert json.loads(f"{{{ngp.rstrip(',')}, {planes}}}") == rows
    with pytest.raises(ValueError, match="not JSON compliant"):
        add_row(file, "planes", {"results": {"psnr": float("nan")}})
    assert json.loads(file.read_text()) == {"rows": rows}


def test_what_is_no_file_of_results_is_kept(tmp_path: Path) -> None:
    file = tmp_path / "table.json"
    file.write_text('{"rows": [')
    with pytest.raises(ConfigError, match="is not a file of results"):
        add_row(file, "ball-ngp-10s", {"results": {"psnr": 30.0}})
    assert file.read_text() == '{"rows": ['


def test_a_row_is_expected_to_take_as_long_as_those_like_it(tmp_path: Path) -> None:
    rows = {row.name: row for row in read_table(write(tmp_path), tmp_path, tmp_path).rows}
    result: dict[str, Any] = {"results": {"num_images": 30, "fps": 0.5}}
    quick: dict[str, Any] = {"results": {"num_images": 30, "fps": 3.0}}
    done = [(rows["ball-ngp-10s"], result), (rows["ball-planes-10s"], quick)]
    assert estimate(rows["ball-ngp-45s"], done) == LOADING + 45 + 60
    assert estimate(rows["ball-planes-45s"], done) == LOADING + 45 + 10
    assert estimate(rows["ball-planes-45s"], done[:1]) == LOADING + 45 + 60


def test_bad_flags_are_refused_in_a_line(tmp_path: Path, refused: Refused) -> None:
    table = ("tables", "--tables", write(tmp_path), "--output-dir", tmp_path / "results")
    assert "no row has such a name" in refused(main, *table, "--only", "castle", status=2)
    assert "is not a regular expression" in refused(main, *table, "--only", "(", status=2)
    assert "it must be more than 0" in refused(main, *table, "--seconds-scale", 0, status=2)
    assert "cannot read" in refused(main, "tables", "--tables", tmp_path / "none.yml")


@pytest.mark.slow  # processes of their own
def test_a_table_that_is_stopped_goes_on(tmp_path: Path) -> None:
    small = "--num-levels 4 --max-resolution 64 --log2-table-size 12 --grid-resolution 16 --num-steps 64"
    method = f"instant-ngp {small} --samples-per-batch 4096"
    block = f"{{data: {{tiny: --size 24 --num-train 8}}, methods: {{ngp: {method}}}, seconds: [8]}}"
    folders = ("--run-dir", str(tmp_path / "runs"), "--output-dir", str(tmp_path))
    words = [
        sys.executable,
        "-m",
        "benchmarks",
        "tables",
        "--tables",
        str(write(tmp_path, f"rows: [{block}]")),
    ]
    first = subprocess.Popen([*words, *folders], stderr=subprocess.PIPE, text=True)
    while not list(tmp_path.rglob("config.yml")):
        assert first.poll() is None
        time.sleep(0.1)
    time.sleep(3)
    first.send_signal(signal.SIGTERM)
    assert "run the same command to continue" in first.communicate()[1]
    assert not (tmp_path / "table.json").exists()
    (log,) = tmp_path.rglob("seed-42.log")
    subprocess.run([*words, *folders], check=True)
    assert "resuming" in log.read_text()
    content = rows_of(tmp_path)["tiny-ngp-8s"]
    assert content["run"]["seconds"] == pytest.approx(8, abs=1)
    assert content["run"]["samples_per_ray"] > 1
    assert content["results"]["psnr"] > 12
    assert all(image["psnr"] > 10 for image in content["per_image"])
    shown = subprocess.run([*words, *folders, "--show", "markdown"], check=True, capture_output=True, text=True).stdout
    assert f"| tiny, ngp, 8 s | {content['results']['psnr']:.2f} dB | " in shown


def test_a_row_after_a_run_is_made_from_it(tmp_path: Path) -> None:
    rows = {row.name: row for row in read_table(write(tmp_path, MADE), tmp_path / "data", tmp_path / "runs", 0.1).rows}
    octree, pupil, run = rows["ball-octree-2s-seed43"], rows["ball-pupil-2s-seed43"], rows["ball-ngp-1s-seed43"]
    words = octree.planned.train_command(octree.conditions)
    made = words[words.index("nerfloom.cli.bake") + 1 :]
    assert made[:5] == [str(run.planned.folder), "--max-megabytes", "5", "--fine-tune-seconds", "2.0"]
    assert made[-2:] == ["--output-path", str(octree.planned.opened)]
    words = octree.planned.eval_command(octree.conditions)
    assert words[words.index("--load-config") + 1] == str(octree.planned.opened)
    assert words[-2:] == ["--data", str(tmp_path / "data" / "ball")]
    words = pupil.planned.train_command(pupil.conditions)
    assert words[words.index("--teacher") + 1] == str(run.planned.folder)
    blocks = rows["street-blocks-0.5s"]
    assert blocks.planned.user_command(blocks.conditions) == [
        "ns-blocks", "--max-cameras", "9", "--max-seconds", "0.5", "--data-flags=--street 2"
    ]  # fmt: skip
    assert "--data" not in blocks.planned.eval_command(blocks.conditions)


def jobs_here(outcome: Callable[[Job], str | None]) -> Callable[..., dict[Job, Failure]]:
    """A launcher's `run` with an outcome for each job: why it failed, or None."""

    def run(_: object, jobs: Sequence[Job], on_finished: Callable[[Job], None] = nothing) -> dict[Job, Failure]:
        ledger = Ledger(jobs, on_finished)
        for job in ledger.unfinished():
            ledger.ended(job, outcome(job))
        return ledger.failures

    return run


def test_rows_after_a_run_wait_for_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    known = {row.name: row for row in read_table(write(tmp_path, MADE), tmp_path / "data", tmp_path / "runs").rows}
    ran: list[str] = []
    broken = {"ball-ngp-10s-seed43"}

    def outcome(job: Job) -> str | None:
        ran.append(job.title)
        if job.title in broken:
            return "it has crashed"
        octree = {"wall_seconds": 47.2, "bytes": 25_460_000} if "octree" in job.title else {}
        finish(known[job.title].planned, 30.0 - len(job.title) / 10, **octree)
        return None

    monkeypatch.setattr(Processes, "run", jobs_here(outcome))
    bench(monkeypatch, tmp_path, "--only", "octree-20s$")
    assert ran == ["ball-ngp-10s", "ball-octree-20s"]
    with pytest.raises(SystemExit):
        bench(monkeypatch, tmp_path, "--only", "ball")
    assert "3 rows failed, first ball-ngp-10s-seed43: it has crashed" in capsys.readouterr().err
    assert ran[2:] == ["ball-ngp-10s-seed43", "ball-pupil-20s"]
    broken.clear()
    bench(monkeypatch, tmp_path)
    assert ran[4:] == ["ball-ngp-10s-seed43", "street-blocks-5s", "ball-octree-20s-seed43", "ball-pupil-20s-seed43"]
    rows = rows_of(tmp_path / "results")
    assert str(tmp_path) not in json.dumps(rows)
    assert rows["ball-octree-20s"]["run"]["command"] == "ns-bake RUN --max-megabytes 5 --fine-tune-seconds 20.0"
    assert "--teacher RUN " in rows["ball-pupil-20s"]["run"]["command"]
    assert rows["ball-octree-20s"]["run"]["after"] == {"row": "ball-ngp-10s", "psnr": 30.0 - 12 / 10, "fps": 4.0}
    capsys.readouterr()
    bench(monkeypatch, tmp_path, "--show", "markdown", "--only", "octree")
    head, _, line = capsys.readouterr().out.splitlines()
    shown = dict(zip(*([cell.strip() for cell in each.strip("|").split("|")] for each in (head, line)), strict=True))
    assert shown["against its run"] == "-0.30 ± 0.00 dB"
    assert (shown["made in"], shown["file"], shown["images/s"], shown["speed-up"]) == ("47 s", "25.5 MB", "4", "1.0 x")


SMALL = "--num-levels 4 --max-resolution 64 --log2-table-size 12 --grid-resolution 16 --num-steps 64"
NGP = f"instant-ngp {SMALL} --samples-per-batch 4096"
PUPIL = "--network-resolution 2 --grid-resolution 16 --num-steps 64 --samples-per-batch 1024 --distill-steps 3"


def by_their_commands(job: Job) -> str | None:
    """Run the commands of a job in this process, which saves the seconds that new ones take to begin."""
    for step in job.steps:
        words = list(step.command)
        if "-m" in words:
            name, *arguments = words[words.index("-m") + 1 :]
            done = done_here(import_module(name).main, [name, *arguments])
        else:
            arguments = words[words.index(str(Path(timed.__file__).resolve())) + 1 :]
            done = done_here(lambda given=arguments: timed.main(*given), words)
        if done.returncode:
            return done.stderr
    return None


@pytest.mark.medium
@pytest.mark.filterwarnings("ignore:.*found in sys.modules")  # timed.py runs a module that is imported here
def test_an_octree_and_a_pupil_of_a_run(shared_tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Processes, "run", jobs_here(by_their_commands))
    write(
        tmp_path,
        f"""
rows:
  - data: {{ball: ball}}
    methods: {{ngp: {NGP} --max-num-iterations 60}}
    seconds: [600]
  - data: {{ball: ball}}
    methods: {{octree: ns-bake RUN --resolution 16}}
    seconds: [0.1]
    after: ngp-600s
  - data: {{ball: ball}}
    methods: {{pupil: kilo-nerf --teacher RUN --max-num-iterations 3 {PUPIL}}}
    seconds: [600]
    after: ngp-600s
""",
    )
    bench(monkeypatch, tmp_path, "--data-root", shared_tiny.parent, "--only", "octree|pupil")
    rows = rows_of(tmp_path / "results")
    assert set(rows) == {"ball-ngp-600s", "ball-octree-0.1s", "ball-pupil-600s"}
    run, octree = rows["ball-ngp-600s"], rows["ball-octree-0.1s"]
    assert octree["method_name"] == "octree"
    assert octree["run"]["after"]["psnr"] == run["results"]["psnr"]
    assert len(octree["per_image"]) == len(run["per_image"]) == 3
    assert octree["run"]["wall_seconds"] > 0
    assert 500 < octree["run"]["bytes"] < 1e6
    assert rows["ball-pupil-600s"]["run"]["steps"] == 3
    for row in rows.values():
        assert row["results"]["psnr"] > 5
        assert row["run"]["machine"] == run["run"]["machine"]


@pytest.mark.slow  # two blocks, their visibility and their colours
@pytest.mark.filterwarnings("ignore:.*found in sys.modules")
def test_a_street_in_blocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Processes, "run", jobs_here(by_their_commands))
    write(
        tmp_path,
        f"""
rows:
  - data: {{street: --street 2 --size 24 --num-train 18}}
    methods:
      blocks: ns-blocks --method "{NGP} --max-num-iterations 12" --max-cameras 12 --min-cameras 3 --overlap 0.2
    seconds: [600]
""",
    )
    bench(monkeypatch, tmp_path)
    (row,) = rows_of(tmp_path / "results").values()
    assert row["run"]["command"].endswith("--max-seconds 600.0 '--data-flags=--street 2 --size 24 --num-train 18'")
    assert row["results"]["psnr"] > 5
    assert "bytes" not in row["run"]
