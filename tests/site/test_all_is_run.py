"""Every command of the documents is run by some test: here, or by the one that this table names."""

import re

from tests.site.pages import PAGES, ROOT, commands
from tests.site.test_run_commands import MEASURED, RUNNING, shown
from tests.site.test_run_photographs import COMPARED, PROCESSED

ELSEWHERE = {
    r"make (demo|test|test-fast|test-all|lint|sanitize)$": ".ci/run",
    r"make mutants": "tests/mutants/test_mutants.py",
    r"make docs": "tests/site/test_site.py",
    r"make (release-check|test-versions)": "tests/release/__main__.py",
    r"python3 -m venv|\. \.venv|pip install .*-e (\.|'\.|\"\.)": "tests/release/install.py",
    r"pytest (-n|-s|tests)|TRITON|python -m tests": ".ci/run",
    r"(pip install -e|python -m pytest|ns-train|ns-compare --methods|ns-new-method) '?(my-method|dense-grid)": (
        "tests/plugins/test_installed_plugin.py"
    ),
    r"export NERFLOOM_": "tests/test_registry.py",
    r"ns-train .*(plain-grid|path/to/ring)": "tests/site/test_snippets.py",
    r"ns-train (--help|--version|[\w-]+ --help(-all)?)": "tests/cli/test_commands.py",
    r"ns-train --load-config": "tests/cli/test_train_command.py",
    r"ns-train --resume": "tests/training/test_trainer.py",
    r"ns-train .*--vis viewer": "tests/viewer/test_training.py",
    r"ns-train .* (blender|nerfstudio|colmap|dtu) --": "tests/truth/test_captures.py",
    r"ns-eval .*--eval-appearance half": "tests/truth/test_training.py",
    r"ns-render (camera-path|time) ": "tests/cli/test_render_command.py",
    r"ns-(train|viewer|eval|render|export) .*/balls": "tests/splats/test_moving_gaussians.py",
    r"ns-compare .*/balls": "tests/cli/test_compare_command.py",
    r"ns-process-data (polycam|record3d) .*(zip|r3d)": "tests/processing/test_archives.py",
    r"ns-process-data (polycam|record3d) ": "tests/truth/test_processing.py",
    r"ns-process-data (metashape|realitycapture|odm|bundler) ": "tests/processing/test_programs.py",
    r"ns-process-data aria ": "tests/processing/test_aria.py",
    r"ns-process-data (images|video) .*equirectangular": "tests/processing/test_views.py",
    r"ns-process-data images .*(FISHEYE|scan/images)": "tests/truth/test_processing.py",
    r"ns-process-data images .*--resume": "tests/processing/test_process_command.py",
    r"ns-compare .*--(launcher|jobs)": "tests/jobs/test_ray.py",
    r"ns-compare --load-config": "tests/cli/test_compare_command.py",
    r"ns-bench gpu": "tests/benchmarks/test_gpu.py",
    r"python -m benchmarks (quadrature|processes|contention|cache|poses|tables)": (
        "tests/benchmarks/test_bench_command.py"
    ),
    r"python -m benchmarks city": "tests/benchmarks/test_city.py",
    r"python -m nerfloom.cli.bench gpu": "tests/benchmarks/test_gpu.py",
    r"ns-bake": "tests/export/test_bake.py",
    r"ns-edit": "tests/edit/test_command.py",
    r"ns-blocks": "tests/blocks/test_command.py",
    r"ns-(eval|render|viewer|export) .*outputs/blocks-": "tests/blocks/test_command.py",
    r"ns-download-data": "tests/downloads/test_install.py",
    r"ns-measure": "tests/test_scale.py",
    r"ns-stress": "tests/stress_command/test_runs.py",
    r"python -m nerfloom.dataparsers.procedural.solids": "tests/dataparsers/test_solids.py",
    r"python -m nerfloom.dataparsers.procedural.shiny": "tests/dataparsers/test_shiny.py",
    r"ns-eval outputs/mirror": "tests/test_ref_nerf.py",
    r"ns-(eval|compare) .*--reference-": "tests/cli/test_eval_geometry.py",
    r"torchrun": "tests/training/test_processes.py",
    r"python examples/": "tests/plug_and_play/test_examples.py",
    r"python docs/building/failures": "tests/site/test_failures.py",
    r"python -m docs\.building\.tables": "tests/site/test_figures.py",
}
"""Beginning of a command -> the test that runs it, or its like."""
NOT_RUN = r"(nerfbaselines|pip install nerfbaselines)"
"""It downloads data."""


def test_every_command_is_run_somewhere() -> None:
    here = {*RUNNING, *shown("ns-viewer"), *PROCESSED, *COMPARED}
    patterns = [*ELSEWHERE, NOT_RUN, f"(ns-bench|python -m benchmarks) ({'|'.join(MEASURED)})"]
    shown_ones = {command.split("  ")[0] for page in PAGES for _, command in commands(page)}
    left = [command for command in shown_ones - here if not any(re.match(pattern, command) for pattern in patterns)]
    # Tables of figures leave the data out, and README repeats the guides.
    left = [
        command for command in left if not re.match(r"(ns-train|ns-viewer) [\w-]+.*(--max-seconds \d+|/TIME)$", command)
    ]
    assert sorted(left) == []


def test_the_tests_that_are_named_exist() -> None:
    assert [file for file in ELSEWHERE.values() if not (ROOT / file).is_file()] == []
