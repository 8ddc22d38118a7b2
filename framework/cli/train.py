"""The command `ns-train`: training of a method on a data set."""

from __future__ import annotations

import dataclasses
import os
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from nerfloom.base.console import say
from nerfloom.base.errors import ConfigError, FlagError
from nerfloom.base.from_nerfstudio import flag_answer, taken, vis_answer
from nerfloom.cli.common import entry_point, take
from nerfloom.cli.flags import HELP, read_flags
from nerfloom.registry import entry_of, registered, summary

if TYPE_CHECKING:
    from nerfloom.training.run import Run

USAGE = """\
usage: ns-train METHOD [--data DIR] [flags] [FORMAT [format flags]]
       ns-train --load-config FILE [flags]     train with the settings of a recipe or an earlier run
       ns-train --resume RUN_FOLDER [flags]    continue a run that was stopped
       ns-train --version --environment        print the details for an error report

  ns-train instant-ngp --max-seconds 60                               the scene that comes with Nerfloom
  ns-train gaussian-splatting --data data/mine --max-seconds 300      a phone capture, after ns-process-data
"""


@entry_point
def main(arguments: list[str]) -> None:
    """Run ns-train on the `arguments` of the process."""
    if not arguments or arguments[0] in HELP:
        print(_overview())
        return
    from nerfloom.cli.train_paths import check_paths  # here, so that the help above is fast
    from nerfloom.training.run_path import config_file

    resumed, flags = take(arguments, "--resume")
    recipe, flags = take(flags, "--load-config")
    if resumed is not None:
        found = config_file(Path(resumed))
        check_paths(flags, found, found.parent)
        from nerfloom.cli.session import resume

        resume(_parse_flags(_read_run(found), flags))
        return
    if recipe is not None:
        found = config_file(Path(recipe))
        check_paths(flags, found)
        run = _read_run(found)
        if flags and flags[0] in registered("methods"):  # nerfstudio's order: METHOD ... --load-config FILE
            if flags[0] != run.method:
                raise ConfigError(f"{recipe} is for {run.method}, not for {flags[0]}")
            flags = flags[1:]
    else:
        method, flags = flags[0], flags[1:]
        _check_method(method)
        check_paths(flags)
        run = _default_run(method)
    from nerfloom.cli.session import start

    start(_parse_flags(run, flags, fresh=True))


def _overview() -> str:
    kinds = {kind: registered(kind) for kind in ("methods", "dataparsers")}
    width = 2 + max(len(name) for entries in kinds.values() for name in entries)
    listed = {
        kind: [f"  {name:<{width}}{summary(entry)}" for name, entry in entries.items()]
        for kind, entries in kinds.items()
    }
    lines = [USAGE, "methods:", *listed["methods"]]
    lines += ["", "data formats (recognised automatically, or named after the flags):", *listed["dataparsers"]]
    lines += [
        "",
        "ns-train METHOD --help shows the everyday flags, --help-all all flags of the method and the data format.",
    ]
    return "\n".join(lines)


def _check_method(method: str) -> None:
    """Raise ConfigError if `method` is not a method, before slow imports."""
    if os.path.exists(method) and method not in registered("methods"):
        raise ConfigError(f"the method comes first, as in: ns-train nerfacto --data {shlex.quote(method)}")
    if method.startswith("-"):
        raise ConfigError(f"the method comes first, before {method}; ns-train --help lists them")
    entry_of("methods", method)


def _default_run(method: str) -> Run:
    """Return a run of a method with its default settings, without data."""
    from nerfloom.registry import load_dataparser, load_method
    from nerfloom.training.run import Run

    return Run(method, load_method(method).config, "", load_dataparser("procedural")(), Path())


def run_of(method: str, flags: list[str]) -> Run:
    """Return the run that `ns-train` with this `method` and these `flags` would start.

    Raises:
        ConfigError: if the method or a flag is unknown or invalid.
    """
    _check_method(method)
    return _parse_flags(_default_run(method), flags, fresh=True)


def _read_run(path: Path) -> Run:
    from nerfloom.training.run import read_run

    return read_run(path)


def _parse_flags(run: Run, flags: list[str], fresh: bool = False) -> Run:
    """Return `run` with the settings of the method and the data format changed by flags, in any order.

    The flags include the data format's, so that --data and the format's name must be found first.
    """
    from nerfloom.base.step_limit import limited_as_given
    from nerfloom.registry import load_dataparser
    from nerfloom.training.data_folder import find_data
    from nerfloom.training.run import run_folder

    flags, notes = taken(flags, set(_flag_names(run.config)))
    for note in notes:
        say(note)
    if (answer := vis_answer(take(flags, "--vis")[0] or "")) is not None:
        raise FlagError(answer)
    if _are_pairs(flags):
        given, word = take(flags, "--data")[0], None
        asked = run.config.data if given is None else None if given == "None" else Path(given)
    else:  # a word may be a flag's value or a format's name, depending on the flags' types
        asking_nothing = [flag for flag in flags if flag not in HELP]
        initial, unknown = _parsed(run, asking_nothing, {"method": run.config}, return_unknown_args=True)
        asked, word = initial.method.data, _stray_word(unknown)
    if word is not None:
        _check_format(word, run.method)
        (data, named), flags = find_data(asked, word), _without(flags, word)
    elif not run.dataparser or asked != run.config.data:
        data, named = find_data(asked)
    else:
        data, named = asked, run.dataparser
    parser = run.parser if named == run.dataparser else load_dataparser(named)()

    _check_for_nerfstudio(flags, run.method, [run.config, parser])
    run = dataclasses.replace(run, dataparser=named, parser=parser)
    description = _description(run, flags)
    parsed = _parsed(run, flags, {"method": run.config, "format": parser}, description=description)
    config = limited_as_given(dataclasses.replace(parsed.method, data=data), _names(flags))
    folder = run_folder(run.method, config) if fresh else run.folder
    return dataclasses.replace(run, config=config, parser=parsed.format, folder=folder)


