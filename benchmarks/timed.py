"""A command with its seconds and memory: `python benchmarks/timed.py SUMMARY PRODUCT MODULE [ARGUMENTS]`.

The module runs in this process, as `python -m MODULE ARGUMENTS` would. If it succeeds, the JSON file SUMMARY gets its
wall-clock seconds, the peak memory of the largest process, the size of PRODUCT if that is a file, and the machine.
"""

from __future__ import annotations

import runpy
import sys
import time
from pathlib import Path


def main(summary: str, product: str, module: str, *arguments: str) -> None:
    """Run a module, and write the summary if it succeeds.

    Args:
        summary: JSON file to write.
        product: file or folder that the module makes.
        module: name of the module.
        arguments: its arguments.

    Raises:
        SystemExit: from a module that fails; there is no summary then.
    """
    start = time.perf_counter()
    sys.argv = [module, *arguments]
    runpy.run_module(module, run_name="__main__", alter_sys=True)
    seconds = time.perf_counter() - start
    from nerfloom.base.device import choose_device
    from nerfloom.base.json_files import write_json
    from nerfloom.base.machine_config import MachineConfig
    from nerfloom.training.machine import machine

    made, device = Path(product), choose_device(MachineConfig())
    content = {"interrupted": False, "wall_seconds": seconds, "peak_memory_bytes": _peak(), "machine": machine(device)}
    write_json(Path(summary), content | ({"bytes": made.stat().st_size} if made.is_file() else {}))


def _peak() -> int:
    """Return the peak memory of the largest of this process and its children, bytes; 0 if the system does not say."""
    try:
        import resource
    except ImportError:  # Windows
        return 0
    peak = max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return peak if sys.platform == "darwin" else peak * 1024


if __name__ == "__main__":
    main(*sys.argv[1:])
