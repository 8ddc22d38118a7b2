"""SOG files: bytes by hand are the truth, written Gaussians come back as exact as stated, and damage is refused."""

import io
import json
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from nerfloom.base.errors import ConfigError, DataError
from nerfloom.splats.files import is_splat_file, read_gaussians, write_gaussians
from nerfloom.splats.gaussian_limit import with_degree
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.look import ELSEWHERE, OURS, Look
from nerfloom.splats.sog_writing import encoded_sog, morton_order
from tests.splats.test_files import LOOKS, some
from tests.splats.test_foreign_files import angles


def webp(pixels: object, width: int, kind: str = "WEBP") -> bytes:
    """An image of one or several rows of R, G, B, A."""
    stream = io.BytesIO()
    image = Image.fromarray(np.array(pixels, np.uint8).reshape(-1, width, 4))
    image.save(stream, format=kind, **({"lossless": True, "exact": True} if kind == "WEBP" else {}))
    return stream.getvalue()


def by_hand(kind: str = "WEBP") -> tuple[dict[str, Any], dict[str, bytes]]:
    """meta.json and the images of two Gaussians of degree 1."""
    images = {
        "low.webp": webp([[255, 0, 0x34, 255], [0, 0, 0, 255]], 2, kind),
        "high.webp": webp([[255, 0, 0x12, 255], [0, 255, 0, 255]], 2, kind),
        "scales.webp": webp([[10, 20, 30, 255], [0, 0, 0, 255]], 2, kind),
        "quats.webp": webp([[191, 128, 64, 253], [128, 128, 128, 252]], 2, kind),
        "sh0.webp": webp([[0, 128, 255, 51], [1, 2, 3, 0]], 2, kind),
        "entries.webp": webp([[index, 64 + index, (128 + index) % 256, 255] for index in range(192)], 192, kind),
        "labels.webp": webp([[1, 0, 0, 255], [0, 0, 0, 255]], 2, kind),
    }
    meta = {
        "version": 2,
        "count": 2,
        "means": {"mins": [-1, 0, -2.0], "maxs": [1, 2, 0.5], "files": ["low.webp", "high.webp"]},
        "scales": {"codebook": [index / 10 - 12 for index in range(256)], "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": [index / 100 - 1 for index in range(256)], "files": ["sh0.webp"]},
        "shN": {
            "count": 2,
            "bands": 1,
            "codebook": [(index - 128) / 64 for index in range(256)],
            "files": ["entries.webp", "labels.webp"],
        },
    }
    return meta, images


def write(file: Path, meta: object, images: dict[str, bytes], how: int = zipfile.ZIP_STORED) -> Path:
    with zipfile.ZipFile(file, "w", how) as archive:
        for name, content in {**images, "meta.json": json.dumps(meta)}.items():
            archive.writestr(name, content)
    return file


@pytest.mark.parametrize("how", ["stored", "deflated", "folder", "png"])
def test_what_is_in_a_file_by_hand(tmp_path: Path, how: str) -> None:
    meta, images = by_hand("PNG" if how == "png" else "WEBP")
    file = tmp_path / ("meta.json" if how == "folder" else "a.sog")
    if how == "folder":
        file.write_text(json.dumps(meta))
        for name, content in images.items():
            (tmp_path / name).write_bytes(content)
    else:
        write(file, meta, images, zipfile.ZIP_DEFLATED if how == "deflated" else zipfile.ZIP_STORED)
    assert is_splat_file(file)
    g, look = read_gaussians(file)
    assert look == ELSEWHERE
    last = -2 + 2.5 * 0x1234 / 65535
    expected = [[math.expm1(1), 0.0, -math.expm1(-last)], [-math.expm1(1), math.expm1(2 * 0xFF00 / 65535)]]
    torch.testing.assert_close(g.means[0], torch.tensor(expected[0]))
    torch.testing.assert_close(g.means[1, :2], torch.tensor(expected[1]))
    torch.testing.assert_close(g.log_scales[0], torch.tensor([-11.0, -10.0, -9.0]))
    others = [(value / 127.5 - 1) / math.sqrt(2) for value in (191, 128, 64)]
    largest = math.sqrt(1 - sum(value * value for value in others))
    torch.testing.assert_close(g.rotations[0], torch.tensor([others[0], largest, others[1], others[2]]))
    assert float(g.rotations[1, 0]) == pytest.approx(1, abs=1e-3)
    torch.testing.assert_close(g.colors[0], torch.tensor([-1.0, 0.28, 1.55]))
    assert g.logits.sigmoid().tolist() == pytest.approx([0.2, 0.25 / 255], abs=1e-6)
    # The second entry's pixels are 3, 4 and 5; red is R of each.
    codes = torch.tensor([[3.0, 4, 5], [67, 68, 69], [131, 132, 133]])
    torch.testing.assert_close(g.harmonics[0], (codes - 128) / 64)
    torch.testing.assert_close(g.harmonics[1], (codes - 3 - 128) / 64)


