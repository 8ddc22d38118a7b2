"""The flags of each benchmark."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from benchmarks.city import City
from nerfloom.cli.bench_results import PICTURES, RESULTS
from nerfloom.cli.job_flags import JobFlags


@dataclass(frozen=True)
class QuadratureFlags:
    """Measure the error of colours against field evaluations per ray, for every sampler, with known true colours."""

    quick: bool = False
    """Use fewer rays and sample counts: one minute instead of ten."""
    seed: int = 0
    """Random seed of rays, jitter and proposals."""
    output_dir: Path = RESULTS
    """Folder of quadrature.json."""
    plot_dir: Path | None = None
    """Folder of plots of the curves; no plots if not given."""


@dataclass(frozen=True)
class CurvesFlags:
    """Train methods from the start for each of several budgets, with several seeds; report PSNR against seconds.

    Results and picture are written after each budget. The content of --run-dir is kept: the same command goes on where
    it was stopped, and one with further methods, budgets or seeds trains these alone."""

    data: Path | None = None
    """Folder of the data set; the embedded scene if not given."""
    methods: tuple[str, ...] = ()
    """Methods, in quotes if with flags of their own: instant-ngp "vanilla-nerf --sampler occupancy". All installed ones
    if not given."""
    budgets: tuple[float, ...] = (10.0, 20.0, 45.0, 150.0, 300.0, 600.0)
    """Seconds of training, each for runs of its own."""
    seeds: int = 3
    """Number of runs of each method with each budget."""
    views: int = 50
    """Maximum number of held-out views for PSNR, evenly spaced."""
    run_dir: Path | None = None
    """Folder of the runs; outputs/curves-DATA if not given."""
    output_dir: Path = RESULTS
    """Folder of curves-DATA.json."""
    plot_dir: Path = PICTURES
    """Folder of the picture, curves-DATA.svg."""


@dataclass(frozen=True)
class OperationsFlags:
    """Count operations of torch, and waits for the device, in a training step on torch alone, as on a GPU."""

    methods: tuple[str, ...] = ()
    """Names of methods; all built-in ones if not given."""
    before: int = 16
    """Training steps before the counted ones."""
    steps: int = 8
    """Training steps that are counted."""
    output: Path = RESULTS / "operations.json"
    """JSON file to write."""


@dataclass(frozen=True, kw_only=True)
class ContentionFlags:
    """Run instant-ngp alone, beside busy loops and beside itself; report the remaining fraction of its speed."""

    data: Path
    """Folder of the data set."""
    seconds: float = 20.0
    """Seconds of each measurement."""
    rows: tuple[str, ...] = ()
    """Names of conditions, or parts of names; all if not given. The run alone is always measured."""
    work: Literal["training", "rendering"] | None = None
    """Work to measure; both if not given."""
    output: Path = RESULTS / "contention.json"
    """JSON file to write."""


@dataclass(frozen=True)
class CacheFlags:
    """Train on large images with pixels in a file and on small ones in memory; report memory, speed and waiting."""

    images: int = 250
    """Number of images."""
    width: int = 1920
    """Width of the large images, pixels."""
    height: int = 1080
    """Height of the large images, pixels."""
    seconds: float = 60.0
    """Seconds of training on each set."""
    limit: float = 500.0
    """Maximum memory of decoded pixels, MB."""
    folder: Path | None = None
    """Folder of images and cache during the run; the system's temporary folder if not given."""
    output: Path = RESULTS / "cache.json"
    """JSON file to write."""


@dataclass(frozen=True, kw_only=True)
class PosesFlags:
    """Compare poses from ns-process-data with a COLMAP model of the same images, by name."""

    processed: Path
    """Folder with transforms.json."""
    model: Path
    """Folder with cameras.bin, images.bin and points3D.bin."""


