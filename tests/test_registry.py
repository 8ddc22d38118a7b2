"""Names of methods and formats: they are loaded lazily, and broken ones are reported."""

import re
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from nerfloom import registry
from nerfloom.base.errors import ConfigError, DataError
from nerfloom.base.other_projects import ELSEWHERE
from nerfloom.training.data_folder import find_data

BUILT_IN = {
    "dnerf",
    "gaussian-splatting",
    "instant-ngp",
    "kilo-nerf",
    "kplanes",
    "mip-nerf",
    "mip-nerf-360",
    "moving-gaussians",
    "nerf-plus-plus",
    "nerf-w",
    "nerfacto",
    "neus",
    "pixel-nerf",
    "ref-nerf",
    "tensorf",
    "vanilla-nerf",
    "volsdf",
    "voxels",
    "zip-nerf",
}


def test_the_built_in_methods_are_registered_like_anybodys() -> None:
    assert set(registry.registered("methods")) >= BUILT_IN
    assert set(registry.registered("dataparsers")) >= {"blender", "dnerf", "procedural"}
    for name in BUILT_IN:
        assert registry.load_method(name).paper.startswith("arXiv:")


def test_summaries_are_the_modules_first_lines() -> None:
    import nerfloom.methods.instant_ngp

    assert nerfloom.methods.instant_ngp.__doc__ is not None
    entry = registry.registered("methods")["instant-ngp"]
    assert registry.summary(entry) == nerfloom.methods.instant_ngp.__doc__.split("\n")[0]


def test_unknown_names_get_the_nearest() -> None:
    with pytest.raises(ConfigError, match=r"unknown method 'instant-npg'\. Did you mean 'instant-ngp'"):
        registry.load_method("instant-npg")
    with pytest.raises(ConfigError, match=r"unknown data format 'xyz'\. Known: blender"):
        registry.load_dataparser("xyz")


@pytest.fixture
def environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Callable[..., Path]]:
    """Write modules into a folder of the path, and register the names of the variables."""

    def register(modules: dict[str, str] | None = None, **variables: str) -> Path:
        for name, text in (modules or {}).items():
            (tmp_path / f"{name}.py").write_text(text)
        monkeypatch.syspath_prepend(str(tmp_path))
        for name, value in variables.items():
            monkeypatch.setenv(f"NERFLOOM_{name.upper()}", value)
        registry.registered.cache_clear()
        return tmp_path

    yield register
    registry.registered.cache_clear()


def test_a_broken_plugin_is_named_and_the_rest_goes_on(environment: Callable[..., Path]) -> None:
    modules = {
        "broken_plugin": '"""Never loads."""\nraise RuntimeError("no such luck")\n',
        "leaving_plugin": '"""Leaves."""\nimport sys\nsys.exit(3)\n',
        "unreadable_plugin": "def (:\n",
        "wrong_plugin": '"""A number."""\nMETHOD = 3\n',
    }
    names = ["broken", "leaving", "unreadable", "wrong"]
    listed = ", ".join(f"{name}={name}_plugin:METHOD" for name in names) + ",gone=no_such_module_at_all:X"
    environment(modules, methods=listed)
    known = registry.registered("methods")
    assert registry.summary(known["broken"]) == "Never loads."
    assert "no_such_module_at_all was not found" in registry.summary(known["gone"])
    assert "cannot be read: SyntaxError" in registry.summary(known["unreadable"])
    for name, reason in (
        ("broken", "method 'broken' of NERFLOOM_METHODS cannot be loaded: RuntimeError: no such luck"),
        ("leaving", "cannot be loaded: SystemExit: 3"),
        ("unreadable", "cannot be loaded: SyntaxError"),
        ("gone", "'no_such_module_at_all'; add the folder of no_such_module_at_all to PYTHONPATH"),
        ("wrong", "wrong_plugin:METHOD is not a nerfloom.Method"),
    ):
        with pytest.raises(ConfigError, match=re.escape(reason)):
            registry.load_method(name)
    assert registry.load_method("instant-ngp").paper


METHOD_FILE = '''"""A method of the environment."""
from dataclasses import replace
from nerfloom.methods.instant_ngp import METHOD as NGP
METHOD = replace(NGP, paper="none", interface={interface})
'''


def test_methods_of_the_environment_and_their_interface(environment: Callable[..., Path]) -> None:
    modules = {
        "env_plugin": METHOD_FILE.format(interface=registry.INTERFACE["methods"]),
        "newer_plugin": METHOD_FILE.format(interface=registry.INTERFACE["methods"] + 1),
        "older_plugin": METHOD_FILE.format(interface=registry.INTERFACE["methods"] - 1),
    }
    environment(modules, methods="mine = env_plugin:METHOD ,newer=newer_plugin:METHOD,older=older_plugin:METHOD,")
    assert registry.load_method("mine").paper == "none"
    assert registry.summary(registry.registered("methods")["mine"]) == "A method of the environment."
    with pytest.raises(ConfigError, match=r"'newer' .* plugin interface 4; .*3; upgrade nerfloom"):
        registry.load_method("newer")
    with pytest.raises(ConfigError, match=r"'older' .* plugin interface 2; .*3; docs/plugins\.md"):
        registry.load_method("older")


