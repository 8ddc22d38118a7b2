"""docs/plug-and-play.md and the three pages after it are true: their code runs in its order, as they describe."""

import re

import pytest
import torch

from tests.plug_and_play.test_examples import ROOT, differences

NAMES = ("plug-and-play", "plug-and-play-loop", "plug-and-play-more", "plug-and-play-samplers")
PAGE = "".join((ROOT / "docs" / f"{name}.md").read_text() for name in NAMES)


def blocks(language: str) -> list[str]:
    """The code of the pages in a language, at its line in their joined text."""
    found = re.finditer(rf"^```{language}\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
    return ["\n" * PAGE[: match.start(1)].count("\n") + match[1] for match in found]


@pytest.mark.medium
def test_its_code_runs() -> None:
    torch.manual_seed(0)
    names: dict = {}
    for block in blocks("python"):
        exec(compile(block, "docs/plug-and-play.md", "exec"), names)
    losses = names["losses"]
    assert sum(losses[-20:]) < sum(losses[:20]) / 10
    assert names["error"] < 0.02
    assert 0.5 < names["skipped"] < 1
    assert names["surface"].shape == (1000, 3)
    assert names["features"].shape == (1000, 16)
    hit = (names["colors"] < 0.5).any(-1)
    assert ((names["ball"].accumulation > 0.5) == hit).float().mean() > 0.98
    assert 0.01 < names["picture"].accumulation.mean() < 0.5
    assert names["fine"].per_ray == 192
    assert all(p.grad is not None and p.grad.isfinite().all() for p in names["proposal"].layers.parameters())


def test_it_shows_the_lines_that_change() -> None:
    (shown,) = blocks("diff")
    assert shown.strip().splitlines() == differences()


@pytest.mark.parametrize("name", sorted(set(re.findall(r"nerfloom\.(\w+)\(", PAGE))))
def test_it_names_what_there_is(name: str) -> None:
    import nerfloom

    assert name in nerfloom.__all__
