"""Tables of results as text: Markdown with means over seeds, and a list of rows with estimated times."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from operator import sub, truediv
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

from benchmarks.tables import Result, Row, Table, kept
from nerfloom.evaluation.lpips import NETWORK

LOADING, EVALUATION = 20.0, 60.0
"""Seconds before a row's training, and after it where nothing is known of its data, in estimates of a row's time."""
Column = tuple[str, Callable[[Result], float | None], Callable[[float], str]]
"""Heading of a column, its value in a result, and its format."""


def columns(table: Table, found: Sequence[Result]) -> list[Column]:
    """Return the columns of a `table` that some result of all, `found`, has a value for."""
    sizes = sorted({size for result in found for size in result["results"].get("by_size", {})}, key=len)
    every = all_columns(sizes, table.images)
    return [column for column in every if any(column[1](result) is not None for result in found)]


def all_columns(sizes: Sequence[str], images: Mapping[str, str]) -> list[Column]:
    """Return all columns.

    Args:
        sizes: sizes of images with PSNR shown, such as 1/2.
        images: heading of a column -> name of the held-out image with the PSNR to show.
    """

    def of_run(name: str) -> Callable[[Result], float | None]:
        return lambda result: result.get("run", {}).get(name)

    def of_size(size: str) -> Callable[[Result], float | None]:
        return lambda result: result["results"].get("by_size", {}).get(size, {}).get("psnr")

    def of_image(name: str) -> Callable[[Result], float | None]:
        return lambda result: next((image["psnr"] for image in result["per_image"] if image["name"] == name), None)

    def of_surface(figure: Callable[[dict[str, Any]], float | None]) -> Callable[[Result], float | None]:
        return lambda result: None if result.get("geometry") is None else figure(result["geometry"])

    def of_bytes(name: str, unit: float) -> Callable[[Result], float | None]:
        return lambda result: None if (size := of_run(name)(result)) is None else size / unit

    def against(compare: Callable[[float, float], float], name: str) -> Callable[[Result], float | None]:
        """Return a comparison of a result's value `name` with that of the run that it was made from."""

        def compared(result: Result) -> float | None:
            before = result.get("run", {}).get("after")
            return None if before is None else compare(result["results"][name], before[name])

        return compared

    return [
        ("test PSNR", lambda result: result["results"]["psnr"], "{:.2f} dB".format),
        ("SSIM", lambda result: result["results"]["ssim"], "{:.3f}".format),
        ("MS-SSIM", lambda result: result["results"].get("ms_ssim"), "{:.3f}".format),
        (f"LPIPS ({NETWORK})", lambda result: result["results"].get("lpips"), "{:.3f}".format),
        *((f"size {size}", of_size(size), "{:.2f} dB".format) for size in sizes),
        *((heading, of_image(name), "{:.2f} dB".format) for heading, name in images.items()),
        ("against its run", against(sub, "psnr"), "{:+.2f} dB".format),
        ("normal MAE", lambda result: result["results"].get("normal_mae"), "{:.2f}°".format),
        ("diffuse PSNR", lambda result: result["results"].get("diffuse_psnr"), "{:.2f} dB".format),
        ("floaters", lambda result: result["results"].get("floaters"), "{:.2f} %".format),
        ("Chamfer", of_surface(lambda found: found["chamfer_percent"]), "{:.3f} %".format),
        ("F-score", of_surface(lambda found: 100 * found["f_scores"][0]["f_score"]), "{:.1f} %".format),
        ("normals", of_surface(lambda found: (found["normals"] or {}).get("degrees")), "{:.2f}°".format),
        ("faces", of_surface(lambda found: found["faces"]), "{:,.0f}".format),
        ("steps", of_run("steps"), "{:,.0f}".format),
        ("training rays/s", of_run("rays_per_second"), lambda rate: f"{float(f'{rate:.3g}'):,.0f}"),
        ("samples a ray", of_run("samples_per_ray"), "{:.1f}".format),
        ("peak memory", of_bytes("peak_memory_bytes", 2**30), "{:.1f} GiB".format),
        ("made in", of_run("wall_seconds"), "{:.0f} s".format),
        ("file", of_bytes("bytes", 1e6), "{:.1f} MB".format),
        ("render", lambda result: 1 / result["results"]["fps"], "{:.2g} s/image".format),
        ("images/s", lambda result: result["results"]["fps"], lambda rate: f"{float(f'{rate:.3g}'):g}"),
        ("speed-up", against(truediv, "fps"), "{:.1f} x".format),
    ]


