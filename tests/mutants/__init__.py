"""The list of mutants (one module a part of the package), how one is planted, and a command that tries them."""

from dataclasses import replace

from tests.mutants import inputs, numerics, outputs, training
from tests.mutants.mutant import Mutant


def all_mutants() -> list[Mutant]:
    """Return the mutants of all lists."""
    lists = (inputs.MUTANTS, numerics.MUTANTS, training.MUTANTS, outputs.MUTANTS)
    return [replace(one, module=module) for found in lists for module, of in found.items() for one in of]
