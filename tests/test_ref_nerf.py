"""Ref-NeRF: light by hand, normals of densities by differences, results of training, and its pictures."""

import dataclasses
import math
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn
from torch.nn.functional import normalize

from nerfloom.data.dataset import load_dataset
from nerfloom.data.sources import Request
from nerfloom.dataparsers.blender import Blender
from nerfloom.dataparsers.procedural.shiny import write_shiny
from nerfloom.evaluation.evaluator import evaluate
from nerfloom.fields.base import Field
from nerfloom.fields.directional import NUM_PROPERTIES, HasDensityNormals, HasLight, Reflection
from nerfloom.fields.encoded import EncodedField
from nerfloom.fields.reflective import ReflectiveNetworks
from nerfloom.geometry.points import Points
from nerfloom.kernels.encodings.integrated_directional import directional_encoding
from nerfloom.losses.normals import drawn, penalties
from nerfloom.method import Method
from nerfloom.registry import load_method
from nerfloom.testing.scenes import ball_in_a_box, ball_under_a_sky
from nerfloom.training.trainer import Trainer
from tests.training.helpers import TINY

KINDS = "ref-nerf", "ref-nerf+frequency"


def trainer_of(kind: str, dataset: object = None, **settings: object) -> Trainer:
    """A trainer on images of a ball, without a folder."""
    method: Method = load_method(kind.split("+")[0])
    known = {**TINY[kind], "vis": "none", **settings}
    return Trainer(method, dataclasses.replace(method.config, **known), dataset or ball_in_a_box())


def field_of(kind: str, dataset: object = None, **settings: object) -> Field:
    field = trainer_of(kind, dataset, **settings).model.field
    assert isinstance(field, HasLight)
    assert isinstance(field, HasDensityNormals)
    return field


def places(count: int = 40) -> Tensor:
    torch.manual_seed(0)
    return torch.rand(count, 3) * 1.6 - 0.8


class Probe(nn.Module):
    """Keeps the inputs of the directional network."""

    def forward(self, *parts: Tensor) -> Tensor:
        self.given = parts
        return torch.full((len(parts[0]), 3), 0.5)


def test_light_by_hand() -> None:
    """Reflected direction, cosine, attenuation by roughness, tint and diffuse light, as the paper's equations."""
    probe = Probe()
    features = torch.zeros(1, 4 + NUM_PROPERTIES + 2)
    features[0, 1:4] = torch.tensor([0.0, 0, 2])  # a normal along z, not of length 1
    features[0, 10], features[0, 11:] = 0.3, torch.tensor([7.0, 8.0])
    direction = normalize(torch.tensor([[1.0, 0, -1]]), dim=-1)
    part = Reflection(probe, 2, 5)
    assert part.num_features == features.shape[1]
    light = part.of_density(features, direction)
    roughness = torch.log1p(torch.exp(torch.tensor([0.3 - 1])))
    encoded, cosine, constant, bottleneck = probe.given
    assert sum(each.shape[1] for each in probe.given) == Reflection.num_inputs(2, 5)
    assert constant.tolist() == [[1.0]]
    torch.testing.assert_close(encoded, directional_encoding(normalize(torch.tensor([[1.0, 0, 1]]), dim=-1), roughness))
    torch.testing.assert_close(cosine, torch.tensor([[2**-0.5]]))
    assert bottleneck.tolist() == [[7.0, 8.0]]
    dim = 1 / (1 + math.exp(3))  # the bias of diffuse colours
    torch.testing.assert_close(light.diffuse, torch.full((1, 3), dim))
    torch.testing.assert_close(light.specular, torch.full((1, 3), 0.25))  # tint and light of a half each
    torch.testing.assert_close(light.rgb, torch.full((1, 3), 1.055 * (0.25 + dim) ** (1 / 2.4) - 0.055))
    torch.testing.assert_close(light.roughness, roughness)


def test_a_normal_of_length_0_reflects_nothing() -> None:
    probe, direction = Probe(), torch.tensor([[0.0, 0, 1]])
    features = torch.zeros(1, 4 + NUM_PROPERTIES, requires_grad=True)
    light = Reflection(probe, 0, 2).of_density(features, direction)
    torch.testing.assert_close(probe.given[0], directional_encoding(direction, light.roughness, 2))
    (light.rgb.sum() + probe.given[0].sum()).backward()
    assert features.grad is not None
    assert bool(features.grad.isfinite().all())