def markdown(table: Table, results: Path, wanted: re.Pattern[str]) -> str:
    """Return a table as Markdown: a line for each data set, method and budget, with the mean over seeds.

    With several seeds, PSNRs are followed by the standard deviation of a single run. Lines without a run are left
    empty.

    Args:
        results: the file of its results.
        wanted: parts of the names of the rows to show.
    """
    lines: dict[tuple[str, str, float], list[tuple[Row, Result]]] = {}
    for row in filter(lambda row: wanted.search(row.name), table.rows):
        runs = lines.setdefault((row.data, row.method, row.seconds), [])
        runs += [] if (found := kept(row, results)) is None else [(row, found)]
    shows = columns(table, [found for runs in lines.values() for _, found in runs])
    headings = ["run", *(heading for heading, *_ in shows), "result"]
    text = ["| " + " | ".join(headings) + " |", "|---" * len(headings) + "|"]
    for (data, method, seconds), runs in lines.items():
        cells = [cell(show, [found for _, found in runs]) for show in shows]
        first = f"`{runs[0][0].name}`" if runs else ""
        text.append("| " + " | ".join([f"{data}, {method}, {seconds:g} s", *cells, first]) + " |")
    return "\n".join(text)


def cell(column: Column, found: Sequence[Result]) -> str:
    """Return the mean of a column over the seeds, with the spread of PSNRs; nothing if a run lacks it."""
    _, value_of, shape = column
    values = [value for value in map(value_of, found) if value is not None]
    if not values or len(values) < len(found):
        return ""
    text = shape(fmean(values))
    return text.replace(" dB", f" ± {stdev(values):.2f} dB") if len(values) > 1 else text


def listing(rows: Sequence[Row], results: Path) -> str:
    """Return a line for each of `rows` with its PSNR in the file `results` or its estimated time, and their total."""
    found = [(row, kept(row, results)) for row in rows]
    done = [(row, result) for row, result in found if result is not None]
    missing = {row.name: estimate(row, done) for row, result in found if result is None}
    width = max(len(row.name) for row in rows)
    lines = [
        f"{row.name:<{width}}  "
        + (f"{missing[row.name] / 60:6.1f} min" if result is None else f"{result['results']['psnr']:7.2f} dB")
        + f"  {row.planned.contender.label}"
        for row, result in found
    ]
    hours = sum(missing.values()) / 3600
    return "\n".join([*lines, f"{len(missing)} of {len(rows)} rows are to be run: {hours:.1f} h"])


def estimate(row: Row, done: Sequence[tuple[Row, Result]]) -> float:
    """Return the estimated seconds of a `row`: loading, training and evaluation, as in finished rows, `done`.

    Results with the same method and data are used, otherwise any with the same data.
    """
    near = [(other, found) for other, found in done if other.data == row.data]
    same = [(other, found) for other, found in near if other.method == row.method] or near
    known = [_evaluation_seconds(found) for _, found in same]
    return LOADING + row.seconds + (fmean(known) if known else EVALUATION)


def _evaluation_seconds(result: Result) -> float:
    """Return the seconds of a result's images, and of its surface if it was judged."""
    of_images = result["results"]["num_images"] / result["results"]["fps"]
    return of_images if result.get("geometry") is None else of_images + result["geometry"]["seconds"]
