"""The web page of a run or a file: its own Gaussians or octree, or fitted ones, and its closeness to the method."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch

from nerfloom.base.atomic import write_atomically
from nerfloom.base.console import say
from nerfloom.base.errors import ConfigError, FlagError, nearest, printable, shown
from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.framing import framed
from nerfloom.data.dataset import Dataset
from nerfloom.evaluation.images import to_uint8
from nerfloom.evaluation.paths import outlooks
from nerfloom.evaluation.videos import write_images
from nerfloom.export.bake import Baking, bake
from nerfloom.export.levels_page import levels_page, remove_other_chunks
from nerfloom.export.page_closeness import closeness
from nerfloom.export.page_scenes import BEYOND_THE_BOX, ScenePage, gaussian_page, octree_page
from nerfloom.export.run_gaussians import moment_of
from nerfloom.export.settings import WebSettings
from nerfloom.export.splat_fit import fit_gaussians
from nerfloom.export.web import (
    PICTURE,
    PageFacts,
    camera_rows,
    check_size,
    focus_of,
    held_upright,
    pinhole,
    room,
    shown_cameras,
    turning_arc,
    upright,
    with_still,
)
from nerfloom.geometry.regions import Region
from nerfloom.levels.drawn import DrawnLevels
from nerfloom.octrees.drawn import DrawnOctree, DrawsOctree
from nerfloom.octrees.files import MAX_BYTES
from nerfloom.octrees.octree import Octree
from nerfloom.registry import load_method
from nerfloom.renderable import Renderable, RendersRays, with_refined_poses
from nerfloom.scene.folded_poses import in_order
from nerfloom.splats.drawing import smallest_depth
from nerfloom.splats.gaussians import Gaussians, HasGaussians
from nerfloom.splats.look import OURS, Look
from nerfloom.training.datasets import first_split
from nerfloom.training.loaded import Loaded
from nerfloom.training.run_path import data_name

PICTURE_SUFFIX = ".jpg"
"""Suffix of the picture of link previews, beside the page."""


def export_page(loaded: Loaded, path: Path, settings: WebSettings, regions: Sequence[Region] = ()) -> None:
    """Write the web page of a run, a file of Gaussians or an octree, and say its size and how close it comes.

    A JPEG file of the start view, for link previews, is written beside it, and of levels the folder of chunks.

    Args:
        loaded: the run or file.
        path: file to write.
        settings: settings of the page.
        regions: the page shows their intersection, in the frame of exports; it is then not compared.

    Raises:
        ConfigError: if the settings do not fit the run, or there is nothing to show.
    """
    model, kind = loaded.model, settings.kind or kind_of(loaded.model)
    _check(settings, kind, model, regions)
    moment = moment_of(model.scene.moving, settings.time)
    dataset = None if loaded.source is None else _at(loaded.dataset("train"), moment)
    cameras, names = _cameras(model, dataset)
    order = in_order(names)  # data formats sort 10.jpg before 2.jpg
    start = start_of([names[index] for index in order], settings.start_view)
    ranks = shown_cameras(len(order), start)
    chosen = torch.tensor([order[rank] for rank in ranks])
    turn = upright(cameras, model.scene.z_is_up)
    red, green, blue = model.background.tolist()
    focus = focus_of(cameras, turn)
    is_capture = model.scene.unbounded and (dataset is not None or model.scene.camera_to_worlds is not None)
    facts = PageFacts(
        title=_title(loaded) if settings.title is None else printable(settings.title),
        about=_about(loaded, kind, moment),
        background=(red, green, blue),
        near=smallest_depth(model.scene),
        look=None,
        focus=focus,
        cameras=camera_rows(cameras[chosen], [printable(names[i]) for i in chosen.tolist()], turn),
        unit_length=loaded.unit,
        unit=loaded.scale.unit,
        relative_error=loaded.scale.relative_error,
        arc=turning_arc(cameras, focus, turn) if is_capture else None,
        photographed=dataset is not None,
        start=ranks.index(start),
        url=settings.url or "",
        picture=path.with_suffix(PICTURE_SUFFIX).name,
    )
    if kind == "levels":
        page = levels_page(loaded, path, facts, turn)
    elif kind == "octree":
        octree = _octree(loaded, settings.fit_seconds, room(facts, settings.max_megabytes))
        page = octree_page(loaded, octree, cameras, facts, turn, settings.max_megabytes, regions)
    else:
        found, look = _gaussians(loaded, dataset, cameras, settings.fit_seconds, moment)
        page = gaussian_page(loaded, found, look, facts, turn, settings.max_megabytes, regions)
    for cost in page.costs:
        say(cost)
    camera = framed(cameras[order[start] : order[start] + 1], *PICTURE).to(model.device)
    with torch.no_grad():
        picture = to_uint8(page.draw(camera))
    write_images([path.with_suffix(PICTURE_SUFFIX)], [picture])
    content = with_still(page.text, picture, settings.max_megabytes).encode("utf-8", "replace")
    _write(path, page, content)
    say(f"{len(content) / 1e6:.2f} MB, {page.words}: {path}")
    if moment is not None:
        say(f"the scene moves, and the page shows it at time {moment:g}, still")
    if not regions and kind != "levels":
        _say_closeness(loaded, page, dataset, cameras, moment)


def _write(path: Path, page: ScenePage, content: bytes) -> None:
    """Write a page and, if it has chunks of its own, remove those of earlier pages."""
    write_atomically(path, lambda file: file.write(content))
    if page.chunks:
        remove_other_chunks(path, page)


def kind_of(model: Renderable) -> str:
    """Return the kind of the page of `model` if no setting says it, a key of `SCRIPTS`."""
    if isinstance(model, DrawnLevels):
        return "levels"
    return "octree" if isinstance(model, DrawsOctree) else "gaussians"


def _check(settings: WebSettings, kind: str, model: Renderable, regions: Sequence[Region]) -> None:
    """Raise ConfigError if settings do not fit a page of a kind."""
    check_size(settings.max_megabytes)
    check_url(settings.url)
    if isinstance(model, DrawnLevels) and kind != "levels":
        raise ConfigError(f"--kind {kind}: a file of levels is shown as levels; leave it out")
    if kind == "levels" and regions:
        raise ConfigError("a page of levels shows all of them: crop what ns-export levels writes, by the same flags")


def _cameras(model: Renderable, dataset: Dataset | None) -> tuple[Cameras, list[str]]:
    """Return the cameras of a page, held upright, and their names: of the photographs, or of a scene without."""
    if dataset is None:
        cameras = outlooks(model.scene)
        names = [f"view {number + 1}" for number in range(len(cameras))]
    else:
        cameras, names = pinhole(dataset.cameras), list(dataset.names)
    return held_upright(cameras) if model.scene.z_is_up else cameras, names


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
        FlagError: with the beginnings of valid addresses.
    """
    if url is not None and not url.startswith(("https://", "http://")):
        raise FlagError(f"--url is {shown(url)}; it must begin with https:// or http://")


