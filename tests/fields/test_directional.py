"""Colours by reflected directions as a part of other methods' fields: `--directional reflected`."""

import dataclasses

import pytest
import torch
from torch.nn.functional import normalize

from nerfloom.base.errors import ConfigError
from nerfloom.fields.encoded import EncodedField
from nerfloom.fields.surface import SurfaceField
from nerfloom.geometry.points import Points
from nerfloom.registry import load_method
from nerfloom.testing import assert_method
from nerfloom.testing.scenes import ball_in_a_box
from nerfloom.training.trainer import Trainer
from tests.training.helpers import TINY

DENSITIES, DISTANCES = ("instant-ngp", "nerfacto", "zip-nerf"), ("neus", "neus+frequency", "volsdf")


def trainer_of(kind: str, **settings: object) -> Trainer:
    """A trainer on images of a ball, without a folder, of colours by reflected directions."""
    method = load_method(kind.split("+")[0])
    known = {**TINY[kind], "vis": "none", "directional": "reflected", **settings}
    return Trainer(method, dataclasses.replace(method.config, **known), ball_in_a_box())


@pytest.mark.parametrize("kind", [*DENSITIES, *DISTANCES])
def test_steps_and_pictures(kind: str) -> None:
    """A density has penalties on its predicted normals, and a distance none; all of them show the parts of colours."""
    trainer = trainer_of(kind)
    weights = [parameter.clone() for parameter in trainer.model.field.reflection.parameters()]
    for _ in range(3):
        report = trainer.train_step()
    assert trainer.state.skipped == 0
    assert ({"normals", "orientation"} <= report.losses.keys()) == (kind in DENSITIES)
    assert all(not torch.equal(a, b) for a, b in zip(weights, trainer.model.field.reflection.parameters(), strict=True))
    picture = trainer.model.render_view(trainer.train_set.view(0, 2), torch.ones(3))
    assert set(picture.extras) == {"diffuse", "specular", "normals", "roughness"}
    assert all(bool(values.isfinite().all()) for values in picture.extras.values())
    seen = picture.accumulation > 0.9
    if kind in DISTANCES:  # the normals of a ball, from the start
        assert bool((picture.extras["normals"][seen].norm(dim=-1) > 0.99).all())


@pytest.mark.parametrize("kind", ["neus", "neus+frequency"])
def test_normals_of_a_distance_are_its_gradients(kind: str) -> None:
    """The light comes from the part, with the gradient's direction as the normal."""
    field = trainer_of(kind).model.field
    assert isinstance(field, SurfaceField)
    assert field.reflection is not None
    torch.manual_seed(0)
    where, directions = torch.rand(50, 3) * 1.6 - 0.8, normalize(torch.randn(50, 3), dim=-1)
    features = field.density(Points(where))[1].detach()
    shape = field.shape(where)
    found = field.light(features, directions)
    normals = normalize(shape.gradients, dim=-1)
    expected = field.reflection(shape.features, normals, directions)
    for value, truth in zip(found, expected, strict=True):
        torch.testing.assert_close(value, truth, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(field.color(features, directions), found.rgb)


@pytest.mark.parametrize("kind", ["instant-ngp", "neus"])
def test_colours_by_the_viewing_direction_have_no_such_part(kind: str) -> None:
    trainer = trainer_of(kind, directional="view")
    assert trainer.model.field.reflection is None
    assert "roughness" not in {output.name for output in trainer.model.outputs}
    assert "normals" not in trainer.train_step().losses


def test_an_appearance_changes_reflected_light() -> None:
    trainer = trainer_of("nerfacto", appearance="vector", appearance_embedding_dim=4)
    field = trainer.model.field
    assert isinstance(field, EncodedField)
    assert field.appearance is not None
    torch.manual_seed(0)
    torch.nn.init.normal_(field.eval().appearance.vectors)
    directions, images = normalize(torch.randn(20, 3), dim=-1), torch.arange(20) % 2
    features = field.density(Points(torch.rand(20, 3) - 0.5))[1]
    one, other = (field.light(features, directions, each) for each in (images, 1 - images))
    assert torch.equal(one.diffuse, other.diffuse)
    assert float((one.specular - other.specular).abs().max()) > 1e-4


@pytest.mark.parametrize(
    ("kind", "settings", "says"),
    [
        ("instant-ngp", {"view_dependence": False}, "leave out --view-dependence False"),
        ("nerfacto", {"predict_normals": True}, "leave out --predict-normals"),
    ],
)
def test_what_contradicts_it_is_refused(kind: str, settings: dict[str, object], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        trainer_of(kind, **settings)


@pytest.mark.medium
@pytest.mark.parametrize(
    "kind", [*(pytest.param(kind, marks=pytest.mark.slow) for kind in ("nerfacto", "zip-nerf")), "instant-ngp", "neus"]
)
def test_methods_pass_every_check(kind: str) -> None:
    method = load_method(kind)
    assert_method(method, kind, dataclasses.replace(method.config, **TINY[kind], directional="reflected"))
