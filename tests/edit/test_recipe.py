"""Recipes: written, read and taken again with the same result; wrong ones are refused in a line."""

from pathlib import Path

import pytest
import torch

from nerfloom import edit
from nerfloom.base.errors import ConfigError
from nerfloom.cameras.scale import Scale, write_scale
from nerfloom.data.offsets import write_offset
from nerfloom.edit.edited import Edited
from nerfloom.edit.recipe import RANGES, STEPS, step_of
from nerfloom.splats.files import write_gaussians
from nerfloom.splats.gaussians import Gaussians
from tests.edit.clouds import at, scattered

WHOLE = """
steps:
  - crop_box: {low: [-2, -2, -2.5], high: [2, 2, 2]}
  - crop_sphere: {center: [0, 0, 1e-2], radius: 3, keep: true}
  - drop_faint: {min_opacity: 0.05}
  - drop_isolated
  - drop_needles:
  - rotate: {axis: [0, 1, 1], degrees: 33.3}
  - move: {by: [0.1, 0.2, 0.3]}
  - set_up: {up: [0, -1, 0]}
  - scale: {factor: 0.25, unit: cm}
  - align_points:
      points: [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
      targets: [[1, 1, 1], [1, 2, 1], [0, 1, 1]]
      with_scale: false
  - reduce_to: {count: 100}
  - set_degree: {degree: 1}
"""


def same(first: Edited, second: Edited) -> bool:
    columns = second.gaussians.columns
    return all(torch.equal(values, columns[name]) for name, values in first.gaussians.columns.items())


def test_a_recipe_is_what_the_functions_do(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "whole.yml").write_text(WHOLE)
    given = scattered(300, terms=15)
    taken = edit.take_steps(given, edit.read_recipe(tmp_path / "whole.yml"))
    by_hand = edit.crop_box(given, (-2, -2, -2.5), (2, 2, 2))
    by_hand = edit.drop_faint(edit.crop_sphere(by_hand, (0, 0, 0.01), 3), 0.05)
    by_hand = edit.rotate(edit.drop_needles(edit.drop_isolated(by_hand)), (0, 1, 1), 33.3)
    by_hand = edit.scale(edit.set_up(edit.move(by_hand, (0.1, 0.2, 0.3)), (0, -1, 0)), 0.25, unit="cm")
    corners, targets = ((0, 0, 0), (1, 0, 0), (0, 1, 0)), ((1, 1, 1), (1, 2, 1), (0, 1, 1))
    by_hand = edit.align_points(by_hand, corners, targets, with_scale=False)
    by_hand = edit.set_degree(edit.reduce_to(by_hand, 100), 1)
    assert same(taken, by_hand)
    assert len(taken) == 100
    assert taken.gaussians.degree == 1
    assert taken.scale == Scale(0.25, "cm")
    said = " ".join(capsys.readouterr().err.split())
    removed = 300 - len(edit.crop_box(given, (-2, -2, -2.5), (2, 2, 2)))
    assert f"1 crop_box: removes {removed:,} of 300 Gaussians" in said


def test_a_recipe_is_read_as_it_was_written(tmp_path: Path) -> None:
    (tmp_path / "whole.yml").write_text(WHOLE)
    steps = edit.read_recipe(tmp_path / "whole.yml")
    others = [
        step_of("crop_polygon", {"image": "a.png", "corners": [[0, 0.1], [1e-7, 3], [2, 2]], "keep": False}, "here"),
        step_of("crop_mask", {"image": "a.png", "mask": "masks/a.png"}, "here"),
        step_of("crop_region", {"file": "region.yml"}, "here"),
        step_of("merge", {"files": ["a.ply", "b.spz"]}, "here"),
        step_of("align_floor", {"tolerance": None, "seed": 3}, "here"),
    ]
    edit.write_recipe(tmp_path / "again.yml", [*steps, *others])
    assert edit.read_recipe(tmp_path / "again.yml") == [*steps, *others]
    assert list(others[3].files()) == [Path("a.ply"), Path("b.spz")]
    assert list(others[1].files()) == [Path("masks/a.png")]
    assert list(steps[0].files()) == []


def test_every_step_is_a_function_of_the_module() -> None:
    assert all(getattr(edit, name) is step for name, step in STEPS.items())


