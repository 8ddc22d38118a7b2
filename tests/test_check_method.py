"""Every built-in method passes `check_method`, and each kind of fault is found by its own check and no other."""

import dataclasses
import importlib
import random
import re
import sys
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar, Literal

import pytest
import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from nerfloom import (
    ConfigError,
    Field,
    LearnsMotion,
    Loss,
    Method,
    Model,
    Optimised,
    Picture,
    PixelBatch,
    Points,
    RayConfig,
    RayModel,
    Rays,
    Rendered,
    Renderer,
    Sampler,
    Samples,
    Scene,
    TrainConfig,
    View,
    VolumeRenderer,
)
from nerfloom.base.optimised import ParameterGroup
from nerfloom.kernels.encodings.frequency import frequency_encoding
from nerfloom.losses.term import LossTerm, RenderedBatch
from nerfloom.registry import load_method, registered
from nerfloom.samplers.occupancy import OccupancySampler
from nerfloom.testing import assert_method, check_method
from nerfloom.testing.check import CHECKS, Check
from tests.interfaces.methods.discs import DiscConfig, Discs
from tests.training.helpers import TINY

ROOT = Path(__file__).parents[1]
BUILT_IN = [name for name, entry in registered("methods").items() if entry.module.startswith("nerfloom.methods.")]
SLOW = ("dnerf", "pixel-nerf")
"""tests/test_moving.py and tests/test_pixel_nerf.py ask most of it in less time."""


@pytest.mark.medium
@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n in SLOW else n for n in BUILT_IN])
def test_every_built_in_method_passes(name: str) -> None:
    method = load_method(name)
    assert_method(method, name, dataclasses.replace(method.config, **TINY.get(name, {})))