def test_a_codebook_without_its_first_number(tmp_path: Path) -> None:
    """Early programs wrote it so: the number is a step before the second, as in PlayCanvas's engine."""
    meta, images = by_hand()
    whole = read_gaussians(write(tmp_path / "a.sog", meta, images)).gaussians
    codes = meta["scales"]["codebook"]
    codes[0] = None
    read = read_gaussians(write(tmp_path / "b.sog", meta, images)).gaussians
    torch.testing.assert_close(read.log_scales[0], whole.log_scales[0], rtol=0, atol=0)
    first = codes[1] - (codes[255] - codes[1]) / 255  # the second Gaussian's indices are 0
    torch.testing.assert_close(read.log_scales[1], torch.full((3,), first))


def matched(read: Gaussians, given: Gaussians) -> Gaussians:
    """The given Gaussians in the order of the read ones: each is the nearest."""
    nearest = torch.cdist(read.means.double(), given.means.double()).argmin(1)
    assert nearest.sort().values.tolist() == list(range(len(given)))
    return given[nearest]


def logs(points: torch.Tensor) -> torch.Tensor:
    return points.double().sign() * points.double().abs().log1p()


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("count", [1, 700, 3000])
def test_sog_is_as_exact_as_stated(tmp_path: Path, count: int, degree: int) -> None:
    given, file = some(count, degree), tmp_path / "a.sog"
    said = write_gaussians(file, given)
    read = read_gaussians(file).gaussians
    assert read.degree == degree
    expected = matched(read, given)
    spread = logs(given.means).amax(0) - logs(given.means).amin(0)
    off = (logs(read.means) - logs(expected.means)).abs()
    print(f"log positions are off by up to {float(off.max()):.2g}")
    assert bool((off <= spread / 131070 + 2e-7).all())
    stated = float(said[-1].partition(" by up to ")[2].partition(";")[0])
    assert stated == pytest.approx(float((read.means - expected.means).double().abs().max()), rel=0.06, abs=3e-6)
    assert f"has the size {given.typical_size:.2g}" in said[-1]
    for name in ("log_scales", "colors"):
        one, other = getattr(read, name), getattr(expected, name)
        print(f"{name} are off by up to {float((one - other).abs().max()):.2g}")
        assert float((one - other).abs().max()) <= float(other.max() - other.min()) / 255 + 1e-5
    assert float((read.logits.sigmoid() - expected.logits.sigmoid()).abs().max()) <= 0.5 / 255 + 1e-6
    assert float(angles(read, expected).max()) < 1.2
    if not degree:
        assert len(said) == 1
        return
    error = (read.harmonics - expected.harmonics).double()
    rms = float(error.square().mean().sqrt())
    assert f"for {count:,} Gaussians" in said[0]
    assert float(said[0].rsplit(" ", 1)[1]) == pytest.approx(rms, rel=0.06, abs=1e-6)
    if count <= 1024:  # each has its own
        spread_of_all = float(given.harmonics.max() - given.harmonics.min())
        assert float(error.abs().max()) <= spread_of_all / 255 + 1e-5
    else:
        assert int(said[0].split()[2].replace(",", "")) <= 2048
        assert rms < 0.8 * float(given.harmonics.std())


def test_the_same_gaussians_give_the_same_bytes() -> None:
    assert encoded_sog(some(2000, 1)) == encoded_sog(some(2000, 1))


def test_opacity_0_keeps_its_colour(tmp_path: Path) -> None:
    """Colours of transparent pixels are lost unless WebP is told otherwise."""
    given = some(20, 0)
    given.logits[:] = -30
    write_gaussians(tmp_path / "a.sog", given)
    read = read_gaussians(tmp_path / "a.sog").gaussians
    spread = float(given.colors.max() - given.colors.min())
    assert float((read.colors - matched(read, given).colors).abs().max()) <= spread / 255 + 1e-5


