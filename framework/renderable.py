"""The interface of what can be looked at, which evaluation, renders, the viewer, exports and Python use."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import ClassVar, Protocol, TypeVar, cast, runtime_checkable

import torch
from torch import Tensor, nn

from nerfloom.base.protocols import SeesRegistered
from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.view import View
from nerfloom.data.dataset import Dataset
from nerfloom.data.scene import Scene
from nerfloom.fields.appearance import Appearance
from nerfloom.geometry.points import Points
from nerfloom.geometry.rays import Rays
from nerfloom.rendering.outputs import Output
from nerfloom.rendering.rendered import Picture, Rendered

PartT = TypeVar("PartT")


class Renderable(ABC):
    """Something that can be looked at: a trained model, a file of Gaussians, or what is put together from others."""

    scene: Scene
    """Its frame: box, near and far distance, whether it moves, and whether images tell what is background."""
    cameras: ClassVar[tuple[str, ...] | None] = None
    """Camera models that it can draw images of; None for all for which there are rays."""

    @property
    @abstractmethod
    def device(self) -> torch.device:
        """The device on which pictures are rendered."""

    @abstractmethod
    def render_view(self, view: View, background: Tensor) -> Picture:
        """Render an image in evaluation mode, without gradient.

        Args:
            view: the camera, on `device`.
            background: (3,) colour in [0, 1] of the background.
        """

    def render_rgb(self, view: View, background: Tensor) -> Tensor:
        """Render the colours (H, W, 3) of an image alone, as `render_view` does; override it if that is faster.

        Args:
            view: the camera, on `device`.
            background: (3,) colour in [0, 1] of the background.
        """
        return self.render_view(view, background).rgb

    @property
    def outputs(self) -> tuple[Output, ...]:
        """Further outputs of its pictures, beside colours, depths and opacity (`Picture.extras`)."""
        return ()

    @property
    def rays_per_pixel(self) -> int:
        """Number of rays that are averaged for each pixel of an image, if the view does not set it."""
        return 1

    @property
    def background(self) -> Tensor:
        """Colour (3,) behind the scene where nothing else is asked for: white if images have alpha, else black."""
        return torch.full((3,), float(self.scene.has_alpha), device=self.device)

    def rendering(self) -> AbstractContextManager[None]:
        """Return a context in which parts of it, such as a density, are evaluated as they are for pictures."""
        return nullcontext()


# -- optional capabilities ----------------------------------------------------------------------------------------


class RendersRays(Renderable):
    """Something whose pictures are made of rays, each of which can be rendered alone."""

    @property
    @abstractmethod
    def rays_at_once(self) -> int:
        """Maximum number of rays of a picture to render in one call."""

    @abstractmethod
    def render(self, rays: Rays, background: Tensor) -> Rendered:
        """Render R rays, within `Renderable.rendering`.

        Args:
            rays: the rays; R may be 0.
            background: (R, 3) or (3,) colour in [0, 1] of the background.
        """


@runtime_checkable
class RendersFromImages(Protocol):
    """A model that renders a scene from images of it, which it is shown: scenes that it never learnt from, too.

    It may learn from images of several scenes (`Scene.num_scenes`), which other models may not.
    """

    def show_images(self, dataset: Dataset) -> None:
        """Show the model images, before its first step and its first picture; its parameters stay as they are.

        Args:
            dataset: images on the model's device. Without `source_images`, those that it learns from: each may be
                rendered from the others. Otherwise further scenes, which are rendered from their source images.
        """


@runtime_checkable
class HasAppearance(Protocol, metaclass=SeesRegistered):
    """A model that can learn an appearance vector for each image."""

    appearance: Appearance | None
    """The vectors; None if the settings or the scene do not use them."""


@runtime_checkable
class RefinesPoses(Protocol):
    """A model that can refine the poses of the training cameras."""

    def refined_cameras(self, cameras: Cameras) -> Cameras:
        """Return the training cameras with their refined poses.

        Args:
            cameras: M training cameras with their given poses.
        """


@runtime_checkable
class HasDensity(Protocol):
    """A model whose density can be evaluated at any position."""

    def density(self, points: Points) -> Tensor:
        """Return the density (N,) at `points`, in 1/length."""


def parts(whole: Renderable | nn.Module, kind: Callable[..., PartT]) -> list[PartT]:
    """Return the modules of a model that are of a kind, including the model itself.

    Args:
        whole: the model; something without modules is its only part.
        kind: a class or a runtime-checkable protocol, as in `parts(model, SkipsCells)`.
    """
    found = whole.modules() if isinstance(whole, nn.Module) else (whole,)
    return [part for part in found if isinstance(part, cast("type[PartT]", kind))]
