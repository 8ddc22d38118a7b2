"""Figures in the documents are those of the evaluations that they name, and tables of names those of the code."""

import json
import math
import re
from pathlib import Path
from statistics import fmean, stdev

from nerfloom.base import from_nerfstudio
from nerfloom.base.other_projects import ELSEWHERE
from nerfloom.registry import registered
from tests.site.pages import ROOT

DOCS = ROOT / "docs"
COUNTED = "ignored pixels were copied from the true image and counted as perfect in ssim and ms_ssim"
"""What older files of masked captures say, whose SSIM is not shown."""
PSNR = re.compile(r"(\d+\.\d+)(?: ± \d+\.\d+)? dB")


def rows(page: Path) -> list[list[str]]:
    lines = page.read_text(encoding="utf-8").splitlines()
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("|")]


def results(name: str) -> dict[str, float]:
    content = json.loads((DOCS / "results" / name).read_text())
    return content["results"] | ({"ssim": math.nan} if content.get("masks") == COUNTED else {})


def runs(cell: str) -> list[dict[str, float]]:
    """The results in the files that a cell names; a star stands for any letters, as in `lego-x-45s-seed*.json`."""
    patterns = re.findall(r"`([\w.*-]+\.json)`", cell)
    names = [sorted(file.name for file in (DOCS / "results").glob(pattern)) for pattern in patterns]
    assert names
    assert all(names), f"no file is called {cell}"
    return [results(name) for group in names for name in group]


def ssim_of(found: list[dict[str, float]]) -> str:
    mean = fmean(run["ssim"] for run in found)
    return "" if math.isnan(mean) else f"{mean:.3f}"


def psnr_of(found: list[dict[str, float]]) -> str:
    """The mean, and of several seeds the standard deviation of a run."""
    values = [run["psnr"] for run in found]
    return f"{fmean(values):.2f}" + (f" ± {stdev(values):.2f}" if len(values) > 1 else "") + " dB"


def test_figures_are_those_of_their_files() -> None:
    pages = [DOCS / "figures.md", DOCS / "published.md"]
    measured = [row for page in pages for row in rows(page) if row[-1].endswith(".json`")]
    assert len(measured) >= 29
    for row in measured:
        found = runs(row[-1])
        assert row[1:3] == [psnr_of(found), ssim_of(found)], row


CAPTURED_BY = ("nerfacto-without-points", "nerfacto", "nerfacto-free-space", "zip-nerf", "mip-nerf-360")
"""Names in the files of the columns of both tables of captures, after the first column."""
WITH_POINTS = ("can", "cup", "desk")
"""Captures of which points are known, so that `nerfacto` learns from them."""


