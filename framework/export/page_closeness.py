"""The closeness of a web page to the run or file that it shows."""

from __future__ import annotations

from dataclasses import dataclass
from statistics import fmean

import torch

from nerfloom.base.console import track
from nerfloom.base.evenly_spaced import strided
from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.view import View
from nerfloom.data.dataset import Dataset
from nerfloom.data.pixels.batch import composite
from nerfloom.evaluation.evaluator import measure, views_to_judge
from nerfloom.evaluation.metrics import psnr
from nerfloom.export.page_scenes import ScenePage
from nerfloom.export.web import pinhole
from nerfloom.renderable import Renderable

MAX_VIEWS = 5
"""Maximum number of views for comparing a page with the model."""


@dataclass(frozen=True)
class Closeness:
    """Metrics of a page, compared with the model; Nerfloom draws both."""

    views: str
    """The compared views, as text."""
    method: float
    """PSNR against the method's own pictures, dB."""
    photographs: float | None
    """PSNR against the photographs, dB; None if they are of other moments, or their lens cannot draw the page's
    scene."""
    method_itself: float | None
    """PSNR of the method's own pictures against the photographs, dB; None likewise."""

    def line(self) -> str:
        """Return the metrics as a line of text."""
        text = f"on {self.views}: PSNR {self.method:.2f} dB against the method's own pictures"
        if self.photographs is None:
            return text
        return f"{text}, {self.photographs:.2f} dB against the photographs (the method: {self.method_itself:.2f} dB)"


def closeness(
    model: Renderable, page: ScenePage, cameras: Cameras, dataset: Dataset | None, moment: float | None
) -> Closeness:
    """Compare a page with the model that it represents.

    Args:
        model: the model.
        page: the page.
        cameras: M cameras to compare from, on the model's device.
        dataset: their images, on the model's device; None without any.
        moment: time of the views; None for a static scene.
    """
    background = model.background
    judged = (views_to_judge(dataset) if dataset else []) or list(range(len(cameras)))
    chosen = [judged[rank] for rank in strided(len(judged), MAX_VIEWS)]
    as_seen = cameras.model in page.lenses
    cameras = cameras if as_seen else pinhole(cameras)
    own: list[float] = []
    photographs: list[tuple[float, float]] = []
    for index in track(chosen, "Comparing", total=len(chosen)):
        view = View.of(cameras, index, None if dataset is None else dataset.times)
        rgb = model.render_rgb(view, background).clamp(0, 1).float()
        with torch.no_grad():
            drawn = page.draw(view.camera).clamp(0, 1)
        own.append(psnr(drawn, rgb))
        if dataset is not None and as_seen and moment is None:
            target = composite(dataset.image(index).float() / 255, background)
            kept = dataset.kept_of(index)
            photographs.append((measure(drawn, target, kept).psnr, measure(rgb, target, kept).psnr))
    kind = "views around it" if dataset is None else f"{'training' if dataset.training else 'held-out'} views"
    views = f"{len(chosen)} {kind}"
    if not photographs:
        return Closeness(views, fmean(own), None, None)
    of_page, of_method = zip(*photographs, strict=True)
    return Closeness(views, fmean(own), fmean(of_page), fmean(of_method))
