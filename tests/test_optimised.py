"""How parameters are optimised: said by the modules that hold them, and inherited by those within."""

import torch
from torch import nn

from nerfloom.base.optimised import Optimised, parameter_groups


class Part(nn.Module):
    """A parameter, and how it is optimised."""

    def __init__(self, optimised: Optimised | None = None, **children: nn.Module) -> None:
        super().__init__()
        self.optimised = optimised
        self.value = nn.Parameter(torch.zeros(1))
        for name, child in children.items():
            self.add_module(name, child)


def settings_of(model: nn.Module) -> dict[int, Optimised]:
    """How each parameter is optimised, by its identity; each is in one group."""
    groups = parameter_groups(model)
    found = {id(parameter): group.settings for group in groups for parameter in group.parameters}
    assert len(found) == sum(len(group.parameters) for group in groups)
    assert found.keys() == {id(parameter) for parameter in model.parameters()}
    assert len({group.settings for group in groups}) == len(groups)
    return found


def test_what_a_module_does_not_say_is_as_for_the_one_that_holds_it() -> None:
    table = Part(Optimised("tables", sparse=True))
    plain = nn.Linear(2, 2)  # knows nothing of groups
    heads = Part(Optimised("heads", learning_rate=0.5, betas=(0.8, 0.9), eps=1e-3), table=table, plain=plain)
    other = Part()
    found = settings_of(Part(None, heads=heads, other=other))
    rest = Optimised("networks", sparse=False)
    inherited = Optimised("heads", 0.5, (0.8, 0.9), 1e-3, sparse=False)
    assert found[id(heads.value)] == found[id(plain.weight)] == found[id(plain.bias)] == inherited
    assert found[id(table.value)] == Optimised("tables", 0.5, (0.8, 0.9), 1e-3, sparse=True)
    assert found[id(other.value)] == rest


def test_modules_that_say_the_same_share_a_group() -> None:
    model = Part(None, a=Part(Optimised("planes")), b=Part(Optimised("planes")), c=Part(Optimised("planes", 0.1)))
    sizes = {
        (group.settings.name, group.settings.learning_rate): len(group.parameters) for group in parameter_groups(model)
    }
    assert sizes == {("networks", None): 1, ("planes", None): 2, ("planes", 0.1): 1}


def test_a_parameter_that_two_modules_hold_is_in_the_group_of_the_first() -> None:
    first, second = Part(Optimised("first")), Part(Optimised("second"))
    second.value = first.value
    (shared,) = [group for group in parameter_groups(nn.ModuleList([first, second])) if group.parameters]
    assert shared.settings.name == "first"
    assert shared.parameters == (first.value,)


def test_false_and_zero_are_said_and_not_open() -> None:
    outer = Optimised("outer", 0.5, sparse=True)
    assert Optimised(learning_rate=0.0, sparse=False).within(outer) == Optimised("outer", 0.0, sparse=False)
