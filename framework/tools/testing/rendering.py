"""Checks of building a model and of the pictures it renders."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from framework.geometry.rays import Rays
from framework.model import Model, parts
from framework.ray_model import RayModel
from framework.rendering.rendered import Rendered
from framework.samplers.base import SkipsCells
from framework.samplers.proposal import ProposalSampler
from framework.tools.testing.finding import Fault
from framework.tools.testing.subject import STRIDE, Learner, Subject

TOLERANCE = 1e-3
"""Of colours and opacities that should be the same."""
CHUNK = 100
"""Rays at a time where a picture is rendered in parts."""


def check_build(subject: Subject) -> str:
    """`model(config, scene)` makes a Model with something to learn, whatever the scene."""

    model = subject.method.model
    if not (isinstance(model, type) and issubclass(model, Model)):
        raise Fault(f"{model!r} does not derive from framework.Model")

    def look(learner: Learner) -> None:
        if not any(parameter.requires_grad for parameter in learner.model.parameters()):
            raise Fault(f"{subject.name} has nothing to learn: no torch.nn.Parameter, and no module with any")

    subject.on_each_scene(look)
    return f"on {', on '.join(subject.scenes)}"


def check_render(subject: Subject) -> str:
    """`render` fills in every field of Rendered, with the right shapes and finite numbers."""

    def look(learner: Learner) -> None:
        batch = learner.batch()
        require_rendered(learner.show(batch.rays, torch.ones(3)), len(batch.rays), "in evaluation")
        require_rendered(learner.rendered(batch.rays, batch.background), len(batch.rays), "in training")

    subject.on_each_scene(look)
    return "every field of Rendered has its shape and is finite, in training and in evaluation"


def require_rendered(rendered: Rendered, count: int, when: str) -> None:
    """Raises: Fault where a picture of `count` rays lacks something."""
    shapes: dict[str, tuple[int, ...]] = {"rgb": (count, 3)}
    shapes |= {name: (count,) for name in ("depth", "median_depth", "accumulation")}
    values = {name: getattr(rendered, name) for name in shapes}
    if rendered.normals is not None:
        shapes["normals"], values["normals"] = (count, 3), rendered.normals
    for name, value in rendered.penalties.items():
        shapes[f"penalties['{name}']"], values[f"penalties['{name}']"] = (count,), value
    if rendered.samples is not None and rendered.weights is not None:
        shapes["weights"], values["weights"] = (len(rendered.samples),), rendered.weights
        if rendered.samples.num_rays != count:
            raise Fault(f"{when}, samples are of {rendered.samples.num_rays} rays, not of {count}")
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
        raise Fault(f"{what} holds a value that is not finite (NaN or infinity)")


def check_view(subject: Subject) -> str:
    """`render_view` fills in every field of Picture, with the right shapes and finite numbers."""

    def look(learner: Learner) -> None:
        learner.model.train()
        view, picture = learner.dataset.view(0, STRIDE), learner.picture()
        size = (view.height, view.width)
        shapes = {"rgb": (*size, 3), "depth": size, "median_depth": size, "accumulation": size}
        for name, shape in shapes.items():
            _require(getattr(picture, name), shape, f"{name} of a picture")
        if picture.normals is not None:
            _require(picture.normals, (*size, 3), "normals of a picture")
        if not learner.model.training:
            raise Fault("render_view leaves the model in evaluation mode; put it back as it was")

    subject.on_each_scene(look)
    return "every field of Picture has its shape and is finite"


def check_few_rays(subject: Subject) -> str:
    """No rays give an empty picture, and one ray a picture of one pixel."""

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


def check_background(subject: Subject) -> str:
    """The background shows as far as a ray is not opaque, and where the box is missed altogether."""
    learner = subject.learner()
    if not isinstance(learner.model, RayModel):
        dark, light = (learner.picture(background=value) for value in (0.0, 1.0))
        _require_change(light.rgb - dark.rgb, light.accumulation[..., None], "a picture")
        return "it shows as far as pixels are not opaque"
    rays = learner.view().rays
    away = replace(rays, directions=-rays.directions)  # the cameras stand outside the box and look at it
    _require_background(learner, rays, "rays through the box")
    opaque = float(_require_background(learner, away, "rays that miss the box").max())
    if _ends_at_the_box(learner.model) and opaque > TOLERANCE:
        raise Fault(f"rays that miss the box are up to {opaque:.3g} opaque; nothing is there to stop light")
    return "it shows as far as rays are not opaque"


def _require_background(learner: Learner, rays: Rays, what: str) -> Tensor:
    """The opacity (R,) of rays, after a look at what black and white behind them change."""
    dark, light = (learner.show(rays, torch.full((3,), value)) for value in (0.0, 1.0))
    _require_change(light.rgb - dark.rgb, light.accumulation[:, None], what)
    return light.accumulation


def _require_change(change: Tensor, accumulation: Tensor, what: str) -> None:
    """Raises: Fault where colours do not change with the background as far as the opacity says."""
    transparency = 1 - accumulation
    if not bool(((change - transparency).abs() <= TOLERANCE).all()):
        raise Fault(
            f"{what}: from a black to a white background colours change by {float(change.mean()):.3g} in the mean, and "
            f"1 - accumulation is {float(transparency.mean()):.3g}; rgb must hold (1 - accumulation) * background"
        )


def _ends_at_the_box(model: Model) -> bool:
    """Whether a model's samplers look at nothing outside the box."""
    return bool(parts(model, SkipsCells)) or any(not sampler.unbounded for sampler in parts(model, ProposalSampler))


def check_evaluation(subject: Subject) -> str:
    """In evaluation a picture is the same each time."""
    learner = subject.trained
    first, second = (learner.picture(seed=seed).rgb for seed in (1, 2))
    if not torch.equal(first, second):
        raise Fault(
            f"the same picture differs by up to {float((first - second).abs().max()):.3g} when it is rendered again; "
            "sample at fixed places unless self.training"
        )
    return "a picture is the same each time"


def check_chunks(subject: Subject) -> str:
    """A ray's colour does not depend on which others are rendered with it."""
    learner = subject.trained
    view = learner.view()
    whole = learner.show(view.rays, view.background)
    ends = [slice(start, start + CHUNK) for start in range(0, len(view.rays), CHUNK)]
    parts = [learner.show(view.rays[part], view.background[part]) for part in ends]
    for name in ("rgb", "accumulation"):
        worst = float((torch.cat([getattr(part, name) for part in parts]) - getattr(whole, name)).abs().max())
        if not worst <= TOLERANCE:
            raise Fault(
                f"rendered {CHUNK} rays at a time, {name} differs by up to {worst:.3g}; a ray must not look at the "
                "others of its batch"
            )
    return f"{len(view.rays)} rays at once and {CHUNK} at a time give the same picture"


def check_nan_rays(subject: Subject) -> str:
    """A ray that is not finite spoils its own colour only."""
    learner = subject.trained
    view = learner.view()
    whole = learner.show(view.rays, view.background).rgb
    broken = len(view.rays) // 2
    others = torch.arange(len(view.rays)) != broken
    found = learner.show(_with_nan(view.rays, broken), view.background).rgb
    spoilt = ~((found - whole)[others].abs() <= TOLERANCE).all(-1)
    if bool(spoilt.any()):
        raise Fault(f"a ray whose origin is NaN changes the colours of {int(spoilt.sum())} of {len(spoilt)} other rays")
    return "a ray that is NaN spoils its own colour only"


def _with_nan(rays: Rays, index: int) -> Rays:
    origins = rays.origins.clone()
    origins[index] = torch.nan
    return replace(rays, origins=origins)