def _say_closeness(
    loaded: Loaded, page: ScenePage, dataset: Dataset | None, cameras: Cameras, moment: float | None
) -> None:
    """Compare a page with the model, on held-out views if there are any."""
    model = loaded.model
    held_out = None if loaded.source is None else first_split(loaded.source, ("test", "val"))
    views = dataset if held_out is None else _at(with_refined_poses(model, held_out.to(model.device)), moment)
    seen = cameras.to(model.device) if views is None else views.cameras
    say(closeness(model, page, seen, views, moment).line())


def _gaussians(
    loaded: Loaded, dataset: Dataset | None, cameras: Cameras, seconds: float, moment: float | None
) -> tuple[Gaussians, Look]:
    """Return the Gaussians of a run or file, or Gaussians fitted to its field, and how they are drawn."""
    model = loaded.model
    if isinstance(model, HasGaussians):
        return model.gaussians(moment), model.look()
    if not isinstance(model, RendersRays):
        raise ConfigError(f"ns-export web: {loaded.method} has neither Gaussians nor rays, so it cannot be shown")
    if dataset is None:
        raise ConfigError("--kind gaussians: they are fitted at the cameras of photographs: give --data DIR")
    _check_seconds(seconds)
    splatting, machine = load_method("gaussian-splatting"), loaded.run.config.machine
    return fit_gaussians(model, splatting, dataset, cameras, seconds, machine), OURS


def _octree(loaded: Loaded, seconds: float, max_bytes: float) -> Octree:
    """Return a model's own octree, of any size, or the octree of a field, which is baked; on the CPU."""
    model = loaded.model
    if isinstance(model, DrawnOctree):
        return model.octree.to("cpu")
    if isinstance(model, DrawsOctree):
        return bake(loaded, Baking(max_bytes=MAX_BYTES))  # the page makes it as small as asked
    _check_seconds(seconds)
    if model.scene.unbounded:
        raise ConfigError(BEYOND_THE_BOX)
    return bake(loaded, Baking(max_bytes=max_bytes, seconds=seconds))


def _check_seconds(seconds: float) -> None:
    if not seconds > 0:
        raise FlagError(f"--fit-seconds is {seconds:g}; it must be positive")


def _at(dataset: Dataset, moment: float | None) -> Dataset:
    """Return a data set with the images of one moment."""
    return dataset if moment is None else replace(dataset, times=torch.full((len(dataset),), moment).to(dataset.device))


def _title(loaded: Loaded) -> str:
    if not loaded.is_run:
        return printable(loaded.origin.stem)
    config = loaded.run.config
    experiment = config.experiment_name or data_name(config.data)
    return printable(f"{experiment} · {loaded.method}")


def _about(loaded: Loaded, kind: str, moment: float | None) -> str:
    method, model = loaded.method, loaded.model
    made = f"with {method}" if loaded.is_run else f"from {printable(loaded.origin.name)}"
    parts = [f"Made by Nerfloom {made}."]
    if kind == "gaussians" and not isinstance(model, HasGaussians):
        parts.append(f"The Gaussians shown here are fitted to pictures of {method}'s field.")
    if kind == "octree" and not isinstance(model, DrawsOctree):
        parts.append(f"The octree shown here is baked from {method}'s field.")
    if moment is not None:
        parts.append(f"The scene moves; this is time {moment:g}.")
    if kind == "levels":
        parts.append("The page loads finer levels of detail from the folder beside it, and requests nothing else.")
    else:
        parts.append("The page works offline and requests nothing from any host.")
    return " ".join(parts)
