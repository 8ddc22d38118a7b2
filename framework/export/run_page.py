"""The web page of a run or a file: its own or fitted Gaussians, the page, and its closeness to the method."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean

import torch

from nerfloom.base.atomic import write_atomically
from nerfloom.base.console import say, track
from nerfloom.base.errors import ConfigError, FlagError, printable
from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.view import View
from nerfloom.data.dataset import Dataset
from nerfloom.data.pixels.batch import composite
from nerfloom.evaluation.evaluator import measure, spread, views_to_judge
from nerfloom.evaluation.metrics import psnr
from nerfloom.evaluation.paths import around
from nerfloom.export.splat_fit import fit_gaussians
from nerfloom.export.web import (
    PageFacts,
    camera_rows,
    check_size,
    focus_of,
    gaussians_of,
    make_page,
    pinhole,
    upright,
)
from nerfloom.geometry.regions import Region, inside_all
from nerfloom.method import Method
from nerfloom.renderable import Renderable, RendersRays, with_refined_poses
from nerfloom.scene.folded_poses import in_order
from nerfloom.splats.drawing import DRAWN, draw_colors, smallest_depth, splat_camera
from nerfloom.splats.gaussians import Gaussians, HasGaussians
from nerfloom.splats.look import OURS, Look
from nerfloom.splats.transform import transformed
from nerfloom.training.datasets import first_split
from nerfloom.training.loaded import Loaded

MAX_VIEWS = 5
"""Maximum number of views for comparing a page with the model."""


@dataclass(frozen=True)
class Closeness:
    """Metrics of a page's Gaussians compared with the model, drawn by Nerfloom."""

    views: str
    """The compared views, as text."""
    method: float
    """PSNR against the method's own pictures, dB."""
    photographs: float | None
    """PSNR against the photographs, dB; None if they are of other moments, or have a lens for which Gaussians cannot be
    drawn."""
    method_itself: float | None
    """PSNR of the method's own pictures against the photographs, dB; None likewise."""

    def line(self) -> str:
        """Return the metrics as a line of text."""
        text = f"on {self.views}: PSNR {self.method:.2f} dB against the method's own pictures"
        if self.photographs is None:
            return text
        return f"{text}, {self.photographs:.2f} dB against the photographs (the method: {self.method_itself:.2f} dB)"


def export_page(
    loaded: Loaded,
    path: Path,
    max_megabytes: float,
    fit_seconds: float,
    moment: float | None,
    splatting: Method,
    regions: Sequence[Region] = (),
) -> None:
    """Write the web page of a run, a file of Gaussians or an octree, and say its size and how close it comes.

    Args:
        loaded: the run or file.
        path: file to write.
        max_megabytes: maximum size of the page, in millions of bytes.
        fit_seconds: time for fitting Gaussians to a field, seconds.
        moment: time that the page shows of a scene that moves, 0 to 1; 0 if None.
        splatting: the method that fits them.
        regions: the page shows what is in all of these, in the frame of exports; it is then not compared.

    Raises:
        ConfigError: if the flags do not fit the run, or there is nothing to show.
    """
    check_size(max_megabytes)
    model = loaded.model
    moment = moment_of(model.scene.moving, moment)
    dataset = None if loaded.source is None else _at(loaded.dataset("train"), moment)
    if dataset is None:
        cameras = around(model.scene)
        names = [f"view {number + 1}" for number in range(len(cameras))]
    else:
        cameras, names = pinhole(dataset.cameras), list(dataset.names)
    near = smallest_depth(model.scene)
    found, look = _gaussians(loaded, dataset, cameras, fit_seconds, moment, splatting)
    good = _finite(found)
    good = good[inside_all(loaded.placement.original_points(good.means), regions)]
    turn = upright(cameras)
    order = in_order(names)  # data formats sort 10.jpg before 2.jpg
    red, green, blue = model.background.tolist()
    facts = PageFacts(
        title=_title(loaded),
        about=_about(loaded, moment),
        background=(red, green, blue),
        near=near,
        look=look,
        focus=focus_of(cameras, turn),
        cameras=camera_rows(cameras[torch.tensor(order)], [printable(names[i]) for i in order], turn),
        unit_length=loaded.unit,
        unit=loaded.scale.unit,
        relative_error=loaded.scale.relative_error,
        photographed=dataset is not None,
    )
    text, costs = make_page(transformed(good, turn, 1.0, torch.zeros(3)), facts, max_megabytes)
    for cost in costs:
        say(cost)
    content = text.encode("utf-8", "replace")
    write_atomically(path, lambda file: file.write(content))
    drawn = gaussians_of(text)
    say(f"{len(content) / 1e6:.2f} MB, {len(drawn):,} Gaussians of degree {drawn.degree}: {path}")
    if moment is not None:
        say(f"the scene moves, and the page shows it at time {moment:g}, still")
    if not regions:
        back = transformed(drawn, turn.T, 1.0, torch.zeros(3))
        say(_closeness_to(loaded, back, dataset, cameras, near, look, moment).line())


