"""Methods that people ask for by name and that live elsewhere: where, and what comes closest here."""

from __future__ import annotations

_NERFSTUDIO = "it is a method of nerfstudio (pip install nerfstudio, ns-train {name})"

ELSEWHERE: dict[str, str] = {
    "splatfacto": f"Gaussians are no radiance field; {_NERFSTUDIO.format(name='splatfacto')}",
    "gaussian-splatting": "Gaussians are no radiance field; the authors' code is graphdeco-inria/gaussian-splatting",
    "neus": f"surfaces are not learnt here yet; {_NERFSTUDIO.format(name='neus')}",
    "neus-facto": f"surfaces are not learnt here yet; {_NERFSTUDIO.format(name='neus-facto')}",
    "generfacto": _NERFSTUDIO.format(name="generfacto"),
    "instruct-nerf2nerf": "it is a plugin of nerfstudio, in ayaanzhaque/instruct-nerf2nerf",
    "lerf": "it is a plugin of nerfstudio, in kerrj/lerf",
    "tetra-nerf": "it is a plugin of nerfstudio, in jkulhanek/tetra-nerf",
    "zip-nerf": "the authors' code is jonbarron/camp_zipnerf; 'nerfacto' comes closest here",
    "zipnerf": "the authors' code is jonbarron/camp_zipnerf; 'nerfacto' comes closest here",
    "mip-nerf": "the authors' code is google/mipnerf; 'vanilla-nerf' comes closest here",
    "mipnerf": "the authors' code is google/mipnerf; 'vanilla-nerf' comes closest here",
    "nerf": "here it is called 'vanilla-nerf'",
    "instant-ngp-bounded": "here it is called 'instant-ngp', and the scene's profile tells whether it is bounded",
    "k-planes": "here it is called 'kplanes'",
    "d-nerf": "here it is called 'dnerf'",
}
"""Name -> where to get it. A method that is registered under the name comes first."""
