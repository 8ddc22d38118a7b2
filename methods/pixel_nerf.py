"""PixelNeRF: one network for many scenes; it renders a new scene from a few images, without training on it.

Yu et al., "pixelNeRF: Neural Radiance Fields from One or Few Images", CVPR 2021. It trains on data with many scenes,
such as `ns-train pixel-nerf procedural --num-scenes 200 --size 32`, and is evaluated on scenes it has never seen. The
image encoder is small and trained from scratch: no pretrained weights are shipped, not even ImageNet's.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from nerfloom import (
    ConfigError,
    DataError,
    Dataset,
    Loss,
    Method,
    Picture,
    PixelBatch,
    Points,
    RayModel,
    Rays,
    Rendered,
    Renderer,
    Sampler,
    Scene,
    View,
)
from nerfloom.base.config import Range, SourceViewsConfig
from nerfloom.base.evenly_spaced import evenly_spread
from nerfloom.data.pixels.batch import composite
from nerfloom.data.source_views import images_of, nearest_in_direction, other_images
from nerfloom.encodings.pixel_aligned import ImageEncoder, SourceViews
from nerfloom.fields.pixel_aligned import PixelAlignedField
from nerfloom.geometry.bounds import half_edge
from nerfloom.kernels.encodings.frequency import MAX_FREQUENCIES
from nerfloom.samplers.hierarchical import MIN_COARSE, HierarchicalSampler

BLOCKS_BEFORE, BLOCKS_AFTER = 3, 2
"""Residual blocks before and after the mean over views, as in the paper."""


@dataclass(frozen=True)
class PixelNeRFConfig(
    SourceViewsConfig,
    max_num_iterations=400_000,
    num_rays_per_batch=512,
    learning_rate=1e-3,
    background="white",
    eval_num_rays_per_chunk=1_024,
    robust="off",
):
    """Settings of pixel-nerf: the paper's structure, with networks that a processor can train."""

    RANGES: ClassVar[dict[str, Range]] = {
        "num_coarse_samples": (MIN_COARSE, 2**14),
        "num_fine_samples": (1, 2**14),
        "hidden_width": (2, 2**14),
        "position_frequencies": (0, MAX_FREQUENCIES),
        "encoder_widths": (1, 2**14),
    }
    GONE: ClassVar[dict[str, Any]] = {"num_view_blocks": BLOCKS_BEFORE}
    num_coarse_samples: int = 32
    """Stratified intervals per ray (64 in the paper)."""
    num_fine_samples: int = 32
    """Intervals per ray drawn from the weights of the coarse ones (16, and 16 around the depth, in the paper)."""
    hidden_width: int = 64
    """Features per layer (512 in the paper)."""
    position_frequencies: int = 6
    """Number of frequencies in the encoding of positions, in the frames of the source cameras."""
    encoder_widths: tuple[int, ...] = (32, 32, 64)
    """Features of each level of the image encoder, finest first; each has half the resolution of the one before."""


