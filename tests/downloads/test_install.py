"""`ns-download-data`, from a server on the loopback to folders that ns-train recognises."""

import hashlib
import io
import zipfile
from pathlib import Path

import pytest

from nerfloom.base.errors import ConfigError, DataError
from nerfloom.cli import download_data
from nerfloom.downloads import install as installing
from nerfloom.downloads.catalogue import DATASETS, Archive, Dataset, Source
from nerfloom.downloads.install import announce, install
from nerfloom.training.data_folder import find_data
from tests.conftest import Refused
from tests.downloads.server import Served, serving

ROOT = Path(__file__).parents[2]


def zipped(scene: Path, *places: str, extra: dict[str, bytes] | None = None) -> bytes:
    """A zip file with the files of a folder, at each of several places."""
    written = io.BytesIO()
    with zipfile.ZipFile(written, "w") as archive:
        for place in places:
            for path in sorted(scene.rglob("*")):
                if path.is_file():
                    archive.write(path, f"{place}/{path.relative_to(scene).as_posix()}")
        for name, content in (extra or {}).items():
            archive.writestr(name, content)
    return written.getvalue()


def dataset_of(*archives: Archive) -> Dataset:
    return Dataset("balls (us, today)", "https://example.org/balls", "CC0", archives)


@pytest.fixture
def balls(shared_tiny: Path) -> bytes:
    """Two scenes in the layout of NeRF-Synthetic's archive, with macOS's hidden files and a text about both."""
    extra = {"__MACOSX/balls/red/._x.png": b"?", "balls/.DS_Store": b"?", "balls/README.txt": b"CC0"}
    return zipped(shared_tiny, "balls/red", "balls/blue", extra=extra)


def test_scenes_are_put_where_ns_train_finds_them(balls: bytes, tmp_path: Path) -> None:
    served = Served(balls, breaks_after=[1000])
    with serving({"/balls.zip": served}) as address:
        source = Source(f"{address}/balls.zip", hashlib.sha256(balls).hexdigest())
        dataset = dataset_of(Archive("balls.zip", ("red", "blue"), (source,)))
        folders = install("balls", dataset, tmp_path / "data", ["red"])
        assert folders == [tmp_path / "data" / "balls" / "red"]
        assert find_data(folders[0]) == (folders[0], "blender")
        assert sorted(path.name for path in (tmp_path / "data" / "balls").iterdir()) == ["README.txt", "red"]
        assert sorted(path.name for path in (tmp_path / "data" / ".downloads").iterdir()) == [".lock"]
        before = len(served.asked)
        install("balls", dataset, tmp_path / "data", ["red"])
        assert len(served.asked) == before  # it is there
        marked = folders[0] / "mine.txt"
        marked.write_text("kept")
        assert len(install("balls", dataset, tmp_path / "data", keep_archives=True)) == 2
    assert marked.read_text() == "kept"
    assert (tmp_path / "data" / ".downloads" / "balls.zip").read_bytes() == balls


