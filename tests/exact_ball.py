"""A ball at the origin that is rendered in closed form: what a perfect model of `ball_in_a_box` would show."""

import torch
from torch import Tensor

from nerfloom import Scene
from nerfloom.cameras.view import View
from nerfloom.geometry.rays import Rays
from nerfloom.renderable import RendersRays
from nerfloom.rendering.rendered import Picture, Rendered
from nerfloom.testing.ball import RADIUS, trace


class ExactBall(RendersRays):
    """A ball coloured by its normals."""

    device = torch.device("cpu")
    rays_at_once = 5_000

    def __init__(self, scene: Scene) -> None:
        self.scene = scene

    def render(self, rays: Rays, background: Tensor) -> Rendered:
        normals, hits = trace(rays.origins, rays.directions)
        depth = ((RADIUS * normals - rays.origins) * rays.directions).sum(-1)
        depth = torch.where(hits, depth, rays.fars)
        rgb = torch.where(hits[:, None], colors_of(normals), background)
        return Rendered(rgb, depth, depth, hits.float(), len(rays))

    def render_view(self, view: View, background: Tensor) -> Picture:
        pixels = view.pixels()
        rays = view.camera.pixel_rays(pixels.reshape(-1), self.scene.near, self.scene.far)
        shown = self.render(rays, background)
        values = (part.view(pixels.shape) for part in (shown.depth, shown.median_depth, shown.accumulation))
        return Picture(shown.rgb.view(*pixels.shape, 3), *values)


def colors_of(normals: Tensor) -> Tensor:
    """The colours of normals (..., 3)."""
    return 0.5 + 0.4 * normals.clamp(-1, 1)
