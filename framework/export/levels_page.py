"""The web page of a file of levels, and the folder of chunks beside it, which the page loads for a view.

The folder has the name of the page without suffix. Its file N.spz holds the Gaussians of node N of the tree
(`levels/nodes.py`) in the frame of the page, as SPZ of version 2 with 8 bits of harmonics. The page itself holds the
Gaussians of the root, and of the tree

    folder, total, largest     name of the folder; Gaussians of the scene; most Gaussians of a chunk
    counts, parents            of each node, as in the file
    boxes                      of each node: minimum and maximum corner of a box of its Gaussians and of those below
    reach, errors              of each node, as in the file

Lengths are in the unit of the page. Any static host can serve both: no program runs there.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from nerfloom.base.console import track
from nerfloom.base.errors import ConfigError
from nerfloom.cameras.view import View
from nerfloom.export.page_scenes import ScenePage
from nerfloom.export.web import BITS, PageFacts, page
from nerfloom.levels.drawn import DrawnLevels
from nerfloom.levels.nodes import Nodes
from nerfloom.splats.drawing import DRAWN
from nerfloom.splats.spz import encoded, out_of_range
from nerfloom.splats.transform import transformed
from nerfloom.training.loaded import Loaded

DIGITS = 6
"""Significant digits of lengths in the page."""


def levels_page(loaded: Loaded, path: Path, facts: PageFacts, turn: Tensor) -> ScenePage:
    """Write the chunks of a file of levels beside a page, and return the page.

    Args:
        loaded: the file of levels.
        path: path of the page, which the caller writes.
        facts: further data of the page.
        turn: (3, 3) rotation from the scene's frame to the page's.

    Raises:
        ConfigError: if it is no file of levels.
        DataError: if a chunk is damaged.
        OSError: if a chunk cannot be written.
    """
    model = loaded.model
    if not isinstance(model, DrawnLevels):
        raise ConfigError(f"{loaded.origin} is no file of levels; ns-export levels writes one")
    file, folder = model.file, path.with_suffix("")
    rotation, scale, shift = model.placement.similarity()
    rotation, shift = turn @ rotation, turn @ shift
    folder.mkdir(exist_ok=True)
    content, size, lossy = b"", 0, list[str]()
    for index in track(range(len(file.nodes)), "Writing chunks", total=len(file.nodes)):
        chunk = transformed(file.read(index), rotation, scale, shift)
        content = encoded(chunk, BITS, file.look)
        (folder / f"{index}.spz").write_bytes(content)
        size += len(content)
        lossy += out_of_range(chunk)[:1]
    for other in folder.glob("*.spz"):  # of an earlier page
        if other.stem.isdecimal() and int(other.stem) >= len(file.nodes):
            other.unlink()
    levels = {
        "folder": folder.name,
        "total": file.num_gaussians,
        "largest": int(file.nodes.counts.max()),
        **tree_facts(file.nodes, rotation, scale, shift),
    }
    text = page(content, replace(facts, look=file.look, levels=levels))
    words = (
        f"{file.num_gaussians:,} Gaussians in {len(file.nodes):,} chunks of all levels, {size / 1e6:.1f} MB in the "
        f"folder {folder.name} beside it"
    )
    costs = [f"{len(lossy):,} of the chunks lose more than others, the first: {lossy[0]}"] if lossy else []
    return ScenePage(text, words, costs, lambda camera: model.render_rgb(View(camera), model.background), DRAWN)


def tree_facts(nodes: Nodes, rotation: Tensor, scale: float, shift: Tensor) -> dict[str, Any]:
    """Return the tree of a page after a similarity x -> scale * rotation @ x + shift of its nodes.

    Rounding keeps the order of numbers, so a node still has no larger box, reach or error than the one above it.

    Args:
        nodes: M nodes.
        rotation: (3, 3) float64.
        scale: factor of lengths.
        shift: (3,) float64.
    """
    corner = torch.cartesian_prod(*[torch.tensor([False, True])] * 3)
    corners = torch.where(corner, nodes.high[:, None], nodes.low[:, None])  # (M, 8, 3)
    moved = scale * corners @ rotation.T + shift
    return {
        "counts": nodes.counts.tolist(),
        "parents": nodes.parents.tolist(),
        "boxes": [_rounded(row) for row in torch.cat([moved.amin(1), moved.amax(1)], dim=1)],
        "reach": _rounded(scale * nodes.reach),
        "errors": _rounded(scale * nodes.errors),
    }


def _rounded(values: Tensor) -> list[float]:
    """Return numbers with few digits, which take less room in a page."""
    return [float(f"{value:.{DIGITS}g}") for value in values.tolist()]