class PixelNeRF(RayModel[PixelNeRFConfig]):
    """A model of many scenes: the encoder takes images of a scene, and `field` looks up their features."""

    field: PixelAlignedField

    def __init__(
        self, config: PixelNeRFConfig, scene: Scene, field: PixelAlignedField, sampler: Sampler, renderer: Renderer
    ) -> None:
        super().__init__(config, scene, field, sampler, renderer)
        self.encoder = ImageEncoder(config.encoder_widths)
        self.learnt: Dataset | None = None
        """The training images; each can be rendered from others of its scene."""
        self.unseen: Dataset | None = None
        """Images of other scenes, which are rendered from their source images."""

    def show_images(self, dataset: Dataset) -> None:
        """Set the images to render from: `dataset` has the training images, or images of other scenes.

        Raises:
            DataError: if a scene has fewer than two training images.
        """
        if dataset.source_images is not None:
            self.unseen = dataset
            return
        scenes = [None] if dataset.scene_indices is None else dataset.scene_indices.unique().tolist()
        if min(len(images_of(dataset, scene)) for scene in scenes) < 2:
            raise DataError("pixel-nerf renders an image from others of its scene: each scene needs at least 2 images")
        self.learnt = dataset

    # -- source views -----------------------------------------------------------------------------------------

    def drawn_views(self, image: int) -> SourceViews:
        """Return source views for a training image: random other images of its scene.

        Args:
            image: index of the training image.
        """
        dataset = self._training_images()
        scene = None if dataset.scene_indices is None else int(dataset.scene_indices[image])
        others = other_images(dataset, images_of(dataset, scene), dataset.cameras.camera_to_worlds[image])
        return self.encoded(dataset, others[torch.randperm(len(others))[: self.config.num_source_views]])

    def nearest_views(self, view: View) -> SourceViews:
        """Return source views for a `view`: the images of its scene nearest in direction."""
        dataset, pose = self._training_images(), view.camera.camera_to_worlds[0]
        if self.unseen is not None and view.scene is not None and len(images_of(self.unseen, view.scene)):
            dataset = self.unseen
        others = other_images(dataset, images_of(dataset, view.scene), pose)
        if not len(others):
            raise DataError(f"pixel-nerf has no images of scene {view.scene}, and cannot render it")
        return self.encoded(dataset, nearest_in_direction(dataset, others, pose, self.config.num_source_views))

    def encoded(self, dataset: Dataset, images: Tensor) -> SourceViews:
        """Return source views.

        Args:
            dataset: the images.
            images: (V,) indices of the views.
        """
        behind = torch.full((3,), 0.0 if self.config.background == "black" else 1.0, device=dataset.device)
        rgb = [composite(dataset.image(i).float() / 255, behind).permute(2, 0, 1) for i in images.tolist()]
        if len({image.shape for image in rgb}) == 1:
            maps = self.encoder(torch.stack(rgb)).unbind()
        else:
            maps = tuple(self.encoder(image[None])[0] for image in rgb)
        return SourceViews(maps, dataset.cameras[images.to(dataset.device)])

    @contextmanager
    def looking_at(self, views: SourceViews) -> Iterator[None]:
        """Set the field's source views within a `with` block.

        Args:
            views: images of the rendered scene.
        """
        before, self.field.views = self.field.views, views
        try:
            yield
        finally:
            self.field.views = before

    def _training_images(self) -> Dataset:
        if self.learnt is None:
            raise ConfigError("pixel-nerf renders from images and has none: it needs its training data")
        return self.learnt

    def _looking(self) -> AbstractContextManager[None]:
        """Set evenly spread views of the first scene unless views are already set; for exports."""
        if self.field.views is not None:
            return nullcontext()
        images = images_of(self._training_images(), None)
        spread = evenly_spread(len(images), self.config.num_source_views)
        return self.looking_at(self.encoded(self._training_images(), images[spread]))

    # -- learning and rendering -------------------------------------------------------------------------------

    def loss(self, batch: PixelBatch, step: int) -> Loss:
        """Return the loss of pixels of a few images; each image is rendered from others of its scene."""
        assert batch.rays.camera_indices is not None
        images = batch.rays.camera_indices[:: batch.rays_per_pixel]
        num_samples: int | Tensor = 0
        rgb, terms = torch.empty_like(batch.rgb), dict[str, Tensor]()
        for image in images.unique().tolist():
            chosen = images == image
            with self.looking_at(self.drawn_views(image)):
                part = super().loss(batch[chosen], step)
            share = chosen.float().mean()
            terms = {name: share * value + terms.get(name, 0) for name, value in part.terms.items()}
            rgb[chosen], num_samples = part.rgb, num_samples + part.num_samples
        return Loss(terms, rgb, num_samples)

    def render(self, rays: Rays, background: Tensor) -> Rendered:
        with self._looking():
            return super().render(rays, background)

    @torch.no_grad()
    def render_view(self, view: View, background: Tensor) -> Picture:
        with self.looking_at(self.nearest_views(view)):
            return super().render_view(view, background)

    def density(self, points: Points) -> Tensor:
        with self._looking():
            return super().density(points)


def make_field(config: PixelNeRFConfig, scene: Scene) -> PixelAlignedField:
    """Return the conditioned network, which serves as its own coarse level.

    Raises:
        ConfigError: if rays are in normalised device coordinates, where images cannot be looked up.
    """
    if scene.warped:
        raise ConfigError("pixel-nerf does not work in normalised device coordinates: use --ndc False")
    features, unit = sum(config.encoder_widths), half_edge(scene.box)
    sizes = config.hidden_width, BLOCKS_BEFORE, BLOCKS_AFTER, config.position_frequencies
    return PixelAlignedField(features, unit, *sizes)


def sampler(config: PixelNeRFConfig, scene: Scene) -> Sampler:
    """Return a hierarchical sampler with the field itself as its coarse level."""
    return HierarchicalSampler(None, config.num_coarse_samples, config.num_fine_samples)


METHOD = Method(PixelNeRFConfig(), paper="arXiv:2012.02190", field=make_field, sampler=sampler, model=PixelNeRF)
