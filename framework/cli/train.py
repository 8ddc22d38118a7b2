"""ns-train: train a method on a data set."""

from __future__ import annotations

import dataclasses
import os
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from framework.base.errors import ConfigError
from framework.base.from_nerfstudio import flag_answer, vis_answer
from framework.base.registry import entry_of, registered, summary
from framework.cli.common import run_command

if TYPE_CHECKING:
    from framework.training.run import Run

USAGE = """\
usage: ns-train METHOD [--data DIR] [flags] [FORMAT [format flags]]
       ns-train --load-config FILE [flags]     train as a recipe or an earlier run says
       ns-train --resume RUN_FOLDER [flags]    go on with a run that was stopped
"""


def main() -> None:
    """The ns-train command."""
    run_command(_command)


def _command(arguments: list[str]) -> None:
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_overview())
        return
    resumed, flags = _take(arguments, "--resume")
    recipe, flags = _take(flags, "--load-config")
    if resumed is not None:
        from framework.cli.session import resume

        resume(_parse_flags(_read_run(Path(resumed) / "config.yml"), flags))
        return
    if recipe is not None:
        run = _read_run(Path(recipe))
        if flags and flags[0] in registered("methods"):  # nerfstudio's order: METHOD ... --load-config FILE
            if flags[0] != run.method:
                raise ConfigError(f"{recipe} is for {run.method}, not for {flags[0]}")
            flags = flags[1:]
    else:
        run, flags = _default_run(flags[0]), flags[1:]
    from framework.cli.session import start

    start(_parse_flags(run, flags, fresh=True))


def _take(arguments: list[str], flag: str) -> tuple[str | None, list[str]]:
    """The value of `flag`, wherever it stands, and the other arguments."""
    for index, argument in enumerate(arguments):
        if argument == flag:
            if index + 1 == len(arguments):
                raise ConfigError(f"{flag} needs a path")
            return arguments[index + 1], arguments[:index] + arguments[index + 2 :]
        if argument.startswith(flag + "="):
            return argument[len(flag) + 1 :], arguments[:index] + arguments[index + 1 :]
    return None, arguments


def _overview() -> str:
    lines = [USAGE, "methods:"]
    lines += [f"  {name:<16}{summary(entry)}" for name, entry in registered("methods").items()]
    lines += ["", "data formats (recognised by themselves, or named after the flags):"]
    lines += [f"  {name:<16}{summary(entry)}" for name, entry in registered("dataparsers").items()]
    lines += ["", "ns-train METHOD --help shows the method's flags."]
    return "\n".join(lines)


def _default_run(method: str) -> Run:
    """A method with its default settings, its data not known yet."""
    if os.path.exists(method) and method not in registered("methods"):
        raise ConfigError(f"the method comes first, as in: ns-train nerfacto --data {shlex.quote(method)}")
    if method.startswith("-"):
        raise ConfigError(f"the method comes first, before {method}; ns-train --help lists them")
    entry_of("methods", method)  # a name that is unknown is told before anything heavy is imported
    from framework.base.registry import load_dataparser, load_method
    from framework.training.run import Run

    return Run(method, load_method(method).config, "", load_dataparser("procedural")(), Path())


def run_of(method: str, flags: list[str]) -> Run:
    """The run that `ns-train METHOD` with these flags would start."""
    return _parse_flags(_default_run(method), flags, fresh=True)


def _read_run(path: Path) -> Run:
    from framework.training.run import read_run

    return read_run(path)


def _parse_flags(run: Run, flags: list[str], fresh: bool = False) -> Run:
    """`run` with its settings and its data format's changed by command-line flags, in any order.

    A first look finds --data and the format's name; the second knows all flags.
    """
    import tyro

    from framework.base.registry import load_dataparser
    from framework.cli.flag_groups import grouped_flags
    from framework.data.data_folder import find_data
    from framework.training.run import run_folder

    if (answer := vis_answer(_take(flags, "--vis")[0] or "")) is not None:
        raise ConfigError(answer)
    options = (tyro.conf.FlagConversionOff, tyro.conf.ConsolidateSubcommandArgs)
    looked, unknown = tyro.cli(
        type(run.config),
        prog=f"ns-train {run.method}",
        args=[flag for flag in flags if flag not in ("-h", "--help")],
        default=run.config,
        config=options,
        return_unknown_args=True,
    )
    if (word := _stray_word(unknown)) is not None:
        _check_format(word, run.method)
        (data, named), flags = find_data(looked.data, word), _without(flags, word)
    elif not run.dataparser or looked.data != run.config.data:
        data, named = find_data(looked.data)
    else:
        data, named = looked.data, run.dataparser
    parser = run.parser if named == run.dataparser else load_dataparser(named)()

    # One flat set of flags: the method's and the data format's, so that their order does not matter.
    fields = [
        (name, Annotated[type(value), tyro.conf.arg(name="")])
        for name, value in (("method", run.config), ("format", parser))
    ]
    both = dataclasses.make_dataclass("Flags", fields)
    _check_for_nerfstudio(flags, run.method, [run.config, parser])
    parsed: Any = tyro.cli(
        both,
        prog=f"ns-train {run.method}",
        description=f"{summary(registered('methods')[run.method])}\n\nData format: {named}",
        args=flags,
        default=both(run.config, parser),
        config=options,
        registry=grouped_flags(run.method, run.config, named, parser),
    )
    config = dataclasses.replace(parsed.method, data=data)
    folder = run_folder(run.method, config) if fresh else run.folder
    return dataclasses.replace(run, config=config, dataparser=named, parser=parsed.format, folder=folder)


def _check_format(word: str, method: str) -> None:
    """Raises: ConfigError for a word that is no data format, with what was meant."""
    if word not in registered("dataparsers") and os.path.exists(word):
        raise ConfigError(f"'{word}' is no data format; the data is named by a flag: ns-train {method} --data {word}")
    entry_of("dataparsers", word)


def _check_for_nerfstudio(flags: list[str], method: str, settings: list[Any]) -> None:
    """Raises: ConfigError for a flag of nerfstudio's, with ours."""
    known = {name for value in settings for name in _flag_names(value)}
    for flag in flags:
        if flag.startswith("--") and (answer := flag_answer(flag, method, known)) is not None:
            raise ConfigError(answer)


def _flag_names(settings: Any, before: str = "--") -> Iterator[str]:
    """The flags that set the fields of a dataclass."""
    for field in dataclasses.fields(settings):
        value, name = getattr(settings, field.name), before + field.name.replace("_", "-")
        if dataclasses.is_dataclass(value):
            yield from _flag_names(value, f"{name}.")
        else:
            yield name


def _stray_word(unknown: list[str]) -> str | None:
    """The first word that is neither a flag nor a flag's value: the name of a data format."""
    for index, word in enumerate(unknown):
        if word.startswith("-"):
            continue
        before = unknown[index - 1] if index else ""
        if not before.startswith("--") or "=" in before or word in registered("dataparsers"):
            return word
    return None


def _without(flags: list[str], name: str) -> list[str]:
    """`flags` less the format's name: its first place that is not the value of a flag, else its last."""
    places = [index for index, flag in enumerate(flags) if flag == name]
    free = [index for index in places if index == 0 or not flags[index - 1].startswith("--") or "=" in flags[index - 1]]
    drop = (free or places[-1:])[0]
    return flags[:drop] + flags[drop + 1 :]


if __name__ == "__main__":
    main()