@dataclass(frozen=True)
class PoseRefinementFlags:
    """Train on the embedded scene with exact, disturbed and refined poses; report pose errors and PSNR."""

    seconds: float = 120.0
    """Seconds of training of each run."""
    degrees: float = 1.0
    """Rotation of each training camera, degrees."""
    percent: float = 1.0
    """Shift of each training camera, per cent of its distance from the centre of the scene."""
    method: str = "nerfacto"
    """Name of the method."""
    output_dir: Path = RESULTS
    """Folder of pose-refinement.json."""


@dataclass(frozen=True)
class MeshFlags:
    """Export meshes of a run; report their distance from the known surface, their time and memory."""

    load_config: Path | None = None
    """Folder of a run; if not given, instant-ngp is trained on the embedded scene."""
    seconds: float = 60.0
    """Seconds of that training."""
    exports: tuple[Literal["marching-cubes", "tsdf"], ...] = ("marching-cubes", "tsdf")
    """Exports that are measured."""
    resolutions: tuple[int, ...] = (256, 512)
    """Cells along the longest edge of the box."""
    output: Path = RESULTS / "meshes.json"
    """JSON file, which gets a row for the run's data."""


@dataclass(frozen=True)
class ViewerBenchFlags:
    """Measure the viewer's pictures of runs and files, from a request to the JPEG file, for one browser, on the CPU."""

    runs: tuple[Path, ...] = ()
    """Run folders, scenes in blocks, and files of Gaussians, of levels or of octrees, as ns-eval takes them."""
    data: Path | None = None
    """Folder of the data of files, or of runs if it has moved."""
    widths: tuple[int, ...] = (400, 800)
    """Widths and heights of the finished pictures, pixels."""
    pictures: int = 60
    """Number of pictures of a moving camera."""
    output_dir: Path = RESULTS
    """Folder of viewer.json."""


@dataclass(frozen=True, kw_only=True)
class TablesFlags(JobFlags):
    """Train and judge the rows of tables of results, each in its own process, and keep them in a JSON file a table.

    Rows that are in the file are left out, and a row that was stopped goes on: the same command continues."""

    tables: tuple[Path, ...]
    """Files of the tables, such as configs/tables/captures.yml."""
    data_root: Path = Path("data")
    """Folder of the folders of data that the tables name."""
    only: str = ""
    """Regular expression that is found in the names of the rows to run, such as ^fox or seed43; all if not given."""
    show: Literal["rows", "markdown"] | None = None
    """Run none. rows: list them, and how long those that are missing will take. markdown: print the tables, with means
    over seeds."""
    seconds_scale: float = 1.0
    """Factor of all budgets, such as 0.02 to try a table; then three held-out images of each row are judged."""
    lpips_weights: Path | None = None
    """File of weights of LPIPS with AlexNet (.npz), for the rows that are run."""
    num_threads: int | None = None
    """CPU threads of each row that is run; all cores if not given."""
    run_dir: Path = Path("outputs/tables")
    """Folder of the runs, with the last checkpoint and some pictures of each."""
    output_dir: Path = RESULTS
    """Folder of the results: TABLE.json for TABLE.yml."""


@dataclass(frozen=True, kw_only=True)
class ProcessesFlags:
    """Train instant-ngp with one process and with several on the same cores; report the times to some PSNRs."""

    data: Path
    """Folder of the data set."""
    processes: int = 2
    """Number of processes."""
    seconds: float = 40.0
    """Seconds of training of each run."""
    seeds: int = 1
    """Number of runs of each kind."""
    samples: int = 2**15
    """Samples of a training step of one process."""
    targets: tuple[float, ...] = (24.0, 26.0, 28.0)
    """The times to reach these PSNRs of validation views are reported, dB."""
    output_dir: Path = RESULTS
    """Folder of processes-DATA.json."""


@dataclass(frozen=True)
class CityFlags(City):
    """Print sizes, messages and times of a city in blocks, by formulas and from measured results."""

    results: Path = RESULTS
    """Folder of the results: methods-procedural.json, and city.json if there is one."""
