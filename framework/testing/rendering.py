"""Checks of building a model and of rendering.

Each check returns a line for people, and raises Fault if it fails.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from nerfloom.geometry.rays import Rays
from nerfloom.model import Model
from nerfloom.ray_model import RayModel
from nerfloom.renderable import parts
from nerfloom.rendering.background import SphereRenderer
from nerfloom.rendering.rendered import Rendered
from nerfloom.samplers.base import SkipsCells
from nerfloom.samplers.proposal import ProposalSampler
from nerfloom.testing.finding import Fault
from nerfloom.testing.method_under_test import STRIDE, Learner, MethodUnderTest

TOLERANCE = 1e-3
"""Maximum difference of colours and opacities that should be equal."""
CHUNK = 100
"""Number of rays per part when an image is rendered in parts."""


def check_build(subject: MethodUnderTest) -> str:
    """Check that `subject` builds a Model with parameters on each scene."""

    model = subject.method.model
    if not (isinstance(model, type) and issubclass(model, Model)):
        raise Fault(f"{model!r} does not derive from nerfloom.Model")

    def look(learner: Learner) -> None:
        if not any(parameter.requires_grad for parameter in learner.model.parameters()):
            raise Fault(f"{subject.name} has nothing to learn: no torch.nn.Parameter and no module with one")

    subject.on_each_scene(look)
    return f"on {', on '.join(subject.scenes)}"


def check_render(subject: MethodUnderTest) -> str:
    """Check that `subject` renders every field of Rendered with its shape and finite values."""

    def look(learner: Learner) -> None:
        batch = learner.batch()
        require_rendered(learner.show(batch.rays, torch.ones(3)), len(batch.rays), "in evaluation")
        require_rendered(learner.rendered(batch.rays, batch.background), len(batch.rays), "in training")

    subject.on_each_scene(look)
    return "every field of Rendered has its shape and is finite, in training and in evaluation"


def require_rendered(rendered: Rendered, count: int, when: str) -> None:
    """Check the shapes and values of `count` rays `rendered`; the message begins with `when`.

    Raises:
        Fault: if a field has another shape or type, or a value is not finite or out of range.
    """
    shapes: dict[str, tuple[int, ...]] = {"rgb": (count, 3)}
    shapes |= {name: (count,) for name in ("depth", "median_depth", "accumulation")}
    values = {name: getattr(rendered, name) for name in shapes}
    for name, value in rendered.extras.items():
        if isinstance(value, Tensor):
            shapes[f"extras['{name}']"], values[f"extras['{name}']"] = (count, *value.shape[1:]), value
    if rendered.samples is not None and rendered.weights is not None:
        shapes["weights"], values["weights"] = (len(rendered.samples),), rendered.weights
        if rendered.samples.num_rays != count:
            raise Fault(f"{when}, samples have {rendered.samples.num_rays} rays, not {count}")
    for name, shape in shapes.items():
        _require(values[name], shape, f"{when}, {name} of {count} rays")
    opacity = rendered.accumulation.detach()
    if count and not (float(opacity.min()) >= -TOLERANCE and float(opacity.max()) <= 1 + TOLERANCE):
        raise Fault(f"{when}, accumulation is from {opacity.min():.3g} to {opacity.max():.3g}; it must be in [0, 1]")
    if not isinstance(rendered.num_samples, int) or rendered.num_samples < 0:
        raise Fault(f"{when}, num_samples is {rendered.num_samples!r}; it is the number of evaluations, an int")
    if rendered.coarse is not None:
        require_rendered(rendered.coarse, count, f"{when}, in the coarse picture")


def _require(value: Tensor, shape: tuple[int, ...], what: str) -> None:
    if not isinstance(value, Tensor):
        raise Fault(f"{what} is {value!r}, not a tensor")
    if tuple(value.shape) != shape:
        raise Fault(f"{what} has shape {tuple(value.shape)}, not {shape}")
    if value.dtype != torch.float32:
        raise Fault(f"{what} is {value.dtype}; make it torch.float32, with .float()")
    if not bool(torch.isfinite(value).all()):
        raise Fault(f"{what} has a value that is not finite (NaN or infinity)")


def check_view(subject: MethodUnderTest) -> str:
    """Check that `subject` renders every field of Picture with its shape and finite values."""

    def look(learner: Learner) -> None:
        learner.model.train()
        view, picture = learner.dataset.view(0, STRIDE), learner.picture()
        size = (view.height, view.width)
        shapes = {"rgb": (*size, 3), "depth": size, "median_depth": size, "accumulation": size}
        for name, shape in shapes.items():
            _require(getattr(picture, name), shape, f"{name} of a picture")
        for output in learner.model.outputs:
            if output.name not in picture.extras:
                raise Fault(f"a picture lacks {output.name}, which the model declares as an output")
            _require(picture.extras[output.name], (*size, *output.shape), f"{output.name} of a picture")
        colors = learner.colors()
        _require(colors, (*size, 3), "the result of render_rgb")
        if not torch.allclose(colors, picture.rgb, atol=1e-4):
            raise Fault("render_rgb returns other colours than render_view")
        if not learner.model.training:
            raise Fault("render_view leaves the model in evaluation mode; restore its mode")

    subject.on_each_scene(look)
    return "every field of Picture has its shape and is finite"


def check_few_rays(subject: MethodUnderTest) -> str:
    """Check that `subject` renders 0 rays and 1 ray."""

    def look(learner: Learner) -> None:
        batch = learner.batch()
        for count in (0, 1):
            try:
                rays, background = batch.rays[:count], batch.background[:count]
                require_rendered(learner.show(rays, torch.ones(3)), count, "in evaluation")
                require_rendered(learner.rendered(rays, background), count, "in training")
            except Fault:
                raise
            except Exception as error:
                raise Fault(f"a picture of {count} rays: {subject.described(error)}") from error

    subject.on_each_scene(look)
    return "0 rays and 1 ray are rendered"


def check_background(subject: MethodUnderTest) -> str:
    """Check that `subject` shows the background where rays are not opaque, and where they miss the box."""
    learner = subject.learner()
    if not isinstance(learner.model, RayModel):
        dark, light = (learner.picture(background=value) for value in (0.0, 1.0))
        _require_change(light.rgb - dark.rgb, light.accumulation[..., None], "a picture")
        return "it shows where pixels are not opaque"
    rays = learner.view().rays
    away = replace(rays, directions=-rays.directions)  # the cameras are outside the box and look at it
    _require_background(learner, rays, "rays through the box")
    opaque = float(_require_background(learner, away, "rays that miss the box").max())
    if _ends_at_the_box(learner.model) and opaque > TOLERANCE:
        raise Fault(f"rays that miss the box are up to {opaque:.3g} opaque, although nothing is there")
    return "it shows where rays are not opaque"


def _require_background(learner: Learner, rays: Rays, what: str) -> Tensor:
    """Return the opacity (R,) of rays; raise Fault unless colours contain the background accordingly."""
    dark, light = (learner.show(rays, torch.full((3,), value)) for value in (0.0, 1.0))
    _require_change(light.rgb - dark.rgb, light.accumulation[:, None], what)
    return light.accumulation


def _require_change(change: Tensor, accumulation: Tensor, what: str) -> None:
    """Raise Fault unless the change of colours from a black to a white background is 1 - opacity."""
    transparency = 1 - accumulation
    if not bool(((change - transparency).abs() <= TOLERANCE).all()):
        raise Fault(
            f"{what}: from a black to a white background colours change by {float(change.mean()):.3g} on average, and "
            f"1 - accumulation is {float(transparency.mean()):.3g}; rgb must include (1 - accumulation) * background"
        )


def _ends_at_the_box(model: Model) -> bool:
    """Return whether the model places no sample outside the box."""
    if parts(model, SphereRenderer):
        return False
    grids, proposals = parts(model, SkipsCells), parts(model, ProposalSampler)
    return any(grid.levels == 1 for grid in grids) or any(not sampler.unbounded for sampler in proposals)


def check_evaluation(subject: MethodUnderTest) -> str:
    """Check that rendering `subject` in evaluation is deterministic."""
    learner = subject.trained
    first, second = (learner.picture(seed=seed).rgb for seed in (1, 2))
    if not torch.equal(first, second):
        raise Fault(
            f"the same picture differs by up to {float((first - second).abs().max()):.3g} when rendered again; "
            "use fixed positions unless self.training"
        )
    return "a picture is the same each time"


def check_chunks(subject: MethodUnderTest) -> str:
    """Check that a ray's colour from `subject` does not depend on the other rays of a batch."""
    learner = subject.trained
    view = learner.view()
    whole = learner.show(view.rays, view.background)
    slices = [slice(start, start + CHUNK) for start in range(0, len(view.rays), CHUNK)]
    parts = [learner.show(view.rays[part], view.background[part]) for part in slices]
    for name in ("rgb", "accumulation"):
        worst = float((torch.cat([getattr(part, name) for part in parts]) - getattr(whole, name)).abs().max())
        if not worst <= TOLERANCE:
            raise Fault(
                f"rendered {CHUNK} rays at a time, {name} differs by up to {worst:.3g}; a ray must not depend on the "
                "others of its batch"
            )
    return f"{len(view.rays)} rays at once and {CHUNK} at a time give the same picture"


def check_nan_rays(subject: MethodUnderTest) -> str:
    """Check that a non-finite ray does not change the colours of other rays of `subject`."""
    learner = subject.trained
    view = learner.view()
    whole = learner.show(view.rays, view.background).rgb
    broken = len(view.rays) // 2
    others = torch.arange(len(view.rays)) != broken
    rgb = learner.show(_with_nan(view.rays, broken), view.background).rgb
    wrong = ~((rgb - whole)[others].abs() <= TOLERANCE).all(-1)
    if bool(wrong.any()):
        raise Fault(f"a ray with a NaN origin changes the colours of {int(wrong.sum())} of {len(wrong)} other rays")
    return "a ray that is NaN spoils its own colour only"


def _with_nan(rays: Rays, index: int) -> Rays:
    origins = rays.origins.clone()
    origins[index] = torch.nan
    return replace(rays, origins=origins)
