"""What became of the bugs, for people and as JSON."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tests.mutations.campaign import Result


def summary(results: Sequence[Result]) -> str:
    """How many of each kind were noticed, and which were not."""
    kinds = sorted({result.bug.kind for result in results})
    lines = []
    for kind in kinds:
        of_kind = [result for result in results if result.bug.kind == kind]
        lines.append(f"{_noticed(of_kind):4} of {len(of_kind):3}  {kind}")
    lines += [f"not noticed: {r.bug.name} ({r.bug.file}): {r.bug.means}" for r in results if r.noticed_by is None]
    return "\n".join([*lines, f"noticed {_noticed(results)} of {len(results)}: {_noticed(results) / len(results):.1%}"])


def as_plain(results: Sequence[Result], seconds: float, machine: dict[str, Any]) -> dict[str, Any]:
    """For JSON."""
    rows = [
        {
            "name": r.bug.name,
            "kind": r.bug.kind,
            "file": r.bug.file,
            "means": r.bug.means,
            "noticed_by": r.noticed_by,
            "tests": r.tests,
            "seconds": round(r.seconds, 1),
        }
        for r in sorted(results, key=lambda result: (result.bug.kind, result.bug.name))
    ]
    return {
        "planted": len(results),
        "noticed": _noticed(results),
        "share": round(_noticed(results) / len(results), 3),
        "bugs": rows,
        "seconds": seconds,
        "machine": machine,
    }


def _noticed(results: Sequence[Result]) -> int:
    return sum(result.noticed_by is not None for result in results)