@pytest.mark.parametrize("unbounded", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_normals_point_down_the_density(kind: str, unbounded: bool) -> None:
    """Against central differences in float64, in contracted space too."""
    scene = ball_under_a_sky() if unbounded else None
    more = {
        "sparse_updates": False,
        "open_levels_until": 0.0,
        "base_resolution": 4,
        "max_resolution": 16,
        "sampler": "proposal" if unbounded else "auto",
    }
    field = field_of(kind, scene, **more).double().train()
    if isinstance(field, EncodedField):
        nn.init.normal_(field.encoding.table)
    assert isinstance(field, HasDensityNormals)
    where, step = (3.0 if unbounded else 1.0) * places().double(), 1e-6
    columns = []
    for axis in torch.eye(3, dtype=torch.float64):
        ahead, behind = (field.density(Points(where + sign * step * axis))[0].log() for sign in (1, -1))
        columns.append(ahead - behind)
    down = -normalize(torch.stack(columns, -1), dim=-1)
    found = field.density_normals(Points(where))
    assert bool((found.norm(dim=-1) < 1 + 1e-9).all())
    agreement = (down * normalize(found, dim=-1)).sum(-1)
    print(f"{kind}, {unbounded=}: median {agreement.median():.6f}")
    assert agreement.median() > 0.99  # a few places are beside a cell's face or a unit's switch
    assert agreement.quantile(0.2) > 0.9
    assert found.requires_grad


@pytest.mark.parametrize("kind", KINDS)
def test_penalties_of_normals_train_the_density(kind: str) -> None:
    """Without any other term, the spatial network and the encoding get a gradient, as in the paper."""
    trainer = trainer_of(kind, sparse_updates=False)
    model, batch = trainer.model, trainer.source.draw(Request(0, 64))
    model.train()
    model.before_step(0, 0.0)
    field = model.field
    if isinstance(field, EncodedField):
        nn.init.normal_(field.encoding.table)
    rendered = model.render(batch.rays, batch.background.repeat_interleave(batch.rays_per_pixel, 0))
    penalties(rendered, batch.rays, field)["normals"].backward()
    assert isinstance(field, (EncodedField, ReflectiveNetworks))
    first = field.encoding.table if isinstance(field, EncodedField) else field.network.before[0].weight
    assert first.grad is not None
    assert float(first.grad.abs().sum()) > 0


def test_sums_over_drawn_samples_are_those_over_all() -> None:
    """They agree on average; no sample without weight is drawn, and one that outweighs all others is always drawn."""
    torch.manual_seed(0)
    weights = torch.rand(1000) ** 8
    weights[:100], weights[-1] = 0, 30.0
    values = torch.randn(1000)
    truth, found, counts = float((weights * values).sum()), [], []
    for _ in range(400):
        places, factors = drawn(weights, 1 / 16)
        found.append(float((weights[places] * factors * values[places]).sum()))
        counts.append(len(places))
        assert int(places.min()) >= 100
        assert int(places.max()) == 999
    spread = torch.tensor(found).std() / len(found) ** 0.5
    assert abs(sum(found) / len(found) - truth) < 4 * float(spread)
    assert sum(counts) / len(counts) < 1000 / 16
    assert [len(each) for each in drawn(torch.zeros(5), 0.5)] == [0, 0]


@pytest.fixture(scope="module")
def mirror(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Images of a mirror, and its normals."""
    folder = tmp_path_factory.mktemp("shiny") / "shiny"
    write_shiny(folder, size=24, num_train=8, num_test=2)
    return folder / "mirror"


@pytest.mark.medium
@pytest.mark.parametrize(
    ("kind", "steps", "own"),
    [
        ("ref-nerf", 240, {"max_resolution": 16}),  # cells that steps this few can fill
        ("ref-nerf+frequency", 120, {}),
        ("neus", 120, {"directional": "reflected", "start_radius": 0.6}),
    ],
)
def test_training_on_a_mirror(kind: str, steps: int, own: dict[str, object], mirror: Path, tmp_path: Path) -> None:
    """The loss falls, pictures have all outputs, and normals are judged against the true ones.

    Without the penalty on normals that face away, a grid's normals would be off by 92 degrees.
    """
    train, test = (load_dataset(Blender().parse(mirror, s), s) for s in ("train", "test"))
    trainer = trainer_of(kind, train, max_num_iterations=steps, **own)
    before = evaluate(trainer.model, test).results
    for _ in range(steps):
        trainer.train_step()
    found = evaluate(trainer.model, test, pictures=tmp_path / "pictures")
    print(kind, before["psnr"], found.results["psnr"], before["normal_mae"], found.results["normal_mae"])
    assert found.results["psnr"] > before["psnr"] + 1
    assert 0 < found.results["normal_mae"] < 80
    assert "normals off by" in found.line()
    assert found.results["diffuse_psnr_images"] == len(test)
    assert "diffuse PSNR" in found.line()
    names = {path.name.split("_", 3)[-1] for path in (tmp_path / "pictures").iterdir()}
    assert {"diffuse.png", "specular.png", "normals.png", "roughness.png"} <= names
