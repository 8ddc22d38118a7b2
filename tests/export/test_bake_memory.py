"""Memory of baking: it grows with the surface of the matter, not with the box around it."""

from pathlib import Path

import pytest

from tests.forked import Forks

MEASURE = """
from contextlib import nullcontext
from pathlib import Path
import torch
from nerfloom.data.scene import Scene
from nerfloom.export.octree_cells import MatterSearch
from nerfloom.export.octree_colors import seen_leaves
from nerfloom.kernels.octree.light import raw_of
from nerfloom.testing.ball import cameras_at

class Shell:
    scene = Scene(torch.tensor([[-1.0] * 3, [1.0] * 3]), 0.1, 9.0, 2, has_alpha=True, moving=False, image_size=64)
    device = torch.device("cpu")

    def rendering(self):
        return nullcontext()

    def density(self, points):
        return 500.0 * ((points.positions.norm(dim=-1) - 0.99).abs() < 1.5 / 512)

def status(name):
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(name + ":")) / 1e3

Path("/proc/self/clear_refs").write_text("5")  # the peak is counted from here
before = status("VmRSS")
search = MatterSearch(Shell())
grids = search.grids(512)
layout, depths = search.layout(grids)
raw = raw_of(depths)[:, None]
cameras = cameras_at(torch.tensor([[0.0, 3.0, 1.0], [0.0, -3.0, 1.0]]), 45.0, 64)
seen = seen_leaves(layout, raw, cameras, 0.1, 9.0)
kept, rows = layout.part((seen.largest > 0).nonzero()[:, 0])
search.averaged(kept, depths[rows])
cells = 8**3 * grids[0].size[0] * grids[0].size[1] * grids[0].size[2]
print(status("VmHWM") - before, layout.num_leaves, cells)
"""


@pytest.mark.medium
def test_512_cells_along_an_edge_need_less_memory_than_a_dense_grid(forks: Forks) -> None:
    """A shell of three cells: its leaves are found, seen and averaged in less memory than 512^3 numbers take."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        pytest.skip("this system does not tell the peak of a process's memory")
    done = forks.run(MEASURE)
    assert done.returncode == 0, done.stderr
    peak, leaves, cells = map(float, done.stdout.split()[-3:])
    print(f"{leaves:,.0f} leaves of {cells:,.0f} cells: {peak:.0f} MB")
    assert cells >= 500**3
    assert leaves > 1e6
    assert peak < 4 * 512**3 / 1e6
