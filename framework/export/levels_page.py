"""The web page of a file of levels, and the folder of chunks beside it, which the page loads for a view.

The folder has the name of the page without suffix. It has a file for each node of the tree (`levels/nodes.py`), with
the node's Gaussians in the frame of the page, as SPZ of version 2 with 8 bits of harmonics. The file is named after its
content, so chunks of another export do not replace those of a page that is being read, or that stays because its export
is stopped. The page itself holds the Gaussians of the root, and of the tree

    folder, total, largest     name of the folder; Gaussians of the scene; most Gaussians of a chunk
    chunks                     of each node: name of its file without suffix
    counts, parents            of each node, as in the file
    boxes                      of each node: minimum and maximum corner of a box of its Gaussians and of those below
    reach, errors              of each node, as in the file

Lengths are in the unit of the page. Any static host can serve both: no program runs there.
"""

from __future__ import annotations

import hashlib
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from nerfloom.base.atomic import write_atomically
from nerfloom.base.console import track
from nerfloom.base.counts import counted
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
NAME = re.compile(r"[0-9]+|[0-9a-f]{16}")
"""Names of chunks without suffix: numbers in older pages, and digests."""


def levels_page(loaded: Loaded, path: Path, facts: PageFacts, turn: Tensor) -> ScenePage:
    """Write the chunks of a file of levels beside a page, and return the page. Other chunks stay.

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
    content, size, chunks, lossy = b"", 0, list[str](), list[str]()
    for index in track(range(len(file.nodes)), "Writing chunks", total=len(file.nodes)):
        chunk = transformed(file.read(index), rotation, scale, shift)
        content = encoded(chunk, BITS, file.look)
        chunks.append(_write(folder, content))
        size += len(content)
        lossy += out_of_range(chunk)[:1]
    levels = {
        "folder": folder.name,
        "total": file.num_gaussians,
        "largest": int(file.nodes.counts.max()),
        "chunks": chunks,
        **tree_facts(file.nodes, rotation, scale, shift),
    }
    text = page(content, replace(facts, look=file.look, levels=levels))
    words = (
        f"{counted(file.num_gaussians, 'Gaussians')} in {counted(len(file.nodes), 'chunks')} of all levels, "
        f"{size / 1e6:.1f} MB in the folder {folder.name} beside it"
    )
    costs = [f"{len(lossy):,} of the chunks lose more than others, the first: {lossy[0]}"] if lossy else []
    return ScenePage(
        text, words, costs, lambda camera: model.render_rgb(View(camera), model.background), DRAWN, frozenset(chunks)
    )


def remove_other_chunks(path: Path, page: ScenePage) -> None:
    """Remove the chunks of earlier pages.

    Args:
        path: path of the page, which has been written.
        page: the page.
    """
    for file in path.with_suffix("").glob("*.spz"):
        if NAME.fullmatch(file.stem) and file.stem not in page.chunks:
            file.unlink()


def _write(folder: Path, content: bytes) -> str:
    """Write a chunk, and return its name without suffix."""
    name = hashlib.sha256(content).hexdigest()[:16]
    write_atomically(folder / f"{name}.spz", lambda file: file.write(content))
    return name


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
