"""Methods of other projects: where to get them, and the closest method here."""

from __future__ import annotations

_NERFSTUDIO = "it is a method of nerfstudio (pip install nerfstudio, ns-train {name})"
_PLUGIN = "it is a plugin of nerfstudio (pip install git+https://github.com/{repository}, ns-train {name})"
_GAUSSIANS = "here it is called 'gaussian-splatting'"
_LARGER = "here it is 'nerfacto' with larger settings:"

ELSEWHERE: dict[str, str] = {
    "splatfacto": _GAUSSIANS,
    "splatfacto-big": f"{_GAUSSIANS}; --num-gaussians sets the maximum number of Gaussians",
    "3dgs": _GAUSSIANS,
    "gsplat": _GAUSSIANS,
    "neus-facto": "here 'neus' learns surfaces",
    "monosdf": "here 'volsdf' learns surfaces, without the depth and normals of a network",
    "neuralangelo": "here 'neus' learns surfaces on a hash grid, with levels that open from coarse to fine",
    "generfacto": _NERFSTUDIO.format(name="generfacto"),
    "in2n": _PLUGIN.format(repository="ayaanzhaque/instruct-nerf2nerf", name="in2n"),
    "instruct-nerf2nerf": _PLUGIN.format(repository="ayaanzhaque/instruct-nerf2nerf", name="in2n"),
    "lerf": _PLUGIN.format(repository="kerrj/lerf", name="lerf"),
    "pynerf": _PLUGIN.format(repository="hturki/pynerf", name="pynerf"),
    "seathru-nerf": _PLUGIN.format(repository="AkerBP/seathru_nerf", name="seathru-nerf"),
    "tetra-nerf": "it is a plugin of nerfstudio; https://github.com/jkulhanek/tetra-nerf says how to install it",
    "zipnerf": "here it is called 'zip-nerf'",
    "mipnerf": "here it is called 'mip-nerf'",
    "mipnerf360": "here it is called 'mip-nerf-360'",
    "nerf": "here it is called 'vanilla-nerf'",
    "nerf++": "here it is called 'nerf-plus-plus'",
    "nerfplusplus": "here it is called 'nerf-plus-plus'",
    "refnerf": "here it is called 'ref-nerf'",
    "kilonerf": "here it is called 'kilo-nerf'",
    "plenoxels": "here it is called 'voxels'",
    "svraster": "here it is called 'voxels', with leaves of one size",
    "pixelnerf": "here it is called 'pixel-nerf'",
    "instant-ngp-bounded": "here it is called 'instant-ngp'; it detects whether a scene is bounded",
    "nerfacto-big": f"{_LARGER} --max-resolution 4096 --log2-table-size 21 --hidden-width 128",
    "nerfacto-huge": f"{_LARGER} --max-resolution 8192 --log2-table-size 21 --hidden-width 256",
    "phototourism": "here it is 'nerfacto'; data of the format phototourism is recognised",
    "semantic-nerfw": "here it is called 'nerf-w', without semantics",
    "nerfplayer-nerfacto": "for moving scenes there are 'kplanes' and 'dnerf'",
    "nerfplayer-ngp": "for moving scenes there are 'kplanes' and 'dnerf'",
    "freetimegs": "here it is called 'moving-gaussians'",
    "4dgs": "for moving scenes 'moving-gaussians' has Gaussians with velocities, and no network",
    "depth-nerfacto": "here 'nerfacto' does that if the images come with depth images",
    "k-planes": "here it is called 'kplanes'",
    "d-nerf": "here it is called 'dnerf'",
}
"""Name -> how to get the method. Registered methods take precedence."""
