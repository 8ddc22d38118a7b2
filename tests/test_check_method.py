"""Every built-in method passes `check_method`, and each kind of fault is found by its own check and no other."""

import dataclasses
import importlib
import random
import re
import sys
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

import pytest
import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from framework import Batch, ConfigError, Field, Method, Model, Rays, Rendered, Scene, TrainConfig
from framework.base.registry import load_method, registered
from framework.kernels.frequency import frequency_encoding
from framework.rendering.volume import render_field
from framework.samplers.occupancy import OccupancySampler
from framework.tools.testing import assert_method, check_method
from framework.tools.testing.check import CHECKS
from tests.training.helpers import TINY

ROOT = Path(__file__).parents[1]
BUILT_IN = [name for name, entry in registered("methods").items() if entry.module.startswith("methods.")]
SLOW = ("dnerf",)


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n in SLOW else n for n in BUILT_IN])
def test_every_built_in_method_passes(name: str) -> None:
    method = load_method(name)
    assert_method(method, name, dataclasses.replace(method.config, **TINY.get(name, {})))


@pytest.mark.slow
def test_the_method_in_the_readme_passes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (source,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    (tmp_path / "method_in_the_readme.py").write_text(source, encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    assert_method(importlib.import_module("method_in_the_readme").METHOD, "voxels")


# -- a small method, and what can be wrong with it --------------------------------------------------------------------


@dataclass(frozen=True)
class TinyConfig(TrainConfig):
    num_rays_per_batch: int = 128
    learning_rate: float = 1e-2


class TinyField(Field):
    """Density and colour of a place, by two layers."""

    def __init__(self) -> None:
        super().__init__()
        self.net = nn.Sequential(nn.Linear(21, 64), nn.ReLU(), nn.Linear(64, 4))

    def density(self, positions: Tensor, times: Tensor | None = None) -> tuple[Tensor, Tensor]:
        values = self.net(frequency_encoding(positions, 3)).float()
        return softplus(values[:, 0]), values[:, 1:]

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        return torch.sigmoid(features)


class Tiny(Model[TinyConfig]):
    field_type: ClassVar[type[Field]] = TinyField

    def __init__(self, config: TinyConfig, scene: Scene) -> None:
        super().__init__(config, scene)
        self.field = self.field_type()
        self.sampler = OccupancySampler(scene.box, resolution=16, num_steps=48)

    def render(self, rays: Rays, background: Tensor) -> Rendered:
        return render_field(self.field, self.sampler, rays, background, self.training)

    def before_step(self, step: int, progress: float) -> None:
        self.sampler.update(step, self.field.density)


@dataclass(frozen=True)
class Unwritable(TinyConfig):
    weights: dict[str, float] = field(default_factory=lambda: {"rgb": 1.0})


class Undecorated(TinyConfig):
    width: int = 64


@dataclass(frozen=True)
class Foreign:
    learning_rate: float = 1e-2


class InABoxOnly(Tiny):
    def __init__(self, config: TinyConfig, scene: Scene) -> None:
        if scene.unbounded:
            raise ConfigError("this method needs a box")
        super().__init__(config, scene)


class StillOnly(Tiny):
    learns_motion = True

    def __init__(self, config: TinyConfig, scene: Scene) -> None:
        assert not scene.moving
        super().__init__(config, scene)


class NotDerived:
    """Is built as a model is, and is none."""

    def __init__(self, config: TinyConfig, scene: Scene) -> None:
        pass


class NothingToLearn(Tiny):
    def __init__(self, config: TinyConfig, scene: Scene) -> None:
        super().__init__(config, scene)
        self.requires_grad_(False)


class InDoubles(Tiny):
    def render(self, rays: Rays, background: Tensor) -> Rendered:
        rendered = super().render(rays, background)
        return dataclasses.replace(rendered, rgb=rendered.rgb.double())


class MoreThanOpaque(Tiny):
    def render(self, rays: Rays, background: Tensor) -> Rendered:
        rendered = super().render(rays, background)
        return dataclasses.replace(rendered, accumulation=1 + rendered.accumulation)


class CountsInTensors(Tiny):
    def render(self, rays: Rays, background: Tensor) -> Rendered:
        rendered = super().render(rays, background)
        return dataclasses.replace(rendered, num_samples=torch.tensor(rendered.num_samples))


class ColumnOfDepths(Tiny):
    def render(self, rays: Rays, background: Tensor) -> Rendered:
        rendered = super().render(rays, background)
        return dataclasses.replace(rendered, depth=rendered.depth[:, None])


class InfiniteDepth(Tiny):
    def render(self, rays: Rays, background: Tensor) -> Rendered:
        rendered = super().render(rays, background)
        return dataclasses.replace(rendered, median_depth=rendered.depth / 0)


class NeedsRays(Tiny):
    def render(self, rays: Rays, background: Tensor) -> Rendered:
        rays.origins.amax(0)
        return super().render(rays, background)


class ForgetsTheBackground(Tiny):
    def render(self, rays: Rays, background: Tensor) -> Rendered:
        rendered = super().render(rays, background)
        missed = rendered.accumulation == 0
        return dataclasses.replace(rendered, rgb=rendered.rgb.masked_fill(missed[:, None], 0.0))


class Fog(Tiny):
    """Halves what is behind every ray, whether it meets the box or not."""

    def render(self, rays: Rays, background: Tensor) -> Rendered:
        rendered = super().render(rays, background / 2)
        return dataclasses.replace(rendered, accumulation=(1 + rendered.accumulation) / 2)


class NamelessLoss(Tiny):
    def loss(self, rendered: Rendered, batch: Batch, step: int) -> Any:
        return (rendered.rgb - batch.rgb).square().mean()


class LossOfEachRay(Tiny):
    def loss(self, rendered: Rendered, batch: Batch, step: int) -> dict[str, Tensor]:
        return {"rgb": (rendered.rgb - batch.rgb).square().mean(-1)}


class Detached(Tiny):
    def loss(self, rendered: Rendered, batch: Batch, step: int) -> dict[str, Tensor]:
        return {"rgb": (rendered.rgb.detach() - batch.rgb).square().mean()}


class OneRayAPixel(Tiny):
    def loss(self, rendered: Rendered, batch: Batch, step: int) -> dict[str, Tensor]:
        nearer = batch.rays.nears + 1 - rendered.depth
        return {**super().loss(rendered, batch, step), "near": 1e-3 * nearer.clamp(min=0).mean()}


class HalfOptimised(Tiny):
    def param_groups(self) -> list[dict[str, Any]]:
        return [{"params": [self.field.net[0].weight, self.field.net[0].bias]}]


class OptimisesAnother(Tiny):
    def param_groups(self) -> list[dict[str, Any]]:
        return [{"params": [*self.parameters(), torch.zeros(3, requires_grad=True)]}]


class OptimisedTwice(Tiny):
    def param_groups(self) -> list[dict[str, Any]]:
        return [{"params": list(self.parameters())}, {"params": [self.field.net[0].bias]}]


class Unused(Tiny):
    def __init__(self, config: TinyConfig, scene: Scene) -> None:
        super().__init__(config, scene)
        self.appearance = nn.Parameter(torch.zeros(4))


class BrokenGradient(Tiny):
    """sqrt has an infinite gradient at 0, and infinity times zero is NaN."""

    def loss(self, rendered: Rendered, batch: Batch, step: int) -> dict[str, Tensor]:
        length = (0 * self.field.net[0].bias).sum().sqrt()
        return {**super().loss(rendered, batch, step), "length": length}


class OtherDice(Tiny):
    """Starts from numbers that torch's seed knows nothing of."""

    def __init__(self, config: TinyConfig, scene: Scene) -> None:
        super().__init__(config, scene)
        nn.init.uniform_(self.field.net[2].bias, 0, 1e-3 * random.random())


class HidesNan(Tiny):
    def loss(self, rendered: Rendered, batch: Batch, step: int) -> dict[str, Tensor]:
        return {name: torch.nan_to_num(value) for name, value in super().loss(rendered, batch, step).items()}


class NeedsFloat32(TinyField):
    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        rows, weight = torch.arange(len(features)), torch.eye(3)
        return torch.zeros(len(features), 3).index_add(0, rows, torch.sigmoid(features) @ weight)


class UnderAutocast(Tiny):
    field_type = NeedsFloat32


class Tires(Tiny):
    def before_step(self, step: int, progress: float) -> None:
        super().before_step(step, progress)
        if step == 45:
            raise RuntimeError("enough")


class Diverges(Tiny):
    def loss(self, rendered: Rendered, batch: Batch, step: int) -> dict[str, Tensor]:
        factor = torch.inf if step == 45 else 1.0
        return {name: value * factor for name, value in super().loss(rendered, batch, step).items()}


class Climbs(Tiny):
    def loss(self, rendered: Rendered, batch: Batch, step: int) -> dict[str, Tensor]:
        return {name: -value for name, value in super().loss(rendered, batch, step).items()}


class StandsStill(Tiny):
    def param_groups(self) -> list[dict[str, Any]]:
        return [{"params": list(self.parameters()), "lr": 0.0}]


class Jitters(Tiny):
    def render(self, rays: Rays, background: Tensor) -> Rendered:
        return render_field(self.field, self.sampler, rays, background, jitter=True)


class LooksAround(Tiny):
    """Fades a picture by its mean opacity."""

    def render(self, rays: Rays, background: Tensor) -> Rendered:
        rendered = super().render(rays, background)
        if self.training:
            return rendered
        share = 1 - rendered.accumulation.mean() / 2
        rgb = background + share * (rendered.rgb - background)
        return dataclasses.replace(rendered, rgb=rgb, accumulation=share * rendered.accumulation)


class SpreadsNan(Tiny):
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


class ForgetsItsTint(Tiny):
    field_type = Tinted


class CountsForItself(Tiny):
    """What it minimises depends on how often this very object was called."""

    calls = 0

    def loss(self, rendered: Rendered, batch: Batch, step: int) -> dict[str, Tensor]:
        self.calls += 1
        opacity = rendered.accumulation.mean() * (1e-3 * self.calls)
        return {**super().loss(rendered, batch, step), "opacity": opacity}


FAULTS: list[tuple[str, type, Any, str]] = [
    ("config", Tiny, Unwritable(), "'weights'|parameterized generic"),
    ("config", Tiny, Undecorated(), r"write @dataclass\(frozen=True\)"),
    ("config", Tiny, Foreign(), "does not derive from framework.TrainConfig"),
    ("build", InABoxOnly, TinyConfig(), r"on photographs without .*needs a box \(test_check_method.py, line \d+\)"),
    ("build", StillOnly, TinyConfig(), "on a scene that moves: AssertionError"),
    ("build", NotDerived, TinyConfig(), "NotDerived'> does not derive from framework.Model"),
    ("build", NothingToLearn, TinyConfig(), "on a still scene in a box: the method has nothing to learn"),
    ("render", ColumnOfDepths, TinyConfig(), r"in evaluation, depth of 128 rays has shape \(128, 1\), not \(128,\)"),
    ("render", InfiniteDepth, TinyConfig(), "median_depth of 128 rays holds a value that is not finite"),
    ("render", InDoubles, TinyConfig(), "in evaluation, rgb of 128 rays is torch.float64; make it torch.float32"),
    ("render", MoreThanOpaque, TinyConfig(), r"accumulation is from \S+ to \S+; it must be in \[0, 1\]"),
    ("render", CountsInTensors, TinyConfig(), r"num_samples is tensor\(\d+\); it is the number of evaluations, an int"),
    ("few rays", NeedsRays, TinyConfig(), "a picture of 0 rays: "),
    ("background", ForgetsTheBackground, TinyConfig(), "from a black to a white background"),
    ("background", Fog, TinyConfig(), "rays that miss the box are up to 0.5 opaque"),
    ("loss", NamelessLoss, TinyConfig(), "the loss is Tensor, or empty; return a dictionary of named scalars"),
    ("loss", LossOfEachRay, TinyConfig(), r"the loss 'rgb' is \(128,\), not a scalar tensor"),
    ("loss", Detached, TinyConfig(), "no loss has a gradient"),
    ("loss", OneRayAPixel, TinyConfig(), "size of tensor"),
    ("groups", HalfOptimised, TinyConfig(), r"field.net.2.weight, field.net.2.bias are in no group"),
    ("groups", OptimisesAnother, TinyConfig(), "no parameters of the model, 1 of them"),
    ("groups", OptimisedTwice, TinyConfig(), "field.net.0.bias is more than once"),
    ("unused parameters", Unused, TinyConfig(), "appearance is without a gradient"),
    ("gradients", BrokenGradient, TinyConfig(), "field.net.0.bias.grad is not finite in step 0"),
    ("repetition", OtherDice, TinyConfig(), "by the same seed, .*field.net.2.bias"),
    ("nan colours", HidesNan, TinyConfig(), "leaves the loss finite"),
    ("bfloat16", UnderAutocast, TinyConfig(), "BFloat16"),
    ("training", Tires, TinyConfig(), r"RuntimeError: enough \(test_check_method.py"),
    ("training", Diverges, TinyConfig(), "not finite in .* steps, the first being step 45"),
    ("learning", Climbs, TinyConfig(), "the squared error goes from"),
    ("learning", StandsStill, TinyConfig(), "the squared error goes from"),
    ("evaluation", Jitters, TinyConfig(), "when it is rendered again"),
    ("chunks", LooksAround, TinyConfig(), "rendered 100 rays at a time, rgb differs"),
    ("nan rays", SpreadsNan, TinyConfig(), "changes the colours of 511 of 511 other rays"),
    ("checkpoint", ForgetsItsTint, TinyConfig(), r"renders another picture \(rgb\)"),
    ("checkpoint", CountsForItself, TinyConfig(), "a step after a checkpoint was loaded"),
]


def test_a_sound_method_passes_every_check() -> None:
    findings = check_method(Method(Tiny, TinyConfig(), paper="none"))
    assert [finding.line() for finding in findings if not finding.ok] == []
    assert [finding.check for finding in findings] == [check.name for check in CHECKS]
    assert all(finding.detail and "\n" not in finding.detail for finding in findings)


NAMES = [f"{check}-{model.__name__}-{type(config).__name__}" for check, model, config, _ in FAULTS]


@pytest.mark.parametrize(("check", "model", "config", "words"), FAULTS, ids=NAMES)
def test_each_fault_is_found_by_its_check_alone(check: str, model: type, config: Any, words: str) -> None:
    with pytest.raises(AssertionError, match=words) as raised:
        assert_method(Method(model, config, paper="none"))
    lines = str(raised.value).splitlines()
    assert lines[0] == "the method fails 1 checks:"
    assert [line.partition(":")[0] for line in lines[1:]] == [f"WRONG {check}"]


def test_a_module_without_a_docstring(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "says_nothing", ModuleType("says_nothing"))
    silent = type("Silent", (Tiny,), {"__module__": "says_nothing"})
    failed = [finding for finding in check_method(Method(silent, TinyConfig(), paper="none")) if not finding.ok]
    assert [finding.check for finding in failed] == ["summary"]
    assert "the module says_nothing has no docstring" in failed[0].detail


def test_every_check_has_a_fault_that_shows_it_works() -> None:
    assert {check for check, *_ in FAULTS} | {"summary"} == {check.name for check in CHECKS}


def test_the_documentation_lists_every_check() -> None:
    text = (ROOT / "docs" / "plugins.md").read_text(encoding="utf-8")
    assert re.findall(r"^\| `([a-z0-9 ]+)` \|", text, re.MULTILINE) == [check.name for check in CHECKS]


def test_the_callers_random_numbers_stay_as_they_are() -> None:
    torch.manual_seed(3)
    expected = torch.rand(5)
    torch.manual_seed(3)
    check_method(Method(Tiny, TinyConfig(), paper="none"))
    assert torch.equal(torch.rand(5), expected)


def test_what_fails_is_listed_at_once() -> None:
    class Twofold(Unused):
        def render(self, rays: Rays, background: Tensor) -> Rendered:
            return render_field(self.field, self.sampler, rays, background, jitter=True)

    with pytest.raises(AssertionError) as raised:
        assert_method(Method(Twofold, TinyConfig(), paper="none"), "my-method")
    lines = str(raised.value).splitlines()
    assert lines[0] == "my-method fails 2 checks:"
    assert lines[1].startswith("WRONG unused parameters: ")
    assert lines[2].startswith("WRONG evaluation: ")
