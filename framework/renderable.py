"""The interface of everything that can be rendered; evaluation, renders, the viewer, exports and Python use it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from typing import ClassVar, Protocol, TypeVar, cast, runtime_checkable

import torch
from torch import Tensor, nn

from nerfloom.base.protocols import SeesRegistered
from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.refinement import PoseRefinement
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
    """Something that can be rendered: a trained model, a file of Gaussians, an octree, or a combination of others.

    Views, rays and points are in the frame of its scene. Cameras of the data stand there after `refined_poses`.
    """

    scene: Scene
    """The scene: its box, near and far distance, and whether it moves and images have alpha."""
    cameras: ClassVar[tuple[str, ...] | None] = None
    """Supported camera models; None for all with rays."""

    @property
    @abstractmethod
    def device(self) -> torch.device:
        """The device that renders pictures."""

    @abstractmethod
    def render_view(self, view: View, background: Tensor) -> Picture:
        """Render an image in evaluation mode, without gradient.

        Args:
            view: the camera, on `device`, in the frame of the scene.
            background: (3,) colour in [0, 1] of the background.
        """

    def refined_poses(self, poses: Tensor, training: bool) -> Tensor:
        """Return where cameras of the data stand in the scene: poses (M, 3, 4), by default the given ones.

        A model that refines poses learns the scene as its moved training cameras see it.

        Args:
            poses: (M, 3, 4) camera-to-scene poses of the data, on any device.
            training: whether they are the cameras of all training images, in their order. Cameras of other images
                follow the training cameras around them.
        """
        return poses

    def render_rgb(self, view: View, background: Tensor) -> Tensor:
        """Render only the colours (H, W, 3) of an image, as `render_view` does. Override it with a faster way.

        Args:
            view: the camera, on `device`.
            background: (3,) colour in [0, 1] of the background.
        """
        return self.render_view(view, background).rgb

    @property
    def outputs(self) -> tuple[Output, ...]:
        """Outputs besides colours, depths and opacity (`Picture.extras`)."""
        return ()

    @property
    def appearance(self) -> Appearance | None:
        """Appearance of the training images; None if all images have the same."""
        return None

    @property
    def rays_per_pixel(self) -> int:
        """Number of rays averaged per pixel, if the view does not set it."""
        return 1

    @property
    def background(self) -> Tensor:
        """Default background colour (3,): white if images have alpha, else black."""
        return torch.full((3,), float(self.scene.has_alpha), device=self.device)

    def rendering(self) -> AbstractContextManager[None]:
        """Return a context manager that evaluates parts, such as a density, as for pictures."""
        return nullcontext()


# -- optional capabilities ----------------------------------------------------------------------------------------


class RendersRays(Renderable):
    """A renderable that renders rays independently of each other."""

    @property
    @abstractmethod
    def rays_at_once(self) -> int:
        """Maximum number of rays to render in one call."""

    @abstractmethod
    def render(self, rays: Rays, background: Tensor) -> Rendered:
        """Render R rays, within `Renderable.rendering`.

        Args:
            rays: the rays, in the frame of the scene; R may be 0. Their camera indices choose the appearance alone.
            background: (R, 3) or (3,) colour in [0, 1] of the background.
        """


@runtime_checkable
class RendersFromImages(Protocol):
    """A model that renders a scene from images of it, including scenes without training.

    Only such a model may learn from images of several scenes (`Scene.num_scenes`).
    """

    def show_images(self, dataset: Dataset) -> None:
        """Give the model images, before its first step and its first picture. This changes no parameters.

        Args:
            dataset: images on the model's device. Without `source_images` they are the training images, and each may be
                rendered from the others. Otherwise they are further scenes, rendered from their source images.
        """


@runtime_checkable
class RefinesPoses(Protocol, metaclass=SeesRegistered):
    """A model that can refine the poses of the training cameras."""

    poses: PoseRefinement | None
    """The refinement; None if the settings do not use it."""


@runtime_checkable
class HasDensity(Protocol):
    """A model with a density that can be evaluated at any position."""

    def density(self, points: Points) -> Tensor:
        """Return the density (N,) at `points`, in 1/length."""


@runtime_checkable
class HasSignedDistance(Protocol):
    """A model of a surface with a distance that can be evaluated at any position."""

    def signed_distance(self, points: Points) -> tuple[Tensor, Tensor]:
        """Return the signed distance (N,) at `points`, scene units, negative inside, and its gradient (N, 3)."""


def refined_cameras(model: Renderable, cameras: Cameras, training: bool) -> Cameras:
    """Return cameras of the data where they stand in the scene of a model (`Renderable.refined_poses`).

    Args:
        model: the model.
        cameras: M cameras with the poses of the data.
        training: whether they are the cameras of all training images, in their order.
    """
    return replace(cameras, camera_to_worlds=model.refined_poses(cameras.camera_to_worlds, training))


def with_refined_poses(model: Renderable, dataset: Dataset) -> Dataset:
    """Return the images `dataset` with their cameras where they stand in the scene of a `model`."""
    return replace(dataset, cameras=refined_cameras(model, dataset.cameras, dataset.training))


def training_poses(model: Renderable) -> Tensor | None:
    """Return where the training cameras stand in the scene of `model`, (M, 3, 4) poses; None if they are not known."""
    given = model.scene.camera_to_worlds
    return None if given is None else model.refined_poses(given, training=True)


def parts(whole: Renderable | nn.Module, kind: Callable[..., PartT]) -> list[PartT]:
    """Return the modules of a kind in a model, including the model itself.

    Args:
        whole: the model; a renderable without modules is its only part.
        kind: a class or a runtime-checkable protocol, as in `parts(model, SkipsCells)`.
    """
    found = whole.modules() if isinstance(whole, nn.Module) else (whole,)
    return [part for part in found if isinstance(part, cast("type[PartT]", kind))]