def test_the_next_source_is_tried(balls: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with serving({"/b": Served(balls)}) as address:
        sources = (Source(f"{address}/gone"), Source(f"{address}/b", "0" * 64), Source(f"{address}/b"))
        install("balls", dataset_of(Archive("balls.zip", ("red", "blue"), sources)), tmp_path)
    said = capsys.readouterr().err
    assert "404 Not Found; trying the next source" in said
    assert "it was removed; trying the next source" in said
    assert (tmp_path / "balls" / "blue" / "transforms_train.json").is_file()


def test_without_any_source_the_way_by_hand_is_said(balls: bytes, tmp_path: Path) -> None:
    with serving({}) as address:
        dataset = dataset_of(Archive("balls.zip", ("red", "blue"), (Source(f"{address}/gone"),)))
        with pytest.raises(DataError, match=r"404 .*balls.zip .*https://example.org/balls"):
            install("balls", dataset, tmp_path / "data")
    by_hand = tmp_path / "balls.zip"
    by_hand.write_bytes(balls)
    assert len(install("balls", dataset, tmp_path / "data", archive=by_hand)) == 2
    assert by_hand.exists()


def test_a_scene_alone_in_its_archive_may_have_another_folder(shared_tiny: Path, tmp_path: Path) -> None:
    for number, place in enumerate(("whatever", "red", "deep/red")):
        with serving({"/red.zip": Served(zipped(shared_tiny, place))}) as address:
            dataset = dataset_of(Archive("red.zip", ("red",), (Source(f"{address}/red.zip"),)))
            (folder,) = install("balls", dataset, tmp_path / str(number))
        assert find_data(folder)[1] == "blender"


def test_the_outermost_folder_is_the_scene(shared_tiny: Path, tmp_path: Path) -> None:
    """Tanks and Temples has a scene 'train', which is also a name of the images' folder of other scenes."""
    with serving({"/x.zip": Served(zipped(shared_tiny, "tandt/truck", "tandt/train"))}) as address:
        dataset = dataset_of(Archive("x.zip", ("train", "truck"), (Source(f"{address}/x.zip"),)))
        truck, train = install("tandt", dataset, tmp_path, ["truck", "train"])
    for folder in (truck, train):
        assert len(list((folder / "train").glob("*.png"))) == 10


def test_an_archive_with_something_else_leaves_nothing(tmp_path: Path) -> None:
    bad = io.BytesIO()
    with zipfile.ZipFile(bad, "w") as archive:
        archive.writestr("red/notes.txt", "no scene")
    with serving({"/x.zip": Served(bad.getvalue())}) as address:
        dataset = dataset_of(Archive("x.zip", ("red",), (Source(f"{address}/x.zip"),)))
        with pytest.raises(DataError, match="the format of red is unknown; the archive has changed"):
            install("balls", dataset, tmp_path)
    assert not (tmp_path / "balls").exists()
    assert not (tmp_path / ".downloads" / "x.zip.unpacked").exists()


def test_a_path_outside_writes_nothing(shared_tiny: Path, tmp_path: Path) -> None:
    bad = zipped(shared_tiny, "red", extra={"../../../outside.txt": b"out"})
    with serving({"/x.zip": Served(bad)}) as address:
        dataset = dataset_of(Archive("x.zip", ("red",), (Source(f"{address}/x.zip"),)))
        with pytest.raises(DataError, match="is unsafe; nothing was unpacked"):
            install("balls", dataset, tmp_path / "a" / "b" / "c")
    assert list(tmp_path.rglob("outside.txt")) == []
    assert not (tmp_path / "a" / "b" / "c" / "balls").exists()


def test_scenes_that_are_missing_are_named(shared_tiny: Path, tmp_path: Path) -> None:
    archive = tmp_path / "x.zip"
    archive.write_bytes(zipped(shared_tiny, "red"))
    dataset = dataset_of(Archive("x.zip", ("red", "blue"), ()))
    with pytest.raises(DataError, match="lacks blue; select scenes that it contains with --scenes"):
        install("balls", dataset, tmp_path / "data", archive=archive)
    assert (tmp_path / "data" / "balls" / "red").is_dir()
    with pytest.raises(ConfigError, match="there is no such file"):
        install("balls", dataset, tmp_path / "data", archive=tmp_path / "no.zip")


def test_two_at_once_do_not_mix(tmp_path: Path) -> None:
    with installing.sole_user(tmp_path / ".downloads"), pytest.raises(ConfigError, match="is in use by process"):
        install("blender", DATASETS["blender"], tmp_path)


def test_licence_size_and_source_are_said_before(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    announce("blender", DATASETS["blender"], tmp_path, ["lego"])
    said = capsys.readouterr().err
    assert "licence: Creative Commons, each model its own (lego: BY-NC" in said
    untried = "an address that nerfloom's authors have not tried"
    assert f"nerf_synthetic.zip, about 1.7 GB, from github.com ({untried})" in said
    (tmp_path / "blender" / "lego").mkdir(parents=True)
    announce("blender", DATASETS["blender"], tmp_path, ["lego"])
    assert "to download" not in capsys.readouterr().err


def test_the_command_from_end_to_end(
    balls: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with serving({"/b": Served(balls)}) as address:
        dataset = dataset_of(Archive("balls.zip", ("red", "blue"), (Source(f"{address}/b"),), 0.1))
        monkeypatch.setitem(DATASETS, "balls", dataset)
        download_data.main.__wrapped__(["balls", "--save-dir", str(tmp_path), "--scenes", "blue"])
    printed = capsys.readouterr()
    folder = tmp_path / "balls" / "blue"
    assert printed.out.splitlines() == [str(folder), f"Next: ns-train instant-ngp --data {folder}"]
    assert printed.err.index("licence: CC0") < printed.err.index("states no checksum")
    with pytest.raises(SystemExit, match="0"):
        download_data.main.__wrapped__([])
    listed = capsys.readouterr().out
    assert all(f"  {name:<18} {dataset.title}" in listed for name, dataset in DATASETS.items())
    assert "0.1 GB" in listed


@pytest.mark.parametrize(
    ("words", "answer"),
    [
        (["blendr"], "unknown data set 'blendr'. Did you mean 'blender'?"),
        (["blender", "--scenes", "leggo"], "blender has no scene 'leggo'. Did you mean 'lego'?"),
        (["nerfstudio", "--capture-name", "poster"], "--capture-name is nerfstudio's; here it is --scenes"),
    ],
)
def test_mistakes_are_one_line(words: list[str], answer: str, refused: Refused) -> None:
    assert answer in refused(download_data.main, *words, status=2 if "--capture-name" in words else 1)


def test_the_table_of_sources_is_the_catalogue() -> None:
    """docs/notes/data_sources.md lists every address, marked where it was never tried, with its sum and licence."""
    lines = ["| data set | archive | size | source | SHA-256 | tried |", "|---|---|---|---|---|---|"]
    for name, dataset in DATASETS.items():
        for archive in dataset.archives:
            size = "unknown" if archive.gigabytes is None else f"{archive.gigabytes:g} GB"
            for source in archive.sources:
                stated = (source.sha256 or "none stated", source.tried or "no")
                lines.append("| " + " | ".join((name, archive.name, size, f"<{source.url}>", *stated)) + " |")
    text = (ROOT / "docs" / "notes" / "data_sources.md").read_text(encoding="utf-8")
    assert "\n".join(lines) in text


def test_the_catalogue_is_consistent() -> None:
    for name, dataset in DATASETS.items():
        assert name == name.lower()
        assert len(set(dataset.scenes)) == len(dataset.scenes) > 0
        assert len({archive.name for archive in dataset.archives}) == len(dataset.archives)
        for source in (source for archive in dataset.archives for source in archive.sources):
            assert source.url.startswith("https://")
            assert source.sha256 is None or len(bytes.fromhex(source.sha256)) == 32
