"""The web page of a run or a file: its own or fitted Gaussians, the page, and its closeness to the method."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean

import torch
from torch import Tensor

from nerfloom.base.atomic import write_atomically
from nerfloom.base.console import say, track
from nerfloom.base.errors import ConfigError, FlagError, nearest, printable, shown
from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.framing import framed
from nerfloom.cameras.view import View
from nerfloom.data.dataset import Dataset
from nerfloom.data.pixels.batch import composite
from nerfloom.evaluation.evaluator import measure, spread, views_to_judge
from nerfloom.evaluation.images import to_uint8
from nerfloom.evaluation.metrics import psnr
from nerfloom.evaluation.paths import around
from nerfloom.evaluation.videos import write_images
from nerfloom.export.settings import WebSettings
from nerfloom.export.splat_fit import fit_gaussians
from nerfloom.export.web import (
    PICTURE,
    PageFacts,
    camera_rows,
    check_size,
    focus_of,
    gaussians_of,
    make_page,
    pinhole,
    shown_cameras,
    upright,
)
from nerfloom.geometry.regions import Region, inside_all
from nerfloom.kernels.splats.project import SplatCamera
from nerfloom.method import Method
from nerfloom.renderable import Renderable, RendersRays, with_refined_poses
from nerfloom.scene.folded_poses import in_order
from nerfloom.splats.drawing import DRAWN, draw_colors, smallest_depth, splat_camera
from nerfloom.splats.gaussians import Gaussians, HasGaussians
from nerfloom.splats.look import OURS, Look
from nerfloom.splats.transform import transformed
from nerfloom.training.datasets import first_split
from nerfloom.training.loaded import Loaded

PICTURE_SUFFIX = ".jpg"
"""Suffix of the picture of link previews, beside the page."""
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
    loaded: Loaded, path: Path, settings: WebSettings, splatting: Method, regions: Sequence[Region] = ()
) -> None:
    """Write the web page of a run, a file of Gaussians or an octree, and say its size and how close it comes.

    A JPEG file of the start view, for link previews, is written beside it.

    Args:
        loaded: the run or file.
        path: file to write.
        settings: settings of the page.
        splatting: the method that fits Gaussians to a field.
        regions: the page shows what is in all of these, in the frame of exports; it is then not compared.

    Raises:
        ConfigError: if the settings do not fit the run, or there is nothing to show.
    """
    check_size(settings.max_megabytes)
    check_url(settings.url)
    model = loaded.model
    moment = moment_of(model.scene.moving, settings.time)
    dataset = None if loaded.source is None else _at(loaded.dataset("train"), moment)
    cameras, names = _cameras(model, dataset)
    order = in_order(names)  # data formats sort 10.jpg before 2.jpg
    start = start_of([names[index] for index in order], settings.start_view)
    ranks = shown_cameras(len(order), start)
    chosen = torch.tensor([order[rank] for rank in ranks])
    near = smallest_depth(model.scene)
    found, look = _gaussians(loaded, dataset, cameras, settings.fit_seconds, moment, splatting)
    good = _finite(found)
    good = good[inside_all(loaded.placement.original_points(good.means), regions)]
    turn = upright(cameras)
    red, green, blue = model.background.tolist()
    facts = PageFacts(
        title=_title(loaded) if settings.title is None else printable(settings.title),
        about=_about(loaded, moment),
        background=(red, green, blue),
        near=near,
        look=look,
        focus=focus_of(cameras, turn),
        cameras=camera_rows(cameras[chosen], [printable(names[i]) for i in chosen.tolist()], turn),
        unit_length=loaded.unit,
        unit=loaded.scale.unit,
        relative_error=loaded.scale.relative_error,
        photographed=dataset is not None,
        start=ranks.index(start),
        url=settings.url or "",
        picture=path.with_suffix(PICTURE_SUFFIX).name,
    )
    text, costs = make_page(transformed(good, turn, 1.0, torch.zeros(3)), facts, settings.max_megabytes)
    for cost in costs:
        say(cost)
    content = text.encode("utf-8", "replace")
    write_atomically(path, lambda file: file.write(content))
    drawn = gaussians_of(text)
    say(f"{len(content) / 1e6:.2f} MB, {len(drawn):,} Gaussians of degree {drawn.degree}: {path}")
    if moment is not None:
        say(f"the scene moves, and the page shows it at time {moment:g}, still")
    back = transformed(drawn, turn.T, 1.0, torch.zeros(3)).map(lambda values: values.to(model.device))
    camera = framed(cameras[order[start] : order[start] + 1], *PICTURE).to(model.device)
    _write_picture(path.with_suffix(PICTURE_SUFFIX), back, splat_camera(camera, near, look), model.background)
    if not regions:
        say(_closeness_to(loaded, back, dataset, cameras, near, look, moment).line())


def _cameras(model: Renderable, dataset: Dataset | None) -> tuple[Cameras, list[str]]:
    """Return the cameras of a page and their names: those of the photographs, or some around a scene without."""
    if dataset is None:
        cameras = around(model.scene)
        return cameras, [f"view {number + 1}" for number in range(len(cameras))]
    return pinhole(dataset.cameras), list(dataset.names)


def _write_picture(path: Path, gaussians: Gaussians, camera: SplatCamera, background: Tensor) -> None:
    """Write the picture of link previews."""
    with torch.no_grad():
        picture = draw_colors(gaussians, camera, 1, background)
    write_images([path], [to_uint8(picture)])


def start_of(names: Sequence[str], wanted: str | None) -> int:
    """Return the number of the camera `wanted` in `names`, with or without folder and ending; 0 for None.

    Raises:
        ConfigError: if no camera or several have the name.
    """
    if wanted is None:
        return 0
    found = [index for index, name in enumerate(names) if wanted in (name, Path(name).name, Path(name).stem)]
    if len(found) != 1:
        how_many = f"{len(found)} training images have" if found else "no training image has"
        raise ConfigError(f"--start-view {wanted}: {how_many} this name. {nearest(wanted, names)}")
    return found[0]


def check_url(url: str | None) -> None:
    """Check that `url` is the address of a web page, or None.

    Raises:
        FlagError: with what an address begins with.
    """
    if url is not None and not url.startswith(("https://", "http://")):
        raise FlagError(f"--url is {shown(url)}; it must begin with https:// or http://")


def _closeness_to(
    loaded: Loaded,
    drawn: Gaussians,
    dataset: Dataset | None,
    cameras: Cameras,
    near: float,
    look: Look,
    moment: float | None,
) -> Closeness:
    """Compare Gaussians in the scene's frame, on the model's device, on held-out views if there are any."""
    model = loaded.model
    held_out = None if loaded.source is None else first_split(loaded.source, ("test", "val"))
    views = dataset if held_out is None else _at(with_refined_poses(model, held_out.to(model.device)), moment)
    seen = cameras.to(model.device) if views is None else views.cameras
    return closeness(model, drawn, seen, views, near, look, moment)


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
    kind = "views around it" if dataset is None else f"{'training' if dataset.training else 'held-out'} views"
    views = f"{len(chosen)} {kind}"
    if not photographs:
        return Closeness(views, fmean(own), None, None)
    page, method = zip(*photographs, strict=True)
    return Closeness(views, fmean(own), fmean(page), fmean(method))


def moment_of(moving: bool, asked: float | None) -> float | None:
    """Return the time `asked` for, of photographs that have times if `moving`; None of a static scene.

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