@pytest.mark.slow
def test_the_method_in_the_guide_passes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    guide = (ROOT / "docs" / "guides" / "add-a-method.md").read_text(encoding="utf-8")
    source = re.findall(r"```python\n(.*?)```", guide, re.DOTALL)[0]
    (tmp_path / "method_in_the_guide.py").write_text(source, encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    assert_method(importlib.import_module("method_in_the_guide").METHOD, "plain-grid")


# -- a small method of each kind --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class TinyConfig(RayConfig, num_rays_per_batch=128, learning_rate=1e-2):
    pass


class TinyField(Field):
    """Density and colour of a position, by two layers."""

    def __init__(self) -> None:
        super().__init__()
        self.net = nn.Sequential(nn.Linear(21, 64), nn.ReLU(), nn.Linear(64, 4))

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        values = self.net(frequency_encoding(points.positions, 3)).float()
        return softplus(values[:, 0]), values[:, 1:]

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        return torch.sigmoid(features)


class TinySampler(OccupancySampler):
    def __init__(self, box: Tensor) -> None:
        super().__init__(box, resolution=16, num_steps=48)


def of_parts(config: Any, *kinds: type) -> Method:
    """A method that casts rays, with one or more parts of the given kinds."""
    chosen = {
        part: next((kind for kind in kinds if issubclass(kind, part)), default)
        for part, default in ((Field, TinyField), (Sampler, TinySampler), (Renderer, VolumeRenderer))
    }
    return Method(
        config,
        paper="none",
        field=lambda config, scene: chosen[Field](),
        sampler=lambda config, scene: chosen[Sampler](scene.box),
        renderer=lambda config, scene: chosen[Renderer](),
        model=next((kind for kind in kinds if not issubclass(kind, tuple(chosen))), RayModel),
    )


class LightField(Model[TinyConfig]):
    """Colour and opacity of rays by two layers: learns from pixels, and is no RayModel."""

    batches: ClassVar[Literal["pixels", "views"]] = "pixels"

    def __init__(self, config: TinyConfig, scene: Scene) -> None:
        super().__init__(config, scene)
        self.net = nn.Sequential(nn.Linear(6, 64), nn.ReLU(), nn.Linear(64, 4))

    def shown(self, rays: Rays, background: Tensor) -> tuple[Tensor, Tensor]:
        nearest = rays.origins - (rays.origins * rays.directions).sum(-1, keepdim=True) * rays.directions
        values = torch.sigmoid(self.net(torch.cat([nearest, rays.directions], dim=-1)).float())
        opacity = values[:, 3:]
        return opacity * values[:, :3] + (1 - opacity) * background, opacity[:, 0]

    def loss(self, batch: PixelBatch, step: int) -> Loss:
        count = batch.rays_per_pixel
        rgb, _ = self.shown(batch.rays, batch.background.repeat_interleave(count, 0))
        rgb = rgb.view(-1, count, 3).mean(1)
        return Loss({"rgb": (rgb - batch.rgb).square().mean()}, rgb.detach())

    @torch.no_grad()
    def render_view(self, view: View, background: Tensor) -> Picture:
        grid = view.pixels()
        rays = view.camera.pixel_rays(grid.reshape(-1), self.scene.near, self.scene.far, view.times())
        rgb, opacity = self.shown(rays, background)
        far = torch.full(grid.shape, self.scene.far)
        return Picture(rgb.view(*grid.shape, 3), far, far, opacity.view(grid.shape))


def of_discs(model: type[Discs]) -> Method:
    """A method that draws whole images."""
    return Method(DiscConfig(learning_rate=0.05), paper="none", model=model)


def mixed(fault: type, model: type) -> type:
    """A model with a fault."""
    return type(fault.__name__, (fault, model), {})


SOUND = {
    "rays": of_parts(TinyConfig()),
    "views": of_discs(Discs),
    "pixels alone": Method(TinyConfig(learning_rate=3e-2), paper="none", model=LightField),
}


@pytest.mark.medium
@pytest.mark.parametrize("kind", SOUND)
def test_a_sound_method_passes_every_check(kind: str) -> None:
    """And the caller's random numbers stay as they are."""
    torch.manual_seed(3)
    expected = torch.rand(5)
    torch.manual_seed(3)
    findings = check_method(SOUND[kind])
    assert torch.equal(torch.rand(5), expected)
    assert [finding.line() for finding in findings if not finding.ok] == []
    made = [check.name for check in CHECKS if kind == "rays" or not check.rays_only]
    assert [finding.check for finding in findings] == made
    assert all(finding.detail and "\n" not in finding.detail for finding in findings)


# -- what can be wrong with both kinds: mixed into a RayModel and into Discs -----------------------------------------


@dataclass(frozen=True)
class Unwritable(TinyConfig):
    weights: dict[str, float] = field(default_factory=lambda: {"rgb": 1.0})


class Undecorated(TinyConfig):
    width: int = 64


@dataclass(frozen=True)
class Foreign:
    learning_rate: float = 1e-2


class InABoxOnly:
    def __init__(self, config: TrainConfig, scene: Scene, *parts: Any) -> None:
        if scene.unbounded:
            raise ConfigError("this method needs a box")
        super().__init__(config, scene, *parts)


class StillOnly(LearnsMotion):
    def __init__(self, config: TrainConfig, scene: Scene, *parts: Any) -> None:
        assert not scene.moving
        super().__init__(config, scene, *parts)


class NothingToLearn:
    def __init__(self, *parts: Any) -> None:
        super().__init__(*parts)
        self.requires_grad_(False)


class FlatPicture:
    """Row after row in one column, as rays come."""

    def render_view(self, view: View, background: Tensor) -> Picture:
        picture = super().render_view(view, background)
        return dataclasses.replace(picture, rgb=picture.rgb.reshape(-1, 3))


class BottomlessPicture:
    def render_view(self, view: View, background: Tensor) -> Picture:
        picture = super().render_view(view, background)
        return dataclasses.replace(picture, depth=picture.depth / 0)


class LosesEveryRow:
    """Draws all pixels, also the ones that the view leaves out."""

    def render_view(self, view: View, background: Tensor) -> Picture:
        return super().render_view(dataclasses.replace(view, stride=1), background)


class StaysInEvaluation:
    def render_view(self, view: View, background: Tensor) -> Picture:
        self.eval()
        return super().render_view(view, background)


class NamelessLoss:
    def loss(self, batch: Any, step: int) -> Any:
        return super().loss(batch, step).total


class NoTerms:
    def loss(self, batch: Any, step: int) -> Loss:
        return dataclasses.replace(super().loss(batch, step), terms={})


class LossOfEachPixel:
    def loss(self, batch: Any, step: int) -> Loss:
        loss = super().loss(batch, step)
        return dataclasses.replace(loss, terms={"rgb": loss.total.expand(batch.rgb.shape[:-1])})


class Detached:
    def loss(self, batch: Any, step: int) -> Loss:
        loss = super().loss(batch, step)
        return dataclasses.replace(loss, terms={name: value.detach() for name, value in loss.terms.items()})


class ColorsOfAnotherShape:
    def loss(self, batch: Any, step: int) -> Loss:
        loss = super().loss(batch, step)
        return dataclasses.replace(loss, rgb=loss.rgb[..., :2])


class HalfOptimised:
    def groups(self) -> list[ParameterGroup]:
        (group,) = super().groups()
        return [dataclasses.replace(group, parameters=group.parameters[:-2])]


class OptimisesAnother:
    def groups(self) -> list[ParameterGroup]:
        other = nn.Parameter(torch.zeros(3))
        return [*super().groups(), ParameterGroup((other,), Optimised("other"))]


class OptimisedTwice:
    def groups(self) -> list[ParameterGroup]:
        (group,) = super().groups()
        return [group, ParameterGroup(group.parameters[1:2], Optimised("again"))]


class BrokenGradient:
    """sqrt has an infinite gradient at 0, and infinity times zero is NaN."""

    def loss(self, batch: Any, step: int) -> Loss:
        loss = super().loss(batch, step)
        length = (0 * next(self.parameters())).sum().sqrt()
        return dataclasses.replace(loss, terms={**loss.terms, "length": length})


class Unused:
    def __init__(self, *parts: Any) -> None:
        super().__init__(*parts)
        self.spare = nn.Parameter(torch.zeros(4))


class OtherDice:
    """Starts from numbers that torch's seed knows nothing of."""

    def __init__(self, *parts: Any) -> None:
        super().__init__(*parts)
        with torch.no_grad():
            next(self.parameters()).mul_(1 + 1e-3 * random.random())


class HidesNan:
    def loss(self, batch: Any, step: int) -> Loss:
        loss = super().loss(batch, step)
        return dataclasses.replace(loss, terms={name: torch.nan_to_num(value) for name, value in loss.terms.items()})


class NeedsFloat32:
    """Adds a product, which autocast makes bfloat16, to zeros that are not."""

    def loss(self, batch: Any, step: int) -> Loss:
        loss = super().loss(batch, step)
        factor = torch.zeros(1, 1).index_add(0, torch.zeros(1, dtype=torch.int64), torch.ones(1, 1) @ torch.ones(1, 1))
        return dataclasses.replace(loss, terms={name: factor[0, 0] * value for name, value in loss.terms.items()})


class Tires:
    def before_step(self, step: int, progress: float) -> None:
        super().before_step(step, progress)
        if step == 45:
            raise RuntimeError("enough")


class Diverges:
    def loss(self, batch: Any, step: int) -> Loss:
        loss, factor = super().loss(batch, step), torch.inf if step == 45 else 1.0
        return dataclasses.replace(loss, terms={name: value * factor for name, value in loss.terms.items()})


class Climbs:
    def loss(self, batch: Any, step: int) -> Loss:
        loss = super().loss(batch, step)
        return dataclasses.replace(loss, terms={name: -value for name, value in loss.terms.items()})


class StandsStill:
    def __init__(self, *parts: Any) -> None:
        super().__init__(*parts)
        self.optimised = Optimised(learning_rate=0.0)


class Flickers:
    def render_view(self, view: View, background: Tensor) -> Picture:
        picture = super().render_view(view, background)
        return dataclasses.replace(picture, rgb=picture.rgb + 1e-4 * torch.rand(()))


class RemembersATint:
    """Has something that no checkpoint holds."""

    def __init__(self, *parts: Any) -> None:
        super().__init__(*parts)
        self.tint = 0.01 * torch.rand(3)

    def render_view(self, view: View, background: Tensor) -> Picture:
        picture = super().render_view(view, background)
        return dataclasses.replace(picture, rgb=picture.rgb + self.tint)


class CountsForItself:
    """Its objective depends on the number of calls of this very object."""

    calls = 0

    def loss(self, batch: Any, step: int) -> Loss:
        self.calls += 1
        loss, first = super().loss(batch, step), next(self.parameters())
        return dataclasses.replace(loss, terms={**loss.terms, "size": 1e-3 * self.calls * first.square().mean()})


EITHER: list[tuple[str, type, str]] = [
    ("build", InABoxOnly, "on photographs without .*needs a box"),
    ("build", StillOnly, "on a scene that moves: AssertionError"),
    ("build", NothingToLearn, "on a still scene in a box: the method has nothing to learn"),
    ("view", FlatPicture, r"rgb of a picture has shape \(64, 3\), not \(8, 8, 3\)"),
    ("view", BottomlessPicture, "depth of a picture has a value that is not finite"),
    ("view", LosesEveryRow, r"rgb of a picture has shape \(24, 24, 3\), not \(8, 8, 3\)"),
    ("view", StaysInEvaluation, "render_view leaves the model in evaluation mode"),
    ("loss", NamelessLoss, "the loss is Tensor; return a nerfloom.Loss"),
    ("loss", NoTerms, "its terms are a dictionary of scalars"),
    ("loss", LossOfEachPixel, r"the loss 'rgb' is \((128|24, 24),?\), not a scalar tensor"),
    ("loss", Detached, "no loss has a gradient"),
    ("loss", ColorsOfAnotherShape, "must have the batch's shape"),
    ("groups", HalfOptimised, r"(field.net.2.weight, field.net.2.bias|colors, opacities) are in no group"),
    ("groups", OptimisesAnother, "1 tensors that are not parameters of the model"),
    ("groups", OptimisedTwice, r"(field.net.0.bias|log_radii) is more than once"),
    ("gradients", BrokenGradient, r"(field.net.0.weight|centers).grad is not finite in step 0"),
    ("unused parameters", Unused, "spare is without a gradient"),
    ("repetition", OtherDice, "with the same seed, .*(field.net.0.weight|centers)"),
    ("nan colours", HidesNan, "leaves the loss finite"),
    ("bfloat16", NeedsFloat32, "BFloat16"),
    ("training", Tires, r"RuntimeError: enough"),
    ("training", Diverges, "not finite in .* steps, the first being step 45"),
    ("learning", Climbs, "the squared error goes"),
    ("learning", StandsStill, "the squared error goes from"),
    ("evaluation", Flickers, "when rendered again"),
    ("checkpoint", RemembersATint, r"renders another picture \(rgb\)"),
    ("checkpoint", CountsForItself, "a step after a checkpoint was loaded"),
]
"""A check, its fault for models of any kind, and words of the finding."""

# -- what can be wrong with one kind ----------------------------------------------------------------------------------


class NotDerived:
    """Is built as a model is, and is none."""

    def __init__(self, *parts: Any) -> None:
        pass


class InDoubles(RayModel[TinyConfig]):
    def render(self, rays: Rays, background: Tensor) -> Rendered:
        rendered = super().render(rays, background)
        return dataclasses.replace(rendered, rgb=rendered.rgb.double())


class MoreThanOpaque(VolumeRenderer):
    def render(self, rays: Rays, samples: Samples, field: Field, background: Tensor) -> Rendered:
        rendered = super().render(rays, samples, field, background)
        return dataclasses.replace(rendered, accumulation=1 + rendered.accumulation)


class CountsInTensors(RayModel[TinyConfig]):
    def render(self, rays: Rays, background: Tensor) -> Rendered:
        rendered = super().render(rays, background)
        return dataclasses.replace(rendered, num_samples=torch.tensor(rendered.num_samples))


class ColumnOfDepths(VolumeRenderer):
    def render(self, rays: Rays, samples: Samples, field: Field, background: Tensor) -> Rendered:
        rendered = super().render(rays, samples, field, background)
        return dataclasses.replace(rendered, depth=rendered.depth[:, None])


class InfiniteDepth(RayModel[TinyConfig]):
    def render(self, rays: Rays, background: Tensor) -> Rendered:
        rendered = super().render(rays, background)
        return dataclasses.replace(rendered, median_depth=rendered.depth / 0)


class NeedsRays(TinySampler):
    def sample(self, rays: Rays, field: Field, jitter: bool) -> Samples:
        rays.origins.amax(0)
        return super().sample(rays, field, jitter)


class ForgetsTheBackground(VolumeRenderer):
    def render(self, rays: Rays, samples: Samples, field: Field, background: Tensor) -> Rendered:
        rendered = super().render(rays, samples, field, background)
        missed = rendered.accumulation == 0
        return dataclasses.replace(rendered, rgb=rendered.rgb.masked_fill(missed[:, None], 0.0))


class Fog(VolumeRenderer):
    """Halves the background behind every ray, whether it meets the box or not."""

    def render(self, rays: Rays, samples: Samples, field: Field, background: Tensor) -> Rendered:
        rendered = super().render(rays, samples, field, background / 2)
        return dataclasses.replace(rendered, accumulation=(1 + rendered.accumulation) / 2)


class RayError(LossTerm):
    """Compares rays with their pixels."""

    def __call__(self, shown: RenderedBatch) -> Tensor:
        return (shown.rendered.rgb - shown.batch.rgb).square().mean()


class RaysForPixels(RayModel[TinyConfig]):
    losses = (*RayModel.losses, RayError("again"))


class Float32Field(TinyField):
    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        rows, weight = torch.arange(len(features)), torch.eye(3)
        return torch.zeros(len(features), 3).index_add(0, rows, torch.sigmoid(features) @ weight)


class Idle(TinyField):
    optimised = Optimised(learning_rate=0.0)


class Jitters(TinySampler):
    def sample(self, rays: Rays, field: Field, jitter: bool) -> Samples:
        return super().sample(rays, field, jitter=True)


class LooksAround(VolumeRenderer):
    """Fades a picture by its mean opacity."""

    def render(self, rays: Rays, samples: Samples, field: Field, background: Tensor) -> Rendered:
        rendered = super().render(rays, samples, field, background)
        if self.training:
            return rendered
        share = 1 - rendered.accumulation.mean() / 2
        rgb = background + share * (rendered.rgb - background)
        return dataclasses.replace(rendered, rgb=rgb, accumulation=share * rendered.accumulation)


class SpreadsNan(RayModel[TinyConfig]):
    def render(self, rays: Rays, background: Tensor) -> Rendered:
        rendered = super().render(rays, background)
        return dataclasses.replace(rendered, rgb=rendered.rgb + 0 * rendered.rgb.sum())


class Tinted(TinyField):
    """Remembers something that no checkpoint holds."""

    def __init__(self) -> None:
        super().__init__()
        self.tint = 0.5 + torch.rand(3) / 2

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        return torch.sigmoid(features) * self.tint


OF_RAYS: list[tuple[str, type, Any, str]] = [
    ("config", RayModel, Unwritable(), "'weights'|parameterized generic"),
    ("config", RayModel, Undecorated(), r"write @dataclass\(frozen=True\)"),
    ("config", RayModel, Foreign(), "must derive from nerfloom.TrainConfig"),
    ("build", NotDerived, TinyConfig(), "NotDerived'> does not derive from nerfloom.Model"),
    ("render", ColumnOfDepths, TinyConfig(), r"in evaluation, depth of 128 rays has shape \(128, 1\), not \(128,\)"),
    ("render", InfiniteDepth, TinyConfig(), "median_depth of 128 rays has a value that is not finite"),
    ("render", InDoubles, TinyConfig(), "in evaluation, rgb of 128 rays is torch.float64; make it torch.float32"),
    ("render", MoreThanOpaque, TinyConfig(), r"accumulation is from \S+ to \S+; it must be in \[0, 1\]"),
    ("render", CountsInTensors, TinyConfig(), r"num_samples is tensor\(\d+\); it is the number of evaluations, an int"),
    ("few rays", NeedsRays, TinyConfig(), "a picture of 0 rays: "),
    ("background", ForgetsTheBackground, TinyConfig(), "from a black to a white background"),
    ("background", Fog, TinyConfig(), "rays that miss the box are up to 0.5 opaque"),
    ("loss", RaysForPixels, TinyConfig(), "size of tensor"),
    ("bfloat16", Float32Field, TinyConfig(mixed_precision=False), "BFloat16"),
    ("learning", Idle, TinyConfig(), "the squared error goes from"),
    ("evaluation", Jitters, TinyConfig(), "when rendered again"),
    ("chunks", LooksAround, TinyConfig(), "rendered 100 rays at a time, rgb differs"),
    ("nan rays", SpreadsNan, TinyConfig(), "changes the colours of 511 of 511 other rays"),
    ("checkpoint", Tinted, TinyConfig(), r"renders another picture \(rgb\)"),
]


class FogInFront(Discs):
    """Halves the background, and does not say so."""

    def draw(self, view: View, background: Tensor) -> Picture:
        return super().draw(view, background / 2)


class HalfPrecisionDiscs(Discs):
    def draw(self, view: View, background: Tensor) -> Picture:
        picture = super().draw(view, background)
        return dataclasses.replace(picture, rgb=picture.rgb.half())


OF_VIEWS: list[tuple[str, type[Discs], str]] = [
    ("view", HalfPrecisionDiscs, "rgb of a picture is torch.float16; make it torch.float32"),
    ("background", FogInFront, "a picture: from a black to a white background colours change by"),
]

FAULTS = [
    *((check, of_parts(config, kind), words) for check, kind, config, words in OF_RAYS),
    *((check, of_parts(TinyConfig(), mixed(kind, RayModel)), words) for check, kind, words in EITHER),
    *((check, of_discs(mixed(kind, Discs)), words) for check, kind, words in EITHER),
    *((check, of_discs(kind), words) for check, kind, words in OF_VIEWS),
]
NAMES = [
    *(f"rays-{check}-{kind.__name__}-{type(config).__name__}" for check, kind, config, _ in OF_RAYS),
    *(f"{model}-{check}-{kind.__name__}" for model in ("rays", "views") for check, kind, _ in EITHER),
    *(f"views-{check}-{kind.__name__}" for check, kind, _ in OF_VIEWS),
]


def with_what_they_need(*wanted: str) -> tuple[Check, ...]:
    """Checks, and the checks before them that they depend on."""
    names = set(wanted)
    for check in reversed(CHECKS):
        names |= set(check.needs) if check.name in names else set()
    return tuple(check for check in CHECKS if check.name in names)


def assert_found(method: Method, check: str, words: str) -> None:
    """Find the fault by its check and no other."""
    failed = [finding for finding in check_method(method) if not finding.ok]
    assert [finding.check for finding in failed] == [check], failed
    assert re.search(words, failed[0].detail), failed[0].detail


@pytest.mark.parametrize(("check", "method", "words"), FAULTS, ids=NAMES)
def test_each_fault_is_found_by_its_check(
    check: str, method: Method, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And by none that it needs; the others, which sound methods pass, take most of the time, and so does training."""
    if check in ("evaluation", "nan rays", "checkpoint"):
        monkeypatch.setattr("nerfloom.testing.method_under_test.STEPS", 8)
    monkeypatch.setattr("nerfloom.testing.check.CHECKS", with_what_they_need(check))
    assert_found(method, check, words)


@pytest.mark.slow
@pytest.mark.parametrize(("check", "method", "words"), FAULTS, ids=NAMES)
def test_each_fault_is_found_by_its_check_alone(check: str, method: Method, words: str) -> None:
    assert_found(method, check, words)


def test_every_check_has_a_fault_that_shows_it_works() -> None:
    """The faults are in methods that cast rays, and, for checks of these, in methods that draw whole images."""
    found = {kind: {"summary"} for kind in ("pixels", "views")}
    for check, method, _ in FAULTS:
        found[getattr(method.model, "batches", "pixels")].add(check)
    assert found["pixels"] == {check.name for check in CHECKS}
    assert found["views"] | {"config"} == {check.name for check in CHECKS if not check.rays_only}


@pytest.mark.medium
def test_what_fails_is_listed_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nerfloom.testing.check.CHECKS", with_what_they_need("unused parameters", "evaluation"))
    method = of_parts(TinyConfig(), mixed(Unused, RayModel), Jitters)
    with pytest.raises(AssertionError) as raised:
        assert_method(method, "my-method")
    lines = str(raised.value).splitlines()
    assert lines[0] == "my-method fails 2 checks:"
    assert lines[1].startswith("WRONG unused parameters: ")
    assert lines[2].startswith("WRONG evaluation: ")


@pytest.mark.medium
def test_a_line_of_the_methods_own_file_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nerfloom.testing.check.CHECKS", with_what_they_need("training"))
    method = of_parts(TinyConfig(), mixed(Tires, RayModel))
    (failed,) = [finding for finding in check_method(method) if not finding.ok]
    lines = Path(__file__).read_text(encoding="utf-8").splitlines()
    line = 1 + next(index for index, text in enumerate(lines) if 'RuntimeError("enough")' in text)
    assert failed.detail == f"RuntimeError: enough (test_check_method.py, line {line})"


def test_a_module_without_a_docstring(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nerfloom.testing.check.CHECKS", with_what_they_need("summary"))
    monkeypatch.setitem(sys.modules, "says_nothing", ModuleType("says_nothing"))
    silent = type("Silent", (TinyConfig,), {"__module__": "says_nothing"})
    failed = [finding for finding in check_method(of_parts(silent())) if not finding.ok]
    assert [finding.check for finding in failed] == ["summary"]
    assert "the module says_nothing has no docstring" in failed[0].detail


def test_the_documentation_lists_every_check() -> None:
    text = (ROOT / "docs" / "check-plugins.md").read_text(encoding="utf-8")
    rows = dict(re.findall(r"^\| `([a-z0-9 ]+)` \| (.*) \|$", text, re.MULTILINE))
    assert list(rows) == [check.name for check in CHECKS]
    assert {name for name, row in rows.items() if row.endswith("(rays)")} == {c.name for c in CHECKS if c.rays_only}