def test_the_tables_of_captures_are_those_of_their_files() -> None:
    """The first has PSNR and SSIM, the second steps, seconds an image and, where points are known, floaters."""
    tables = [row for row in rows(DOCS / "figures.md") if len(row) == 6 and re.match(r"`\w+`", row[0])]
    checked = 0
    for number, (first, *cells) in enumerate(tables):
        capture = first.split("`")[1]
        for name, cell in zip(CAPTURED_BY, cells, strict=True):
            file = DOCS / "results" / f"{capture}-{name}-600s.json"
            if (capture, name) == ("fox", "nerfacto-without-points") and not file.exists():
                file = DOCS / "results" / "fox-nerfacto-600s.json"
            expected = file.exists() and (name != "nerfacto" or capture in WITH_POINTS)
            assert bool(cell) == expected, (first, name)
            if not cell:
                continue
            content = json.loads(file.read_text())
            found = results(file.name)
            floaters = found.get("floaters")
            quality = ", ".join(filter(None, (psnr_of([found]), ssim_of([found]))))
            share = "" if floaters is None else f", {floaters:.2f} %"
            work = f"{content['run']['steps']:,}, {1 / found['fps']:.1f} s{share}"
            assert cell.replace("*", "") == (quality if number < len(tables) // 2 else work), (first, name)
            checked += 1
    assert checked >= 40


def test_several_seeds_are_a_mean_with_its_spread() -> None:
    assert psnr_of([{"psnr": 31.0}, {"psnr": 32.0}, {"psnr": 33.0}]) == "32.00 ± 1.00 dB"
    assert psnr_of([{"psnr": 31.0}]) == "31.00 dB"


def test_what_stands_beside_published_results_is_in_the_figures() -> None:
    """In the table of Lego the fourth column is ours; its PSNRs stand in the table of figures."""
    ours = PSNR.findall(" ".join(row[3] for row in rows(DOCS / "published.md") if len(row) == 5))
    known = (DOCS / "figures.md").read_text()
    assert len(ours) >= 5
    assert [number for number in ours if number not in PSNR.findall(known)] == []


def test_the_table_of_budgets_is_that_of_its_files() -> None:
    head, *body = [row for row in rows(DOCS / "guides" / "choosing.md") if len(row) == 9]
    seconds = [int(cell.removesuffix(" s")) for cell in head[1:]]
    compared = {row["label"]: row for row in json.loads((DOCS / "results" / "methods-lego.json").read_text())["runs"]}
    checked = 0
    for row in body[1:]:
        label = row[0].strip("`")
        for budget, cell in zip(seconds, row[1:], strict=True):
            if not cell:
                continue
            name = f"lego-{label.split()[0]}-{budget}s"
            seeds = sorted((DOCS / "results").glob(f"{name}-seed*.json")) or [DOCS / "results" / f"{name}.json"]
            found = [results(file.name) for file in seeds if file.exists()] or [compared[label]]
            assert cell == psnr_of(found).removesuffix(" dB"), (label, budget)
            checked += 1
    assert checked >= 15


def test_captures_to_choose_by_are_those_of_the_figures() -> None:
    table = [row for row in rows(DOCS / "guides" / "choosing.md") if len(row) == 5]
    numbers = [number for row in table for cell in row[1:] for number in re.findall(r"\d\d\.\d\d", cell)]
    known = PSNR.findall((DOCS / "figures.md").read_text())
    assert len(numbers) >= 18
    assert [number for number in numbers if number not in known] == []


def test_sentences_repeat_the_table() -> None:
    """PSNRs that other pages quote stand in the figures, notes, benchmarks, or beside pictures, perhaps rounded."""
    sources = [DOCS / f"{name}.md" for name in ("figures", "benchmarks", "stability", "plug-and-play")]
    sources += [*(DOCS / "notes").glob("*.md"), *(ROOT / "methods").glob("*.py")]
    numbers = set(re.findall(r"\d+\.\d+", "\n".join(source.read_text() for source in sources)))
    failures = json.loads((DOCS / "pictures" / "failures" / "psnr.json").read_text())["psnr"]
    numbers |= {f"{psnr:.2f}" for row in failures.values() for psnr in row.values()}
    numbers |= {f"{float(number):.1f}" for number in numbers}
    pages = [page for part in ("methods", "guides", "start") for page in (DOCS / part).glob("*.md")]
    pages.append(ROOT / "README.md")
    for page in pages:
        text = re.sub(r"```text.*?```", "", page.read_text(), flags=re.DOTALL)
        assert [number for number in PSNR.findall(text) if number not in numbers] == [], page.name


def test_versions_are_those_that_ran() -> None:
    ran = json.loads((DOCS / "results" / "versions.json").read_text())["rows"]
    table = [row for row in rows(DOCS / "start" / "install.md") if len(row) == 4]
    assert table[2:] == [[row["python"], row["torch"], row["state"], row["what"]] for row in ran]


def test_flags_of_nerfstudio_are_those_that_are_answered() -> None:
    table = {row[0].strip("`"): row[1].strip("`") for row in rows(DOCS / "from-nerfstudio.md") if len(row) == 2}
    assert from_nerfstudio.SETTINGS.items() <= table.items()
    text = (DOCS / "from-nerfstudio.md").read_text()
    assert [name for name in from_nerfstudio.NO_FORMATS if f"`{name}`" not in text] == []


def test_methods_of_nerfstudio_are_those_that_are_answered() -> None:
    """A method in the left column has the name of one here, or is answered when somebody asks for it."""
    table = [row for row in rows(DOCS / "from-nerfstudio.md") if len(row) == 2 and "--" not in row[1]]
    named = {name for row in table for name in re.findall(r"`([\w-]+)`", row[0])}
    assert len(named) > 20
    assert sorted(named - set(ELSEWHERE) - set(registered("methods"))) == []


def test_every_data_format_is_named() -> None:
    text = (DOCS / "guides" / "poses.md").read_text()
    entries = registered("dataparsers").items()
    built_in = [name for name, entry in entries if entry.module.startswith("nerfloom.dataparsers.")]
    assert [name for name in built_in if f"`{name}`" not in text] == []
