"""The model of methods that train and draw Gaussians."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import ClassVar, Generic, Literal

import torch
from torch import Tensor

from nerfloom.base.device import HostValue, device_kind
from nerfloom.base.errors import ConfigError
from nerfloom.base.optimised import RowChange
from nerfloom.base.pace import Pace
from nerfloom.base.processes import processes
from nerfloom.base.user_cache import cache_folder
from nerfloom.cameras.view import View, every
from nerfloom.data.scene import Scene
from nerfloom.kernels.dispatch import CPP
from nerfloom.kernels.mapped_tables import MappedTables
from nerfloom.kernels.splats.blend import Blended
from nerfloom.kernels.splats.project import SplatCamera
from nerfloom.levels.on_image import tangents
from nerfloom.levels.rows_in_view import RowsInView
from nerfloom.losses.depth_distortion import image_distortion
from nerfloom.losses.depth_normals import normal_error
from nerfloom.model import Model
from nerfloom.rendering.light import make_light
from nerfloom.splats.capacity import Capacity
from nerfloom.splats.density_control import DensityControl
from nerfloom.splats.drawing import ray_directions, smallest_depth
from nerfloom.splats.drawn import DrawsGaussians
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.learning import steps_per_move
from nerfloom.splats.look import Look
from nerfloom.splats.mcmc import Mcmc, faint, noise
from nerfloom.splats.moments import with_moments
from nerfloom.splats.normals import with_normals
from nerfloom.splats.rasteriser import Projected, along_curve
from nerfloom.splats.relocation import Relocation
from nerfloom.splats.resolution import ImageSizes, most_octaves
from nerfloom.splats.settings import SplattingConfig, SplattingConfigT
from nerfloom.splats.start import from_points, scene_size
from nerfloom.splats.strategy import Rows, Strategy
from nerfloom.splats.table import Column, as_gaussians, as_rows, row_changes, usual_columns

MAX_NEW_GAUSSIANS = 1_000
"""Maximum number of Gaussians in a new model."""
NORMALS_FROM = 7 / 30
"""Share of the budget before normals count: 7,000 of 30,000 steps in the code of 2D Gaussian Splatting."""
DISTORTION_FROM = 1 / 10
"""Share of the budget before the distortion counts: 3,000 of 30,000 steps there."""
STRATEGIES: dict[str, Callable[[SplattingConfig], Strategy]] = {
    "adc": lambda config: DensityControl(config.steps_per_reset),
    "mcmc": lambda config: Mcmc(),
    "relocation": lambda config: Relocation(),
}
"""Strategies by their name in the setting `strategy`."""


class GaussianModel(DrawsGaussians, Model[SplattingConfigT], Generic[SplattingConfigT]):
    """A model of Gaussians that are drawn onto whole images.

    A method implements `start` and `loss`. It may override the colours of images (`lit`), the parameters of Gaussians
    (`declared_columns`), their motion (`at_time`), the strategy (`make_strategy`) and the rasteriser (`rasteriser`).
    """

    batches: ClassVar[Literal["pixels", "views"]] = "views"
    resizes: ClassVar[bool] = True
    extent: Tensor
    """Size () of the scene, scene units. Centres are stored relative to it, so that their learning rate suits any
    scene."""

    def __init__(self, config: SplattingConfigT, scene: Scene) -> None:
        super().__init__(config, scene)
        self.position_rate = config.rate_factor * config.position_rate
        self.columns = self.declared_columns()
        self.rows_in_view: RowsInView | None = None
        """The Gaussians that images may show, with a memory limit; None without."""
        self.seen: Rows | None = None
        """The Gaussians of the last training image, with a memory limit; None for all."""
        if config.memory_limit is not None:
            check_limit(config, scene)
            self.tables = MappedTables(config.cache_dir or cache_folder())
            self.rows_in_view = RowsInView(self.tables, 1e6 * config.memory_limit)
        for name, column in self.columns.items():
            self.add_module(name, column)
            if self.rows_in_view is not None:
                column.keep_in(self.tables)
        self.register_buffer("extent", torch.tensor(scene_size(scene)))
        self.strategy, self.capacity = self.make_strategy(), Capacity()
        self.light = make_light(config, scene)
        self.near = smallest_depth(scene)
        self._extent = HostValue()
        most = most_octaves(scene.image_pixels or scene.image_size**2)
        self.sizes = ImageSizes(config.reduced_until, most, config.paced)
        self.steps_per_move, self._first = config.steps_per_move, 0
        self._last_change: int | None = None
        anywhere = torch.lerp(scene.box[0], scene.box[1], torch.rand(min(config.start_gaussians, MAX_NEW_GAUSSIANS), 3))
        self.set_gaussians(from_points(anywhere, torch.full_like(anywhere, 0.5), config.degree))

    @property
    def runs_on_kernels(self) -> bool:
        return True

    @property
    def uses_bfloat16(self) -> bool:
        return False  # there is no network

    def lit(self, rgb: Tensor, transmittance: Tensor, background: Tensor, index: int | None) -> Tensor:
        if self.light is None:
            return rgb
        which = None if index is None else torch.arange(index, index + 1, device=rgb.device)
        return self.light.lit(rgb, 1 - transmittance, background, which)

    # -- the Gaussians ----------------------------------------------------------------------------------------

    def declared_columns(self) -> dict[str, Column]:
        """Return the parameters of Gaussians by name, each with its shape, learning rate and schedule.

        A method may add columns. They grow, move and are saved like the others.
        """
        config = self.config
        return usual_columns(config.degree, config.rate_factor * config.learning_rate, self.position_rate)

    def make_strategy(self) -> Strategy:
        """Return the strategy, by default the one of the setting `strategy`."""
        return STRATEGIES[self.config.strategy](self.config)

    def at_time(self, gaussians: Gaussians, time: float | None) -> Gaussians:
        """Return the Gaussians at a time, with gradient; by default `gaussians`.

        Args:
            gaussians: N Gaussians at rest, with all columns.
            time: in [0, 1]; None for a still scene.
        """
        return gaussians

    def at_rest(self, rows: Tensor | None = None) -> Gaussians:
        """Return the Gaussians of the columns, with gradient.

        Args:
            rows: (K,) int64 the Gaussians to return, each at most once; None for all.
        """
        return as_gaussians(self.columns, self.extent, rows)

    def learnt_gaussians(self, time: float | None = None) -> Gaussians:
        """Return the Gaussians at a time, with gradient.

        Args:
            time: in [0, 1]; None for a still scene.
        """
        return self.at_time(self.at_rest(), time)

    def seen_gaussians(self, view: View, camera: SplatCamera) -> Gaussians:
        """Return the Gaussians that a training image may show, at its time and with gradient: all without a limit.

        With `--memory-limit` these are the Gaussians of the chunks that the image may show. A step leaves the rows of
        others alone.

        Args:
            view: the training image.
            camera: its camera, as it is drawn.
        """
        rows = self._rows_of(view, camera, learns=True)
        self.seen = None if rows is None else Rows(rows, len(self.columns["means"].values))
        return self.at_time(self.at_rest(rows), view.time)

    @property
    def share_seen(self) -> float:
        """Share of all Gaussians that `seen_gaussians` returned last.

        It is a factor of means over Gaussians in a loss. So the gradient of a Gaussian does not depend on the number of
        others in view.
        """
        return 1.0 if self.seen is None else len(self.seen.indices) / max(self.seen.total, 1)

    def gaussians(self, time: float | None = None) -> Gaussians:
        return self.learnt_gaussians(time).map(Tensor.detach)

    def look(self) -> Look:
        return self.config.look()

    def set_gaussians(self, gaussians: Gaussians) -> None:
        """Replace the Gaussians.

        Args:
            gaussians: the new ones at rest, with harmonics of the settings' degree. A column that they lack is 0.
        """
        if self.rows_in_view is not None:
            self.rows_in_view.forget()
            gaussians = gaussians[along_curve(gaussians.means)] if len(gaussians) else gaussians
        for name, rows in as_rows(self.columns, gaussians, self.extent).items():
            self.columns[name].set(rows.contiguous())
        self._prepared = None

    # -- pictures ---------------------------------------------------------------------------------------------

    def gaussians_in(self, view: View) -> Gaussians:
        if self.rows_in_view is None:
            return super().gaussians_in(view)
        with torch.no_grad():
            return self.at_time(self.at_rest(self._rows_of(view, self._camera(view), learns=False)), view.time)

    def render_rgb(self, view: View, background: Tensor) -> Tensor:
        if self.rows_in_view is None:
            return super().render_rgb(view, background)
        gaussians, camera = self.gaussians_in(view), self._camera(view)
        drawn = self.rasteriser.draw(self.rasteriser.project(gaussians, camera), camera, background)
        rgb, transmittance = every(drawn.image, view.stride), every(drawn.transmittance, view.stride)
        return self.lit(rgb, transmittance, background, None)

    def _rows_of(self, view: View, camera: SplatCamera, learns: bool) -> Tensor | None:
        """Return the rows of the Gaussians that a view may show, with a memory limit; None for all."""
        if self.rows_in_view is None:
            return None
        with torch.no_grad():
            reduced = view.camera.sizes[0][0] / camera.height
            directions = tangents(view.camera, camera.blur * reduced**2)
        return self.rows_in_view.of(self.columns, self.extent, camera, directions, learns)

    # -- training ---------------------------------------------------------------------------------------------

    def keep_pace(self, pace: Pace) -> None:
        """Choose the size of images and the steps between changes from measured step times.

        Args:
            pace: the run before a step.
        """
        config = self.config
        if not config.paced:
            return
        self.sizes.learn(pace)
        steps = self.sizes.steps_until(pace, config.growth_end)
        self._first = self._first or len(self.columns["means"].values)
        if steps is not None:
            per_doubling = self.strategy.changes_per_doubling
            self.steps_per_move = steps_per_move(pace.step + steps, self._first, config.num_gaussians, per_doubling)

    def before_step(self, step: int, progress: float) -> None:
        self._prepared = None

    def on_image(self, gaussians: Gaussians, camera: SplatCamera, degree: int) -> Projected:
        """Project Gaussians to a training image and show them to the strategy.

        Args:
            gaussians: the result of `seen_gaussians`, in its order; without a memory limit, all N Gaussians.
            camera: of the image.
            degree: highest degree of the harmonics that count.
        """
        shown = self.rasteriser.project(gaussians, camera, degree)
        self.strategy.watch(shown.records, camera, self.seen)
        return shown

    def aligns_normals(self, progress: float) -> bool:
        """Return whether `surface_terms` compares normals with drawn distances at a point of the run.

        Args:
            progress: share of the budget that is spent.
        """
        return self.config.normal_loss_mult > 0 and progress >= NORMALS_FROM

    def surface_terms(
        self,
        gaussians: Gaussians,
        shown: Projected,
        camera: SplatCamera,
        drawn: Blended,
        kept: Tensor | None,
        progress: float,
    ) -> dict[str, Tensor]:
        """Return the terms of a loss that make Gaussians flat and gather them on surfaces, with their weights.

        Args:
            gaussians: N Gaussians, with gradient.
            shown: these Gaussians on an image.
            camera: camera of the image.
            drawn: the image, with distances if `aligns_normals`.
            kept: (H, W) bool, pixels that count; None for all.
            progress: share of the budget that is spent.
        """
        config, terms = self.config, dict[str, Tensor]()
        if config.flatness_penalty > 0 and len(gaussians):
            # As in PGSR (Chen et al. 2024). One of several equal scales gets the gradient, so round Gaussians flatten.
            smallest = gaussians.log_scales.min(-1).values.exp()
            terms["flatness"] = self.share_seen * config.flatness_penalty / self.extent * smallest.mean()
        if self.aligns_normals(progress):
            black, colored = torch.zeros(3, device=self.device), with_normals(shown, gaussians, camera)
            normals = self.rasteriser.draw(colored, camera, black, capacity=self.capacity).image
            rays = ray_directions(camera)
            error = normal_error(normals, drawn.image[..., 3], drawn.transmittance, rays, kept)
            terms["normals"] = config.normal_loss_mult * error
        if config.distortion_loss_mult > 0 and progress >= DISTORTION_FROM:
            black = torch.zeros(3, device=self.device)
            spread = self.rasteriser.draw(with_moments(shown, self.extent), camera, black, capacity=self.capacity)
            error = image_distortion(spread.image[..., :2], spread.transmittance, kept)
            terms["distortion"] = config.distortion_loss_mult * error
        return terms

    def after_every_step(self, step: int, progress: float, finite: bool | Tensor) -> None:
        self.strategy.after_every_step(finite)

    @torch.no_grad()
    def shake(self, size: float | Tensor) -> None:
        """Add noise to the centres of Gaussians that are nearly transparent (3DGS-MCMC, equation 7).

        With a memory limit, only Gaussians that the last training image may show get noise.

        Args:
            size: the noise of a transparent Gaussian, in its standard deviations squared per extent of the scene;
                possibly () on the device.
        """
        logits = self.columns["logits"].values.detach()[:, 0]
        which = faint(logits if self.seen is None else logits[self.seen.indices])
        if self.seen is not None and which is not None:
            which = self.seen.indices[which]
        by = noise(self.at_rest(which), size * self._extent.of(self.extent))
        self.columns["means"].values.data[slice(None) if which is None else which] += by / self.extent

    def changes_rows(self, step: int, progress: float) -> bool:
        if self._last_change is None:  # a run that goes on has the same steps as one that was not stopped
            self._last_change = step // self.steps_per_move * self.steps_per_move - 1
        return step - self._last_change >= self.steps_per_move and progress <= self.config.growth_end

    @torch.no_grad()
    def after_step(self, step: int, progress: float) -> Sequence[RowChange]:
        self._last_change = step
        if self.rows_in_view is not None:
            self.rows_in_view.forget()
        self.tables.release()  # all Gaussians are read now
        gaussians = self.at_rest()
        if values := self.strategy.reset(gaussians, step):
            none = torch.zeros(0, dtype=torch.long, device=self.device)  # new rows, which resets Adam's state
            columns = {name: self.columns[name] for name in values}
            return [RowChange(c.values, none, c.rows(values[name], self.extent)) for name, c in columns.items()]
        logits = gaussians.logits.masked_fill(self.in_the_way(gaussians.means), -math.inf)
        gaussians = replace(gaussians, logits=logits)
        change = self.strategy.grow(gaussians, self.config.num_gaussians, self._extent.of(self.extent))
        if change is None:
            return ()
        order = None
        if self.rows_in_view is not None and len(change.kept) + len(change.fresh):
            order = along_curve(torch.cat([gaussians.means[change.kept], change.fresh.means]))
        return row_changes(self.columns, *change, self.extent, order)

    def in_the_way(self, means: Tensor) -> Tensor:
        """Return which Gaussians (N,) bool are where nothing can be; none by default.

        The strategy sees them as transparent, at each change of the number of Gaussians.

        Args:
            means: (N, 3) centres, scene coordinates.
        """
        return torch.zeros(len(means), dtype=torch.bool, device=means.device)

    def read_counts(self) -> None:
        self.capacity.read()


def check_limit(config: SplattingConfig, scene: Scene) -> None:
    """Check that a memory limit can be kept.

    Args:
        config: the settings, with a limit.
        scene: facts about the data.

    Raises:
        ConfigError: if it cannot.
    """
    reason = None
    if device_kind(config.machine) != "cpu":
        reason = "is for the CPU, not for a GPU; give --machine.device-type cpu"
    elif not CPP.available():
        reason = "needs the compiled kernels; install a C++ compiler, and install the package again"
    elif processes().count > 1:
        reason = "is for one process; start one"
    elif scene.moving:
        reason = "is for scenes that do not move; reduce --num-gaussians"
    if reason is not None:
        raise ConfigError(f"--memory-limit {reason}, or leave it out")
