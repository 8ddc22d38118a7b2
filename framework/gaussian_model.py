"""The model of methods that draw Gaussians: parameters of theirs that grow and move, and pictures of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar, Generic, Literal

import torch
from torch import Tensor, nn

from nerfloom.base.device import HostValue
from nerfloom.base.optimised import Optimised, RowChange
from nerfloom.base.pace import Pace
from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.view import View
from nerfloom.data.scene import Scene
from nerfloom.kernels.splats.project import SplatCamera
from nerfloom.model import Model
from nerfloom.rendering.outputs import NORMALS, Output
from nerfloom.rendering.rendered import Picture
from nerfloom.splats.capacity import Room
from nerfloom.splats.density_control import RESET, GradientMean, grown
from nerfloom.splats.drawing import DRAWN, draw_view, on_image, smallest_depth, splat_camera
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.learning import as_gaussians, as_tables, row_changes, steps_per_move
from nerfloom.splats.look import Look
from nerfloom.splats.mcmc import moved, shaken
from nerfloom.splats.redrawn import Redrawn
from nerfloom.splats.resolution import ImageSizes, most_octaves
from nerfloom.splats.settings import SplattingConfigT
from nerfloom.splats.start import from_points, scene_size
from nerfloom.splats.table import Table

WITHOUT_IMAGES = 1_000
"""Maximum number of Gaussians of a model that has seen no images yet."""


class GaussianModel(Model[SplattingConfigT], Generic[SplattingConfigT]):
    """A model of Gaussians that are drawn onto whole images.

    A method adds its `start` and `loss`, and may change `lit` and `camera`.
    """

    batches: ClassVar[Literal["pixels", "views"]] = "views"
    cameras: ClassVar[tuple[str, ...] | None] = DRAWN
    extent: Tensor
    """Size () of the scene, scene units, in which centres are stored: so their learning rate suits any scene."""

    def __init__(self, config: SplattingConfigT, scene: Scene) -> None:
        super().__init__(config, scene)
        higher, factor = (config.degree + 1) ** 2 - 1, config.rate_factor
        rate = factor * config.learning_rate

        def table(width: int, name: str, times: float, schedule: Literal["constant"] | None = "constant") -> Table:
            return Table(width, Optimised(name, times * rate, schedule=schedule, sparse=True))

        self.position_rate = factor * config.position_rate
        self.means = table(3, "means", self.position_rate / rate, None)
        self.log_scales = table(3, "scales", 1.0)
        self.rotations = table(4, "rotations", 0.2)
        self.logits = table(1, "opacities", 10.0)
        self.colors = table(3, "colors", 0.5)
        self.harmonics = table(3 * higher, "harmonics", 0.025)
        self.register_buffer("extent", torch.tensor(scene_size(scene)))
        self.gradients, self.room = GradientMean(), Room()
        self.near = smallest_depth(scene)
        self._on_image: Tensor | None = None
        self._longer_side = scene.image_size
        self._redrawn: Redrawn | None = None
        self._extent = HostValue()
        most = most_octaves(scene.image_pixels or scene.image_size**2)
        self.sizes = ImageSizes(config.reduced_until, most, config.paced)
        self.steps_per_move, self._first = config.steps_per_move, 0
        anywhere = torch.lerp(scene.box[0], scene.box[1], torch.rand(min(config.start_gaussians, WITHOUT_IMAGES), 3))
        self.set_gaussians(from_points(anywhere, torch.full_like(anywhere, 0.5), config.degree))

    @property
    def runs_on_kernels(self) -> bool:
        return True

    @property
    def uses_bfloat16(self) -> bool:
        return False  # there is no network

    # -- the Gaussians ----------------------------------------------------------------------------------------

    def parameters_of_gaussians(self) -> list[nn.Parameter]:
        """Return the six tables."""
        tables = (self.means, self.log_scales, self.rotations, self.logits, self.colors, self.harmonics)
        return [table.values for table in tables]

    def learnt_gaussians(self) -> Gaussians:
        """Return them, with gradient."""
        return as_gaussians(self.parameters_of_gaussians(), self.extent)

    def gaussians(self) -> Gaussians:
        """Return them, without gradient."""
        return self.learnt_gaussians().map(Tensor.detach)

    def look(self) -> Look:
        """Return how they are drawn."""
        return self.config.look()

    def set_gaussians(self, gaussians: Gaussians) -> None:
        """Replace them.

        Args:
            gaussians: the new ones, with harmonics of the settings' degree.
        """
        for parameter, values in zip(self.parameters_of_gaussians(), as_tables(gaussians, self.extent), strict=True):
            parameter.data = values.contiguous()
        self._redrawn = None

    # -- training ---------------------------------------------------------------------------------------------

    def keep_pace(self, pace: Pace) -> None:
        """Choose the size of the images, and when the number of Gaussians changes, by the time that steps take.

        Args:
            pace: the run before a step.
        """
        config = self.config
        if not config.paced:
            return
        self.sizes.learn(pace)
        steps = self.sizes.steps_until(pace, config.growth_end)
        self._first = self._first or len(self.means.values)
        if steps is not None:
            self.steps_per_move = steps_per_move(pace.step + steps, self._first, config.num_gaussians, config.strategy)

    def before_step(self, step: int, progress: float) -> None:
        self._redrawn = None

    def on_image(self, gaussians: Gaussians, camera: SplatCamera, degree: int) -> Tensor:
        """Return what a training image shows of Gaussians (N, RECORD); growth by gradients looks at its gradient.

        Args:
            gaussians: N Gaussians.
            camera: of the image.
            degree: highest degree of the harmonics that count.
        """
        records = on_image(gaussians, camera, degree)
        if self.config.strategy == "adc" and records.requires_grad:
            records.retain_grad()
            self._on_image, self._longer_side = records, max(camera.width, camera.height)
        return records

    @torch.no_grad()
    def after_every_step(self, step: int, progress: float, finite: bool | Tensor) -> None:
        self.gradients.add(self._on_image, self._longer_side, finite)
        self._on_image = None

    @torch.no_grad()
    def shake(self, size: float | Tensor) -> None:
        """Add noise to the centres of Gaussians that are nearly transparent (3DGS-MCMC, equation 7).

        Args:
            size: the noise of a transparent Gaussian, in its standard deviations squared per extent of the scene;
                possibly () on the device.
        """
        which, by = shaken(self.gaussians(), size * self._extent.of(self.extent))
        self.means.values.data[which] += by / self.extent

    def changes_rows(self, step: int, progress: float) -> bool:
        return step % self.steps_per_move == self.steps_per_move - 1 and progress <= self.config.growth_end

    @torch.no_grad()
    def after_step(self, step: int, progress: float) -> Sequence[RowChange]:
        config = self.config
        if config.strategy == "adc":
            return self._densify(step, config.num_gaussians)
        here = len(self.means.values)
        change = moved(self.gaussians(), max(min(config.num_gaussians, int(1.05 * here)) - here, 0))
        return () if change is None else row_changes(self.parameters_of_gaussians(), *change, self.extent)

    def _densify(self, step: int, most: int) -> list[RowChange]:
        mean = self.gradients.take(len(self.means.values))
        if step % self.config.steps_per_reset == self.config.steps_per_reset - 1:
            lowered = self.logits.values.clamp(max=math.log(RESET / (1 - RESET)))
            none = torch.zeros(0, dtype=torch.long, device=lowered.device)
            return [RowChange(self.logits.values, none, lowered)]  # new rows, as Adam's state is reset too
        change = grown(self.gaussians(), mean, most, self._extent.of(self.extent))
        return [] if change is None else row_changes(self.parameters_of_gaussians(), *change, self.extent)

    def read_counts(self) -> None:
        self.room.read()

    # -- pictures ---------------------------------------------------------------------------------------------

    def lit(self, rgb: Tensor, index: int | None) -> Tensor:
        """Return colours (..., 3) as an image shows them: here as they are.

        Args:
            rgb: (..., 3) drawn colours.
            index: number of a training image; None for the appearance that is set.
        """
        return rgb

    def camera(self, camera: Cameras) -> SplatCamera:
        """Return how a camera that is not trained on sees Gaussians: here as its pose says.

        Args:
            camera: one camera.
        """
        return splat_camera(camera, self.near, self.look())

    @property
    def outputs(self) -> tuple[Output, ...]:
        """Return the normals, the shortest axes of Gaussians (`Picture.extras`)."""
        return (NORMALS,)

    def render_view(self, view: View, background: Tensor) -> Picture:
        return self.render_gaussians(self.gaussians(), view, background)

    def render_gaussians(self, gaussians: Gaussians, view: View, background: Tensor) -> Picture:
        """Render given Gaussians, such as some of its own, as `render_view` does all of them.

        Args:
            gaussians: what is drawn, in the frame of the scene.
            view, background: as in `render_view`.
        """
        picture = draw_view(gaussians, self.camera(view.camera), view.stride, background, self.scene.far)
        return replace(picture, rgb=self.lit(picture.rgb, None))

    def render_rgb(self, view: View, background: Tensor) -> Tensor:
        self._redrawn = self._redrawn or Redrawn(self.gaussians())
        return self.lit(self._redrawn.colors(self.camera(view.camera), view.stride, background), None)