@pytest.mark.parametrize("value", ["nonsense", "a=b", "=b:c", "a=:c", "a=b:"])
def test_an_unreadable_variable_is_told(environment: Callable[..., Path], value: str) -> None:
    environment(methods=value)
    with pytest.raises(ConfigError, match=f"NERFLOOM_METHODS holds '{value}'; it must be name=module:attribute"):
        registry.registered("methods")


def test_what_the_environment_names_cannot_hide_what_is_installed(environment: Callable[..., Path]) -> None:
    environment(methods="instant-ngp=other_module:METHOD,kplanes=nerfloom.methods.kplanes:METHOD")
    both = "it is registered by both nerfloom and NERFLOOM_METHODS; uninstall or rename one of them"
    assert registry.summary(registry.registered("methods")["instant-ngp"]) == f"({both})"
    with pytest.raises(ConfigError, match=f"method 'instant-ngp' cannot be used: {both}"):
        registry.load_method("instant-ngp")
    assert registry.load_method("kplanes").paper  # named twice, but for the same thing


def install(folder: Path, package: str, methods: str) -> None:
    """Metadata of an installed package with its entry points."""
    metadata = folder / f"{package.replace('-', '_')}-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text(f"[nerfloom.methods]\n{methods}\n")


def test_two_packages_with_one_name_are_refused_and_the_rest_goes_on(
    environment: Callable[..., Path], tmp_path: Path
) -> None:
    install(tmp_path, "cubes-one", "cubes = cubes_one:METHOD")
    install(tmp_path, "cubes-two", "cubes = cubes_two:METHOD")
    environment()
    with pytest.raises(ConfigError, match="method 'cubes' cannot be used: it is registered by both") as raised:
        registry.load_method("cubes")
    assert set(re.findall(r"cubes-\w+", str(raised.value))) == {"cubes-one", "cubes-two"}
    assert registry.load_method("kplanes").paper


def test_an_entry_point_that_names_no_attribute_is_told_and_the_rest_goes_on(
    environment: Callable[..., Path], tmp_path: Path
) -> None:
    install(tmp_path, "half-a-plugin", "half = only_a_module")
    environment()
    why = "half-a-plugin registers 'only_a_module', which is not module:attribute"
    assert registry.summary(registry.registered("methods")["half"]) == f"({why})"
    with pytest.raises(ConfigError, match=f"method 'half' cannot be used: {why}"):
        registry.load_method("half")
    assert registry.load_method("kplanes").paper


def test_methods_that_live_elsewhere(environment: Callable[..., Path]) -> None:
    with pytest.raises(ConfigError, match=r"no method 'generfacto': .*pip install nerfstudio, ns-train generfacto"):
        registry.load_method("generfacto")
    with pytest.raises(ConfigError, match=r"no method 'splatfacto': here it is called 'gaussian-splatting'"):
        registry.load_method("splatfacto")
    assert not set(ELSEWHERE) & set(registry.registered("methods"))
    environment(
        {"env_plugin": METHOD_FILE.format(interface=registry.INTERFACE["methods"])},
        methods="splatfacto=env_plugin:METHOD",
    )
    assert registry.load_method("splatfacto").paper == "none"


def test_what_is_said_to_be_here_is_here() -> None:
    """Names in quotation marks are methods of ours."""
    named = {name for said in ELSEWHERE.values() for name in re.findall(r"'([a-z0-9-]+)'", said)}
    assert named == BUILT_IN - {"tensorf"}
    assert named <= set(registry.registered("methods"))


FORMAT_FILE = '''"""A data format that looks at nothing without failing."""
from nerfloom.dataparsers.procedural import Procedural
class Format(Procedural):
    @classmethod
    def recognizes(cls, path):
        raise OSError("the disk is on fire")
'''


def test_formats_that_fail_do_not_stop_others(
    environment: Callable[..., Path], shared_tiny: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    modules = {"burning": FORMAT_FILE, "broken_format": "raise RuntimeError('never')\n"}
    environment(modules, dataparsers="burning=burning:Format,never=broken_format:X")
    assert find_data(shared_tiny) == (shared_tiny, "blender")
    printed = capsys.readouterr()
    assert "data format 'burning' failed to examine" in printed.out + printed.err
    assert "the disk is on fire; it is ignored" in (printed.out + printed.err).replace("\n", " ")
    assert "data format 'never' of NERFLOOM_DATAPARSERS cannot be loaded" in (printed.out + printed.err)


def test_recognition(shared_tiny: Path, tmp_path: Path) -> None:
    assert find_data(shared_tiny) == (shared_tiny, "blender")
    assert find_data(None) == (None, "procedural")
    with pytest.raises(DataError, match="there is no such folder"):
        find_data(tmp_path / "nowhere")
    with pytest.raises(DataError, match=r"a{100}\.\.\.$"):  # an error of a line, however long the name
        find_data(tmp_path / ("a" * 5000))
    with pytest.raises(DataError, match="format is unknown"):
        find_data(tmp_path)
