"""The outcome of an input, and the likeness of two outcomes."""

import re
from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Outcome:
    """The outcome of one input."""

    reader: str
    seed: int
    kind: Literal["accepted", "refused", "escaped"]
    error: str = ""
    """The type of the error."""
    message: str = ""
    damage: tuple[str, ...] = ()
    """The damage to each file."""
    trace: str = ""
    """Where an escape came from."""

    @property
    def shape(self) -> str:
        """The message without the parts that differ from input to input: names, values, numbers."""
        text = re.sub(r"'[^']*'|\"[^\"]*\"", "'...'", self.message)
        text = re.sub(r"\S*/\S*", "PATH", text)
        return re.sub(r"[-+]?(\d[\d.,]*(e[-+]?\d+)?|\bnan\b|\binf\b)", "N", text)[:200]

    def __str__(self) -> str:
        lines = [
            f"{self.reader}, seed {self.seed}: {self.kind}: {self.error}: {self.message[:500]}",
            f"  damage: {'; '.join(self.damage)}",
            f"  repeat: python -m tests.fuzz --reader {self.reader} --seed {self.seed} --count 1",
        ]
        return "\n".join([*lines, self.trace]) if self.trace else "\n".join(lines)