def _closeness_to(
    loaded: Loaded,
    drawn: Gaussians,
    dataset: Dataset | None,
    cameras: Cameras,
    near: float,
    look: Look,
    moment: float | None,
) -> Closeness:
    """Compare Gaussians in the scene's frame with a run or file, on held-out views if there are any."""
    model = loaded.model
    held_out = None if loaded.source is None else first_split(loaded.source, ("test", "val"))
    views = dataset if held_out is None else _at(with_refined_poses(model, held_out.to(model.device)), moment)
    seen = cameras.to(model.device) if views is None else views.cameras
    return closeness(model, drawn.map(lambda values: values.to(model.device)), seen, views, near, look, moment)


def _gaussians(
    loaded: Loaded, dataset: Dataset | None, cameras: Cameras, seconds: float, moment: float | None, splatting: Method
) -> tuple[Gaussians, Look]:
    """Return the Gaussians of a run or file, or Gaussians fitted to its field, and how they are drawn."""
    model = loaded.model
    if isinstance(model, HasGaussians):
        return model.gaussians(moment), model.look()
    if not isinstance(model, RendersRays) or dataset is None:
        raise ConfigError(f"ns-export web: {loaded.method} has neither Gaussians nor rays, so it cannot be shown")
    if not seconds > 0:
        raise FlagError(f"--fit-seconds is {seconds:g}; it must be positive")
    return fit_gaussians(model, splatting, dataset, cameras, seconds, loaded.run.config.machine), OURS


def _finite(found: Gaussians) -> Gaussians:
    """Return the finite Gaussians, on the CPU, and report the number of others."""
    found = found.map(lambda values: values.detach().cpu())
    good = found[found.finite()]
    if len(good) < len(found):
        say(f"{len(found) - len(good):,} of {len(found):,} Gaussians are not finite and are dropped")
    if not len(good):
        raise ConfigError("there are no Gaussians to show; train the run again")
    return good


def closeness(
    model: Renderable,
    gaussians: Gaussians,
    cameras: Cameras,
    dataset: Dataset | None,
    near: float,
    look: Look,
    moment: float | None,
) -> Closeness:
    """Compare Gaussians with the model that they represent.

    Args:
        model: the model.
        gaussians: N Gaussians in the scene's frame, on the model's device.
        cameras: M cameras to compare from.
        dataset: their images, on the model's device; None without any.
        near: Gaussians whose centre has a smaller depth are not drawn, scene units.
        look: how the Gaussians are drawn.
        moment: time of the views; None for a static scene.
    """
    background = model.background
    judged = (views_to_judge(dataset) if dataset else []) or list(range(len(cameras)))
    chosen = [judged[rank] for rank in spread(len(judged), MAX_VIEWS)]
    as_seen = cameras.model in DRAWN
    cameras = cameras if as_seen else pinhole(cameras)
    own: list[float] = []
    photographs: list[tuple[float, float]] = []
    for index in track(chosen, "Comparing", total=len(chosen)):
        view = View.of(cameras, index, None if dataset is None else dataset.times)
        rgb = model.render_rgb(view, background).clamp(0, 1).float()
        with torch.no_grad():
            shown = draw_colors(gaussians, splat_camera(view.camera, near, look), 1, background).clamp(0, 1)
        own.append(psnr(shown, rgb))
        if dataset is not None and as_seen and moment is None:
            target = composite(dataset.image(index).float() / 255, background)
            kept = dataset.kept_of(index)
            photographs.append((measure(shown, target, kept).psnr, measure(rgb, target, kept).psnr))
    views = f"{len(chosen)} {'views around it' if dataset is None else 'of the held-out views'}"
    if not photographs:
        return Closeness(views, fmean(own), None, None)
    page, method = zip(*photographs, strict=True)
    return Closeness(views, fmean(own), fmean(page), fmean(method))


def moment_of(moving: bool, asked: float | None) -> float | None:
    """Return the time that an export shows; None of a static scene.

    Args:
        moving: whether the photographs have times.
        asked: the time that was asked for.

    Raises:
        ConfigError: if a static scene was asked for a time.
        FlagError: if the time is not from 0 to 1.
    """
    if asked is not None and not moving:
        raise ConfigError(f"--time {asked:g}: the photographs of this run have no times")
    if asked is not None and not 0 <= asked <= 1:
        raise FlagError(f"--time is {asked:g}; it must be from 0 to 1")
    return (asked or 0.0) if moving else None


def _at(dataset: Dataset, moment: float | None) -> Dataset:
    """Return a data set whose images are all taken at one moment."""
    return dataset if moment is None else replace(dataset, times=torch.full((len(dataset),), moment).to(dataset.device))


def _title(loaded: Loaded) -> str:
    if not loaded.is_run:
        return printable(loaded.origin.stem)
    config = loaded.run.config
    experiment = config.experiment_name or (config.data.resolve().name if config.data else "procedural")
    return printable(f"{experiment} · {loaded.method}")


def _about(loaded: Loaded, moment: float | None) -> str:
    method = loaded.method
    made = f"with {method}" if loaded.is_run else f"from {printable(loaded.origin.name)}"
    parts = [f"Made by Nerfloom {made}."]
    if not isinstance(loaded.model, HasGaussians):
        parts.append(f"The Gaussians shown here are fitted to pictures of {method}'s field.")
    if moment is not None:
        parts.append(f"The scene moves; this is time {moment:g}.")
    return " ".join([*parts, "The page works offline and requests nothing from any host."])