def test_images_have_the_layout_of_the_specification(tmp_path: Path) -> None:
    """Read by Pillow alone: sizes, channels that nobody needs, and the names in meta.json."""
    given = some(100, 2)
    write_gaussians(tmp_path / "a.sog", given, look=Look(antialiased=True))
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        assert all(entry.compress_type == zipfile.ZIP_STORED for entry in archive.infolist())
        meta = json.loads(archive.read("meta.json"))
        images = {
            name: np.asarray(Image.open(io.BytesIO(archive.read(name))).convert("RGBA"))
            for name in archive.namelist()
            if name != "meta.json"
        }
    assert (meta["version"], meta["count"], meta["model"]) == (2, 100, "antialiased")
    assert meta["antialias"] is True
    assert meta["means"]["files"] == ["means_l.webp", "means_u.webp"]
    assert [len(meta[key]["codebook"]) for key in ("scales", "sh0", "shN")] == [256] * 3
    assert (meta["shN"]["count"], meta["shN"]["bands"]) == (100, 2)
    for name, image in images.items():
        assert image.shape == ((2, 64 * 8, 4) if name == "shN_centroids.webp" else (12, 12, 4)), name
    assert set(images["quats.webp"].reshape(-1, 4)[:100, 3]) <= {252, 253, 254, 255}
    assert (images["means_l.webp"][..., 3] == 255).all()
    # The least x is 0, the most 65535.
    x = images["means_l.webp"][..., 0].reshape(-1)[:100] + 256 * images["means_u.webp"][..., 0].reshape(-1)[
        :100
    ].astype(int)
    assert (x.min(), x.max()) == (0, 65535)


def test_morton_order() -> None:
    corners = np.array([[x, y, z] for x in (0.0, 2.0) for y in (1.0, 5.0) for z in (-1.0, 0.0)])
    expected = sorted(range(8), key=lambda index: tuple(corners[index][::-1]))
    assert morton_order(corners).tolist() == expected
    assert morton_order(np.ones((5, 3))).tolist() == [0, 1, 2, 3, 4]
    near = np.random.default_rng(0).uniform(size=(4000, 3))
    steps = np.linalg.norm(np.diff(near[morton_order(near)], axis=0), axis=1)
    assert steps.mean() < 0.3 * np.linalg.norm(np.diff(near, axis=0), axis=1).mean()


@pytest.mark.parametrize("look", LOOKS)
def test_files_say_how_gaussians_are_drawn(tmp_path: Path, look: Look) -> None:
    write_gaussians(tmp_path / "a.sog", some(20), look=look)
    assert read_gaussians(tmp_path / "a.sog").look == look


def test_models_of_other_programs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    meta, images = by_hand()
    for entry, look in (
        ({"model": "antialiased"}, Look(True, sort="depth")),
        ({"antialias": True}, Look(True, sort="depth")),
        ({"model": "default", "extras": {"comments": ["SplatSort: distance", 3]}}, OURS),
        ({"extras": [1]}, ELSEWHERE),
    ):
        assert read_gaussians(write(tmp_path / "a.sog", {**meta, **entry}, images)).look == look
    assert "warning" not in capsys.readouterr().err
    assert read_gaussians(write(tmp_path / "a.sog", {**meta, "model": ["x"]}, images)).look == ELSEWHERE
    assert "is of the model ['x'], which is not known" in capsys.readouterr().err
    with pytest.raises(DataError, match="discs of 2D Gaussian Splatting"):
        read_gaussians(write(tmp_path / "a.sog", {**meta, "model": "2dgs"}, images))


def test_a_folder_has_the_content_of_the_zip_file(tmp_path: Path) -> None:
    given = some(50, 1)
    write_gaussians(tmp_path / "a.sog", given)
    (tmp_path / "b").mkdir()
    write_gaussians(tmp_path / "b" / "meta.json", given)
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        assert {file.name: file.read_bytes() for file in (tmp_path / "b").iterdir()} == {
            name: archive.read(name) for name in archive.namelist()
        }
    one, other = (read_gaussians(tmp_path / name).gaussians for name in ("a.sog", "b/meta.json"))
    assert all(torch.equal(one.columns[name], values) for name, values in other.columns.items())


def test_max_megabytes_holds(tmp_path: Path) -> None:
    given, file = some(400), tmp_path / "a.sog"
    write_gaussians(file, given)
    limit = 0.9 * file.stat().st_size
    assert " MB hold harmonics up to degree" in write_gaussians(file, given, limit / 1e6)[0]
    assert file.stat().st_size <= limit
    assert len(read_gaussians(file).gaussians) == 400
    limit = 0.97 * len(encoded_sog(with_degree(given, 0))[0])
    assert "most visible of 400 Gaussians" in write_gaussians(file, given, limit / 1e6)[0]
    assert file.stat().st_size <= limit
    with pytest.raises(ConfigError, match="no Gaussian fits into 20 bytes"):
        write_gaussians(file, given, 20e-6)


