"""Speed of training and rendering beside other programs.

    python benchmarks/contention.py --data DIR [--seconds 20] [--output FILE]

runs instant-ngp alone and beside busy loops of several kinds, and beside itself, each for so many seconds, and prints
what share of its speed alone is left, and what share of the cores would be fair. A share above the fair one means that
the loops got less than theirs. Nothing else should run meanwhile. Writes benchmarks/results/contention.json.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

LOOP = "import time\nend = time.monotonic() + {seconds}\nwhile time.monotonic() < end: pass"
STEPS_BEFORE_RENDERING = 300


@dataclass(frozen=True)
class Row:
    """One condition."""

    name: str
    loops: int = 0
    nice: int = 0
    own_group: bool = False
    """The loops are started from a session of their own, which the system's scheduler treats as one."""
    trainings: int = 1
    environment: tuple[tuple[str, str], ...] = ()

    def fair_share(self, cores: int) -> float:
        """Fair share of the cores for one training with a thread on each core."""
        if self.own_group:
            return 0.5
        weight = 1.0 if self.nice == 0 else 15 / 1024  # the scheduler's for nice 19
        return cores / (cores * self.trainings + self.loops * weight)


PASSIVE = (("OMP_WAIT_POLICY", "PASSIVE"),)
ROWS = (
    Row("nothing"),
    Row("two loops, nice 19", loops=2, nice=19),
    Row("one loop", loops=1),
    Row("two loops", loops=2),
    Row("two loops in a session of their own", loops=2, own_group=True),
    Row("the same once more", trainings=2),
    Row("nothing, OMP_WAIT_POLICY=PASSIVE", environment=PASSIVE),
    Row("one loop, OMP_WAIT_POLICY=PASSIVE", loops=1, environment=PASSIVE),
    Row("nothing, one thread", environment=(("OMP_NUM_THREADS", "1"),)),
)


def main() -> None:
    """Run every row, training and rendering; print and write."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--seconds", type=float, default=20)
    parser.add_argument("--rows", nargs="*", help="names of rows, or parts of them; all if none")
    parser.add_argument("--work", choices=("training", "rendering", "child-training", "child-rendering"))
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results" / "contention.json")
    flags = parser.parse_args()
    if flags.work and flags.work.startswith("child-"):
        print(json.dumps(child(flags.data, flags.seconds, flags.work == "child-rendering")), flush=True)
        return
    table: dict[str, list[dict[str, Any]]] = {}
    for work in (flags.work,) if flags.work else ("training", "rendering"):
        table[work] = []
        for row in ROWS:
            if flags.rows and not any(part in row.name for part in flags.rows):
                continue
            measured = measure(row, work, flags.data, flags.seconds)
            alone = (table[work] or [measured])[0]["a second"][0]
            measured["share"] = [round(speed / alone, 2) for speed in measured["a second"]]
            table[work].append(measured)
            print(
                f"{work:10s} {row.name:38s} {json.dumps({k: v for k, v in measured.items() if k != 'beside'})}",
                flush=True,
            )
    content = {"cores": os.cpu_count(), "seconds": flags.seconds, **table}
    flags.output.write_text(json.dumps(content, indent=2) + "\n")


def measure(row: Row, work: str, data: Path, seconds: float) -> dict[str, Any]:
    """Speed, and the longest step, of each training or rendering of a row."""
    command = [sys.executable, __file__, "--work", f"child-{work}", "--data", str(data), "--seconds", str(seconds)]
    with ExitStack() as stack:
        children = [
            stack.enter_context(
                subprocess.Popen(
                    command,
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    text=True,
                    env={**os.environ, **dict(row.environment)},
                )
            )
            for _ in range(row.trainings)
        ]
        for of_child in children:
            wait_for(of_child, "ready")
        loop = [sys.executable, "-c", LOOP.format(seconds=20 * seconds)]  # it ends by itself should we not
        loops = [
            stack.enter_context(subprocess.Popen(["nice", "-n", str(row.nice), *loop], start_new_session=row.own_group))
            for _ in range(row.loops)
        ]
        time.sleep(0.5)
        for of_child in children:
            assert of_child.stdin is not None
            of_child.stdin.write("go\n")
            of_child.stdin.flush()
        found = [json.loads(wait_for(of_child, "{")) for of_child in children]
        for process in loops:
            process.kill()
    return {
        "beside": row.name,
        "fair share": round(row.fair_share(os.cpu_count() or 1), 2),
        **{key: [one[key] for one in found] for key in found[0]},
    }


def wait_for(process: subprocess.Popen[str], start: str) -> str:
    """The next line of a child's that starts so."""
    assert process.stdout is not None
    for line in process.stdout:
        if line.startswith(start):
            return line
    raise SystemExit(f"a run ended before its time, with status {process.wait()}")


def child(data: Path, seconds: float, rendering: bool) -> dict[str, float]:
    """Train or render for so long once told to, and say how fast that went."""
    from framework.base.registry import load_dataparser, load_method
    from framework.cli.session import load_split
    from framework.data.data_folder import find_data
    from framework.evaluation.evaluator import evaluation_background, render_view
    from framework.kernels import native
    from framework.training.run import Run, create_folder
    from framework.training.trainer import Trainer

    config = load_method("instant-ngp").config
    # The settings are those for 45 s; the time itself is not taken, or the schedule would end in the middle.
    config = dataclasses.replace(config, data=data, vis="none", max_seconds=45.0).resolved()
    config = dataclasses.replace(config, max_seconds=None)
    _, name = find_data(data)
    with tempfile.TemporaryDirectory() as folder:
        run = Run("instant-ngp", config, name, load_dataparser(name)(), Path(folder) / "run")
        create_folder(run)
        trainer = Trainer(run, load_split(run, "train"), None)
        views = load_split(run, "test") if rendering else None
        for _ in range(STEPS_BEFORE_RENDERING if rendering else 0):
            trainer.train_step()
        background = evaluation_background(trainer.model)

        def once(index: int) -> None:
            if views is None:
                trainer.train_step()
            else:
                render_view(trainer.model, views, index % len(views), background)

        print("ready", native.variant(), flush=True)
        sys.stdin.readline()
        first = timed(once, 0)  # of a training: with the silhouettes
        times = []
        while sum(times) < seconds:
            times.append(timed(once, len(times) + 1))
    return {
        "a second": round(len(times) / sum(times), 3),
        "first, s": round(first, 2),
        "longest, s": round(max(times), 3),
        "median, s": round(sorted(times)[len(times) // 2], 4),
    }


def timed(once: Any, index: int) -> float:
    """Seconds that a call takes."""
    start = time.perf_counter()
    once(index)
    return time.perf_counter() - start


if __name__ == "__main__":
    main()