def test_ranges_are_of_settings_that_exist() -> None:
    names = {name for step in STEPS.values() for name in step.__code__.co_varnames[: step.__code__.co_argcount]}
    assert RANGES.keys() <= names


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("- crop_box", "steps"),
        ("steps: 3", "steps"),
        ("steps: []\nname: x", "steps"),
        ("steps: [3]", "step 1"),
        ("steps: [{crop_box: {low: [0, 0, 0], high: [1, 1, 1]}, move: {by: [1, 1, 1]}}]", "step 1"),
        ("steps: [drop_isolated, {crop_bax: {}}]", "Did you mean 'crop_box'"),
        ("steps: [crop_box]", "needs low and high"),
        ("steps: [{crop_box: 3}]", "names and values"),
        ("steps: [{drop_faint: {min_opacty: 0.1}}]", "Did you mean 'min_opacity'"),
        ("steps: [{drop_faint: {min_opacity: 2}}]", "from 0 to 1"),
        ("steps: [{drop_faint: {min_opacity: much}}]", "'min_opacity' is 'much'"),
        ("steps: [{crop_box: {low: [0, 0], high: [1, 1, 1]}}]", "'low'"),
        ("steps: [{move: {by: [.inf, 0, 0]}}]", "finite"),
        ("steps: [{reduce_to: {count: 0}}]", "at least 1"),
        ("steps: [{reduce_to: {count: 1.5}}]", "'count' is 1.5"),
        ("steps: [{set_degree: {degree: 4}}]", "from 0 to 3"),
        ("steps: [{scale: {factor: -1}}]", "'factor' is -1"),
        ("steps: [{merge: {files: 3}}]", "'files'"),
        ("steps: [", "plain YAML"),
    ],
)
def test_wrong_recipes_are_refused_in_a_line(text: str, says: str, tmp_path: Path) -> None:
    (tmp_path / "wrong.yml").write_text(text)
    with pytest.raises(ConfigError) as error:
        edit.read_recipe(tmp_path / "wrong.yml")
    assert says in str(error.value) or (says == "steps" and "keys and values" in str(error.value))
    assert "wrong.yml" in str(error.value)
    assert "\n" not in str(error.value)


def test_a_step_that_leaves_nothing_is_refused() -> None:
    steps = [step_of("drop_isolated", None, "x"), step_of("crop_sphere", {"center": [99, 0, 0], "radius": 1}, "x")]
    with pytest.raises(ConfigError, match=r"step 2 \(crop_sphere\) leaves none"):
        edit.take_steps(scattered(50), steps)


def test_files_are_merged_where_they_are(tmp_path: Path) -> None:
    """One about a local origin, one with harmonics of a higher degree."""
    given, near, far = scattered(10, 1, 3), at(torch.randn(5, 3), terms=8), at(torch.randn(7, 3))
    write_gaussians(tmp_path / "near.ply", near.map(torch.Tensor.float))
    write_gaussians(tmp_path / "far.ply", far.map(torch.Tensor.float))
    origin = torch.tensor([5e6, 0.5, -3e5], dtype=torch.float64)
    write_offset(tmp_path / "far.ply", origin)
    merged = edit.merge(given, (tmp_path / "near.ply", tmp_path / "far.ply")).gaussians
    truth = torch.cat([given.gaussians.means, near.means.float().double(), far.means.float().double() + origin])
    assert torch.equal(merged.means, truth)
    assert merged.degree == 2
    assert torch.equal(merged.harmonics[:10, :, :3], given.gaussians.harmonics)
    assert merged.harmonics[:10, :, 3:].count_nonzero() == 0
    assert torch.equal(merged.harmonics[10:15], near.harmonics)
    assert torch.equal(merged.colors, torch.cat([given.gaussians.colors, near.colors, far.colors]))


def test_files_in_another_unit_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_gaussians(tmp_path / "a.ply", at(torch.randn(5, 3)).map(torch.Tensor.float))
    write_scale(tmp_path / "a.ply", Scale(2.0, "cm"))
    metres = Edited(at(torch.randn(5, 3)), scale=Scale(1.0, "m"))
    with pytest.raises(ConfigError, match="in cm"):
        edit.merge(metres, (tmp_path / "a.ply",))
    assert len(edit.merge(Edited(metres.gaussians), (tmp_path / "a.ply",))) == 10
    said = " ".join(capsys.readouterr().err.split())
    assert "is in cm, and the unit of the others is not known" in said
    write_scale(tmp_path / "a.ply", Scale())
    assert len(edit.merge(metres, (tmp_path / "a.ply",))) == 10
    assert "is not known: lengths are taken as they are" in " ".join(capsys.readouterr().err.split())


def test_reduction_by_opacity_and_area() -> None:
    """Against numpy: opacity times the two largest standard deviations."""
    given = scattered(100)
    random = torch.Generator().manual_seed(0)
    gaussians = Gaussians.of(
        {
            **given.gaussians.columns,
            "log_scales": torch.randn(100, 3, generator=random),
            "logits": torch.randn(100, generator=random),
        }
    )
    sizes = gaussians.log_scales.exp().sort(-1).values
    values = gaussians.logits.sigmoid() * sizes[:, 2] * sizes[:, 1]
    best = values.argsort(descending=True)[:30].sort().values
    assert torch.equal(edit.reduce_to(Edited(gaussians), 30).gaussians.means, gaussians.means[best])
    assert len(edit.reduce_to(Edited(gaussians), 1000)) == 100