def refused(file: Path) -> str:
    with pytest.raises(DataError) as error:
        read_gaussians(file)
    assert str(file) in str(error.value)
    assert "\n" not in str(error.value)
    return str(error.value)


def test_damaged_descriptions_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "a.sog"

    def said(key: str, value: object) -> str:
        """The error for another value at a path of names, or for none if None."""
        meta, images = by_hand()
        *above, last = key.split(".")
        place = meta
        for name in above:
            place = place[name]
        place[last] = value
        if value is None:
            del place[last]
        return refused(write(file, meta, images))

    assert "SOG of version 1;" in said("version", None)
    assert "SOG of version 3;" in said("version", 3)
    assert "has no 'quats'" in said("quats", None)
    assert "has no 'sh0'" in said("sh0", 3)
    for count in (0, -1, 10**12, 10**400, "2", 2.0, True):
        assert "it states" in said("count", count)
    assert "an image of 2x1 pixels cannot hold 3" in said("count", 3)
    for names in ("low.webp", ["low.webp"], ["low.webp", 3], ["low.webp", "../high.webp"], ["", "high.webp"]):
        assert "the files of 'means'" in said("means.files", names)
    assert "there is no nowhere.webp in it" in said("quats.files", ["nowhere.webp"])
    for numbers in ([1, 2], [1, 2, math.nan], [1, 2, "3"], [1, 2, 10**400], None):
        assert "'mins' of its meta.json" in said("means.mins", numbers)
    assert "'codebook' of its meta.json" in said("sh0.codebook", [0.0] * 255)
    assert "'codebook' of its meta.json" in said("scales.codebook", [None] * 256)
    for bands in (0, 4, "1", True):
        assert "harmonics of degree" in said("shN.bands", bands)
    assert "an image of 192x1 pixels cannot hold" in said("shN.bands", 2)
    assert "an image of 192x1 pixels cannot hold" in said("shN.count", 65)
    assert "it states 65537 harmonics" in said("shN.count", 65537)
    assert "has harmonics 1 of 1" in said("shN.count", 1)
    assert "none of its 2 Gaussians is finite" in said("scales.codebook", [1e300] * 256)
    meta, images = by_hand()
    assert "is not JSON" in refused(write_raw(file, b"{", images))
    assert "SOG of version unknown" in refused(write(file, [meta], images))


def write_raw(file: Path, meta: bytes, images: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(file, "w") as archive:
        for name, content in {**images, "meta.json": meta}.items():
            archive.writestr(name, content)
    return file


def test_damaged_images_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "a.sog"
    meta, images = by_hand()
    half = {**images, "sh0.webp": images["sh0.webp"][:-9]}
    assert "one of its images cannot be read" in refused(write(file, meta, half))
    lossy = {**images, "quats.webp": webp([[191, 128, 64, 253], [128, 128, 128, 251]], 2)}
    assert "alpha below 252" in refused(write(file, meta, lossy))
    # A large image that needs few bytes is not decoded.
    large = {**images, "scales.webp": webp(np.full((1_500_000, 4), 255), 1500)}
    assert "an image of 1500x1000 pixels" in refused(write(file, meta, large))
    bitmap = io.BytesIO()
    Image.new("RGB", (2, 1)).save(bitmap, format="BMP")
    assert "neither WebP without loss nor PNG" in refused(write(file, meta, {**images, "sh0.webp": bitmap.getvalue()}))
    # A header of the largest size, in either kind of WebP file.
    for kind, stated in ((b"VP8L", b"\x2f\xff\xff\xff\x0f"), (b"VP8X", bytes(4) + b"\xfe\x3f\0\xfe\x3f\0")):
        head = b"RIFF" + bytes(4) + b"WEBP" + kind + bytes(4) + stated + bytes(20)
        assert "an image of 1638" in refused(write(file, meta, {**images, "sh0.webp": head}))


def test_damaged_archives_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "a.sog"
    meta, images = by_hand()
    bomb = {**images, "sh0.webp": bytes(30_000_000)}
    assert "sh0.webp unpacks to more than" in refused(write(file, meta, bomb, zipfile.ZIP_DEFLATED))
    whole = write(file, meta, images).read_bytes()
    for size in [*range(0, len(whole), 397), len(whole) - 1]:
        file.write_bytes(whole[:size])
        refused(file)
    assert "there is no meta.json in it" in refused(write_other(file))
    (tmp_path / "meta.json").write_text(json.dumps(meta))
    with pytest.raises(DataError, match=r"cannot read .*low\.webp"):
        read_gaussians(tmp_path / "meta.json")


def write_other(file: Path) -> Path:
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("a.txt", "b")
    return file