def _parsed(run: Run, flags: list[str], settings: dict[str, Any], description: str = "", **options: Any) -> Any:
    """Return `settings` changed by `flags`. All flags form one flat set, so that their order does not matter.

    Args:
        run: the run, for names and titles.
        flags: the flags.
        settings: settings of the method and of the data format, by name.
        description: first lines of the help.
        options: further arguments of `tyro.cli`.

    Raises:
        FlagError: if a flag is unknown or has an invalid value.
    """
    import tyro

    from nerfloom.cli.flag_groups import grouped_flags

    # Without a help text of their own, tyro would look for one in the source of a class that has none.
    unnamed = tyro.conf.arg(name="", help="")
    fields = [(name, Annotated[type(value), unnamed]) for name, value in settings.items()]
    kind = dataclasses.make_dataclass("Flags", fields)
    return read_flags(
        kind,
        f"ns-train {run.method}",
        flags,
        default=kind(**settings),
        description=description,
        config=(tyro.conf.FlagConversionOff, tyro.conf.CascadeSubcommandArgs),
        registry=grouped_flags(run.method, run.config, run.dataparser, run.parser, _asks_for_help(flags)),
        **options,
    )


def _description(run: Run, flags: list[str]) -> str:
    """Return the first lines of the help; empty if flags do not ask for help, as the method's file must be parsed."""
    if set(HELP).isdisjoint(flags):
        return ""
    lines = f"{summary(registered('methods')[run.method])}\n\nData format: {run.dataparser}"
    return lines + ("\n\nThe everyday flags; --help-all shows all, in groups." if _asks_for_help(flags) else "")


def _asks_for_help(flags: list[str]) -> bool:
    """Return whether the flags ask for the short help."""
    return bool({"-h", "--help"} & set(flags)) and "--help-all" not in flags


def _are_pairs(flags: list[str]) -> bool:
    """Return whether all flags are `--name value` or `--name=value`, with at most one --data."""
    index = 0
    while index < len(flags):
        has_value = "=" in flags[index]
        if not flags[index].startswith("--") or flags[index] in HELP:
            return False
        if not has_value and (index + 1 == len(flags) or flags[index + 1].startswith("-")):
            return False
        index += 1 if has_value else 2
    data = [flag for flag in flags if flag.partition("=")[0] == "--data"]
    return len(data) <= 1 and not any(word in registered("dataparsers") for word in flags)


def _check_format(word: str, method: str) -> None:
    """Raise ConfigError if `word` is not a data format."""
    if word not in registered("dataparsers") and os.path.exists(word):
        command = f"ns-train {method} --data {shlex.quote(word)}"
        raise ConfigError(f"'{word}' is not a data format; pass data with a flag: {command}")
    entry_of("dataparsers", word)


def _check_for_nerfstudio(flags: list[str], method: str, settings: list[Any]) -> None:
    """Raise ConfigError for a flag that only nerfstudio has, naming the equivalent one."""
    names = {name for value in settings for name in _flag_names(value)}
    for flag in flags:
        if flag.startswith("--") and (answer := flag_answer(flag, method, names)) is not None:
            raise FlagError(answer)


def _names(flags: list[str]) -> set[str]:
    """Return the names of the settings that flags set."""
    return {flag[2:].partition("=")[0].replace("-", "_") for flag in flags if flag.startswith("--")}


def _flag_names(settings: Any, prefix: str = "--") -> Iterator[str]:
    """Yield the flags that set the fields of a dataclass."""
    for field in dataclasses.fields(settings):
        value, name = getattr(settings, field.name), prefix + field.name.replace("_", "-")
        if dataclasses.is_dataclass(value):
            yield from _flag_names(value, f"{name}.")
        else:
            yield name


def _stray_word(unknown: list[str]) -> str | None:
    """Return the first word that is neither a flag nor a flag's value: the name of a data format."""
    for index, word in enumerate(unknown):
        if word.startswith("-"):
            continue
        before = unknown[index - 1] if index else ""
        if not before.startswith("--") or "=" in before or word in registered("dataparsers"):
            return word
    return None


def _without(flags: list[str], name: str) -> list[str]:
    """Return `flags` without the format's name, preferably an occurrence that is not the value of a flag."""
    same = [index for index, flag in enumerate(flags) if flag == name]
    free = [index for index in same if index == 0 or not flags[index - 1].startswith("--") or "=" in flags[index - 1]]
    drop = (free or same[-1:])[0]
    return flags[:drop] + flags[drop + 1 :]


if __name__ == "__main__":
    main()
