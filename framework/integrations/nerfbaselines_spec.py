"""Specifications of Nerfloom's methods for nerfbaselines: plain data, registered with it if it is installed.

nerfbaselines finds this file if Nerfloom is installed in the same environment (entry point group
`nerfbaselines.specs`), through NERFBASELINES_REGISTER with the file's path, or through `nerfbaselines install --spec`.
So the file imports neither Nerfloom nor PyTorch. Methods run in nerfbaselines' own environment (its `python` backend).
"""

from __future__ import annotations

from typing import Any

COMMON: dict[str, Any] = {
    "backends_order": ["python"],
    "required_features": ["color", "points3D_xyz"],
    "supported_camera_models": ["pinhole", "opencv", "opencv_fisheye", "full_opencv"],
    "supported_outputs": ["color", "depth", "accumulation"],
    "presets": {
        # The box of `ns-train` for these scenes, smaller than the range between smallest and largest depth.
        "blender": {"@apply": [{"dataset": "blender"}], "frame.half_size": 1.5},
    },
}
"""Entries shared by all methods."""
LICENSES = [{"name": "Apache-2.0"}]
"""Licenses of the methods."""


def _spec(method: str, method_class: str, **metadata: Any) -> dict[str, Any]:
    """Return the specification of `method` with the class `method_class` and the `metadata` of nerfbaselines' pages."""
    return {
        "id": f"nerfloom-{method}",
        "method_class": f"nerfloom.integrations.nerfbaselines:{method_class}",
        "metadata": {**metadata, "licenses": LICENSES},
        **COMMON,
    }


SPECS: tuple[dict[str, Any], ...] = (
    _spec(
        "instant-ngp",
        "InstantNGP",
        name="Nerfloom Instant-NGP",
        description="Nerfloom's Instant-NGP: a multiresolution hash grid, two small networks and an occupancy grid, "
        "or proposals in contracted space for unbounded scenes. It needs no GPU.",
        paper_title="Instant Neural Graphics Primitives with a Multiresolution Hash Encoding",
        paper_authors=["Thomas Müller", "Alex Evans", "Christoph Schied", "Alexander Keller"],
        paper_link="https://arxiv.org/pdf/2201.05989.pdf",
    ),
    _spec(
        "kplanes",
        "KPlanes",
        name="Nerfloom K-Planes",
        description="Nerfloom's K-Planes: products of feature planes at several scales.",
        paper_title="K-Planes: Explicit Radiance Fields in Space, Time, and Appearance",
        paper_authors=[
            "Sara Fridovich-Keil",
            "Giacomo Meanti",
            "Frederik Warburg",
            "Benjamin Recht",
            "Angjoo Kanazawa",
        ],
        paper_link="https://arxiv.org/pdf/2301.10241.pdf",
    ),
    _spec(
        "nerfacto",
        "Nerfacto",
        name="Nerfloom Nerfacto",
        description="Nerfloom's Nerfacto: a hash grid with contraction and proposals, and appearance vectors if "
        "the light differs between images.",
        paper_title="Nerfstudio: A Modular Framework for Neural Radiance Field Development",
        paper_authors=[
            "Matthew Tancik",
            "Ethan Weber",
            "Evonne Ng",
            "Ruilong Li",
            "Brent Yi",
            "Justin Kerr",
            "Terrance Wang",
            "Alexander Kristoffersen",
            "Jake Austin",
            "Kamyar Salahi",
            "Abhik Ahuja",
            "David McAllister",
            "Angjoo Kanazawa",
        ],
        paper_link="https://arxiv.org/pdf/2302.04264.pdf",
    ),
    _spec(
        "tensorf",
        "TensoRF",
        name="Nerfloom TensoRF",
        description="Nerfloom's TensoRF: density and appearance as products of planes and lines that grow from coarse "
        "to fine.",
        paper_title="TensoRF: Tensorial Radiance Fields",
        paper_authors=["Anpei Chen", "Zexiang Xu", "Andreas Geiger", "Jingyi Yu", "Hao Su"],
        paper_link="https://arxiv.org/pdf/2203.09517.pdf",
    ),
    _spec(
        "vanilla-nerf",
        "VanillaNeRF",
        name="Nerfloom NeRF",
        description="Nerfloom's NeRF with the paper's settings: one large network on frequency encodings, sampled "
        "coarsely and finely, or by proposals in contracted space for unbounded scenes.",
        paper_title="NeRF: Representing Scenes as Neural Radiance Fields for View Synthesis",
        paper_authors=[
            "Ben Mildenhall",
            "Pratul P. Srinivasan",
            "Matthew Tancik",
            "Jonathan T. Barron",
            "Ravi Ramamoorthi",
            "Ren Ng",
        ],
        paper_link="https://arxiv.org/pdf/2003.08934.pdf",
    ),
)
"""The specifications."""

try:
    from nerfbaselines import register
except ImportError:  # not installed, or a version without `register`
    pass
else:
    for _entry in SPECS:
        register(_entry)
