"""What a design is handed out as, read by programs that are not ours; and that half of it is never handed out."""

import errno
import hashlib
import json
import os
import resource
import signal
from collections import Counter
from dataclasses import replace
from itertools import count
from xml.etree import ElementTree

import matplotlib.pyplot as plt
import meshio
import numpy as np
import pandas as pd
import pytest
import svgpathtools
import trimesh
import xarray as xr
from PIL import Image

from inflate_lib import describe, inflate, label_image, paths
from inflate_lib.alternatives.patterns import castable, from_picture
from inflate_lib.inverse import save
from inflate_lib.inverse.constraints import Constraints
from inflate_lib.inverse.refine import Rejection
from inflate_lib.inverse.save import (
    _outline_svg,
    _search_record,
    _write_stl,
    claimed_folder,
    mould,
    part,
    save_designs,
)
from inflate_lib.inverse.search import Design, Designs, Stop
from inflate_lib.inverse.smooth import pixel_plan
from inflate_lib.inverse.targets import Targets, deviations
from inflate_lib.io.pictures import read_images
from inflate_lib.io.vtk import write_vtk
from inflate_lib.mechanics import Flaw
from inflate_lib.structures.labels import FRAME, VOID, WALL
from inflate_lib.structures.sources import load_sevens

DIGITS = load_sevens("digits").images


def diagonal():
    """A structure with a joint of one node in its middle, which nobody can build."""
    image = np.zeros((28, 28))
    image[6:12, 6:12] = image[12:18, 12:18] = 1
    return label_image(image)


LABELS = [label_image(image) for image in DIGITS[:4]]


@pytest.fixture(scope="module")
def designs():
    """Two structures as though they had been searched for."""
    targets, found = Targets(height=0.9, width=0.8), []
    for number, image in enumerate(DIGITS[:2]):
        result = inflate(label_image(image), n_steps=2)
        shape = describe(result)
        miss = deviations(targets, shape)
        origin = {"seed": 1, "row": number, "conditions": [0.9, float("nan")], "drawing": "as drawn"}
        label = label_image(image)
        found.append(Design(label, result, shape, miss, number == 0, number, origin))
    model = {"descriptor": "box", "weights": "0123", "source": "digits"}
    constraints = Constraints(min_void=1 / 28)
    return Designs(
        found,
        found[:1],
        targets,
        constraints,
        0.01,
        2,
        None,
        7,
        model,
        {"sampler": "ddim"},
        tried=9,
        rejected=Counter({Flaw.NO_STRUCTURE: 2, Rejection.KEEP_OUT: 3}),
        stopped=Stop.CANDIDATES,
    )


@pytest.mark.parametrize("label", LABELS)
def test_solids_are_closed_and_of_the_right_volume(label, tmp_path):
    wall = (label == WALL).sum() / FRAME**2
    size, depth, base = 70.0, 12.0, 3.0
    frame = size**2 * ((FRAME + 2) / FRAME) ** 2
    volumes = {"part": size**2 * wall * depth}
    volumes["mould"] = frame * (base + depth) - volumes["part"]
    for name, solid in (
        ("part", part(pixel_plan(label), size, depth)),
        ("mould", mould(pixel_plan(label), size, depth, base)),
    ):
        _write_stl(tmp_path / f"{name}.stl", *solid)
        read = trimesh.load_mesh(tmp_path / f"{name}.stl")
        assert read.is_watertight and read.is_winding_consistent and read.is_volume
        assert read.volume == pytest.approx(volumes[name], rel=1e-5)
        assert read.body_count == 1
    assert np.ptp(read.vertices, axis=0) == pytest.approx([size * 30 / 28, size * 30 / 28, base + depth], rel=1e-6)


def windings(points, triangles, at):
    """How often a surface winds around a point: its solid angle over 4π (Van Oosterom and Strackee 1983)."""
    a, b, c = np.moveaxis(points[triangles] - np.asarray(at, dtype=float), 1, 0)
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    below = la * lb * lc + (a * b).sum(1) * lc + (b * c).sum(1) * la + (c * a).sum(1) * lb
    return np.arctan2(np.einsum("ij,ij->i", a, np.cross(b, c)), below).sum() / (2 * np.pi)


def test_the_core_of_the_mould_is_where_the_cavity_is():
    label = LABELS[0]
    row, column = np.argwhere(label == VOID)[10]
    wall_row, wall_column = np.argwhere(label == WALL)[10]
    cavity, trough = (column + 0.5, 27.5 - row), (wall_column + 0.5, 27.5 - wall_row)
    surface = mould(pixel_plan(label), 28.0, 5.0, 2.0)
    for at, inside in (
        ((*cavity, 6), 1),
        ((*trough, 6), 0),
        ((*trough, 1), 1),
        ((-0.5, -0.5, 6), 1),
        ((-1.5, 0, 1), 0),
    ):
        assert windings(*surface, at) == pytest.approx(inside, abs=1e-9)
    assert windings(*part(pixel_plan(label), 28.0, 5.0), (*trough, 2)) == pytest.approx(1, abs=1e-9)
    assert windings(*part(pixel_plan(label), 28.0, 5.0), (*cavity, 2)) == pytest.approx(0, abs=1e-9)


def test_what_hangs_together_in_a_node_is_no_solid():
    with pytest.raises(ValueError, match="hold together in a single node"):
        pixel_plan(diagonal())


@pytest.mark.parametrize("label", LABELS)
def test_the_outline_is_closed_and_in_millimetres(label, tmp_path):
    (tmp_path / "a.svg").write_text(_outline_svg(pixel_plan(label), size_mm=56))
    (path,), _, attributes = svgpathtools.svg2paths2(str(tmp_path / "a.svg"))
    assert attributes["width"] == attributes["height"] == "56mm" and attributes["viewBox"] == "0 0 56 56"
    borders = path.continuous_subpaths()
    assert len(borders) == 2 and all(border.isclosed() for border in borders)
    cavity, outer = sorted(abs(border.area()) for border in borders)
    assert cavity == pytest.approx(4 * (label == VOID).sum(), rel=1e-4)
    assert outer == pytest.approx(4 * (label > 0).sum(), rel=1e-4)
    left, right, top, bottom = path.bbox()
    rows, columns = np.nonzero(label)
    assert (left, right) == pytest.approx((2 * columns.min(), 2 * columns.max() + 2))
    assert (top, bottom) == pytest.approx((2 * rows.min(), 56))  # SVG counts downwards; the clamped edge is below


def test_every_file_is_read_by_others(designs, tmp_path):
    sheet, table, *folders = save_designs(designs, tmp_path / "out", size_mm=80, depth_mm=15)
    assert [folder.name for folder in folders] == ["design_01", "design_02"]
    with Image.open(sheet) as picture:
        assert min(picture.size) > 200
    rows = pd.read_csv(table)
    assert rows["within"].tolist() == [True, False]
    for one, folder, row in zip(designs.designs, folders, rows.to_dict("records"), strict=True):
        assert row["height"] == pytest.approx(one.shape.height, rel=1e-7)
        assert row["error width (%)"] == pytest.approx(100 * one.deviations["width"], rel=1e-6)
        (image,), _ = read_images(folder / "structure.png")
        assert np.array_equal(label_image(image), one.label)  # `inflate simulate` gets the same structure
        for name in ("part", "mould"):
            assert trimesh.load_mesh(folder / f"{name}.stl").is_watertight
        assert len(svgpathtools.svg2paths(str(folder / "outline.svg"))[0]) == 1
        last = meshio.read(folder / "inflated_002.vtu")
        assert np.allclose(last.point_data["displacement"][:, :2], one.result.displacement[-1])
        mesh = xr.load_dataset(folder / "moose" / f"{folder.name}.e", engine="scipy")
        assert np.array_equal(mesh["connect1"] - 1, one.result.cells)
        assert f"file = {folder.name}.e" in (folder / "moose" / f"{folder.name}.i").read_text()
        record = json.loads((folder / "design.json").read_text())
        assert record["achieved"]["height"] == one.shape.height and record["search"]["seed"] == 7
        assert record["origin"]["conditions"] == [0.9, None] and record["novelty"] is None
        assert record["search"]["model"]["weights"] == "0123" and record["search"]["versions"]["numpy"]
        assert record["search"]["constraints"] == {"min_void": 1 / 28}
        assert record["search"]["stopped"]["reason"] == "candidates"
        assert [entry["drawings"] for entry in record["search"]["rejected"]] == [3, 2]
        assert record["search"]["rejected"][1] == {
            "reason": "no_structure", "sentence": "The image holds no structure.", "drawings": 2
        }  # fmt: skip
    record = json.loads((tmp_path / "out" / "designs.json").read_text())
    assert record.pop("files") == digests(tmp_path / "out")
    assert record == json.loads(json.dumps(_search_record(designs)))
    assert os.listdir(tmp_path) == ["out"]


def test_two_rubbers_are_handed_out_apart(designs, tmp_path):
    label = LABELS[0]
    grid = castable(np.where(np.arange(28) < 14, 4.0, 1.0)[None].repeat(28, axis=0), label)
    result = inflate(label, n_steps=1, stiffness=grid)
    one = replace(designs.designs[0], result=result, shape=describe(result))
    *_, folder = save_designs(replace(designs, designs=[one]), tmp_path / "out", size_mm=80, depth_mm=15)
    stiff = one.stiff
    assert stiff.any() and not stiff.all() and np.array_equal(stiff, (label == WALL) & (grid == 4))
    image, read = from_picture(np.asarray(Image.open(folder / "structure.png")))
    assert np.array_equal(label_image(image), label) and np.array_equal(read, stiff)
    pixel, volumes = (80 / FRAME) ** 2 * 15, {"part_soft": (label == WALL) & ~stiff, "part_stiff": stiff}
    for name, pixels in volumes.items():
        solid = trimesh.load_mesh(folder / f"{name}.stl")
        assert solid.is_watertight and solid.volume == pytest.approx(pixel * pixels.sum(), rel=1e-5)
    drawn, attributes = svgpathtools.svg2paths(str(folder / "outline.svg"))
    assert len(drawn) == 2 and attributes[0]["fill"] != attributes[1]["fill"]
    root = ElementTree.parse(folder / "outline.svg").getroot()
    assert [layer.get("id") for layer in root] == ["soft", "stiff"]
    for path, pixels in zip(drawn, volumes.values(), strict=True):
        area = sum(abs(border.area()) for border in path.continuous_subpaths())
        assert area == pytest.approx((80 / FRAME) ** 2 * pixels.sum(), rel=1e-4)
    assert len(meshio.read(folder / "moose" / "design_01.e").cells) == 2


@pytest.fixture
def quick(monkeypatch):
    """Pictures take most of the time, and are not what is tested."""
    monkeypatch.setattr(save.pictures, "write_picture", lambda result, path: path.write_text("a picture"))
    monkeypatch.setattr("inflate_lib.plotting.designs.plot_designs", lambda designs: plt.figure(figsize=(1, 1)))


def digests(folder):
    """SHA-256 of every file but the record, as other programs compute it."""
    files = [file for file in folder.rglob("*") if file.is_file() and file.name != "designs.json"]
    return {str(file.relative_to(folder)): hashlib.sha256(file.read_bytes()).hexdigest() for file in files}


@pytest.mark.parametrize("error", [KeyboardInterrupt(), ValueError("broken"), OSError(errno.ENOSPC, "No space left")])
def test_a_stop_in_the_middle_leaves_nothing(designs, tmp_path, monkeypatch, error):
    calls = count()
    write = write_vtk

    def stop(*arguments):
        if next(calls) == 1:  # the second design
            raise error
        return write(*arguments)

    monkeypatch.setattr(save, "write_vtk", stop)
    with pytest.raises(type(error)) as stopped:
        save_designs(designs, tmp_path / "new" / "out")
    assert os.listdir(tmp_path) == []
    if isinstance(error, OSError):
        assert "No space left; no designs were written" in str(stopped.value) and "out" in str(stopped.value)


def test_a_full_disk_is_a_clear_error(designs, tmp_path):
    """The limit on the size of a file stands in for the disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, before[1]))
        with pytest.raises(OSError, match=r"File too large; no designs were written: make room") as stopped:
            save_designs(designs, tmp_path / "out")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, ignored)
    assert stopped.value.filename == str(tmp_path / "out" / "design_01" / "picture.png")
    assert os.listdir(tmp_path) == []


def test_what_is_there_is_kept(designs, quick, tmp_path):
    out = tmp_path / "out"
    (out / "design_01").mkdir(parents=True)
    (out / "design_01" / "mine.txt").write_text("kept")
    with pytest.raises(FileExistsError, match="not empty"):
        save_designs(designs, out)
    with pytest.raises(FileExistsError, match="a file of this name"):
        save_designs(designs, out / "design_01" / "mine.txt")
    (out / "designs.csv").write_text("mine")
    with pytest.raises(FileExistsError, match=r"designs\.csv is there already"):
        save_designs(designs, out, overwrite=True)
    assert sorted(os.listdir(out)) == ["design_01", "designs.csv"] and os.listdir(out / "design_01") == ["mine.txt"]
    (out / "designs.csv").unlink()
    save_designs(designs, out, overwrite=True)
    assert (out / "contact_sheet.png").exists() and (out / "design_01" / "mine.txt").read_text() == "kept"


def test_an_earlier_run_is_replaced_as_far_as_it_is_unchanged(designs, quick, tmp_path, monkeypatch):
    out = tmp_path / "out"
    save_designs(designs, out)
    monkeypatch.setattr(
        paths, "CACHE", tmp_path / "cache"
    )  # on another machine the folder's own record is all there is
    (out / "design_02" / "notes.txt").write_text("mine")
    (out / "design_02" / "outline.svg").write_text("changed")
    fewer = replace(designs, designs=designs.designs[1:])
    save_designs(fewer, out, overwrite=True)
    assert sorted(os.listdir(out)) == ["contact_sheet.png", "design_01", "design_02", "designs.csv", "designs.json"]
    assert sorted(os.listdir(out / "design_02")) == ["notes.txt", "outline.svg"]
    shape = json.loads((out / "design_01" / "design.json").read_text())["achieved"]
    assert shape["height"] == designs.designs[1].shape.height
    before = digests(out)
    with pytest.raises(FileExistsError, match=r"design_02/outline\.svg is there already"):
        save_designs(designs, out, overwrite=True)
    assert digests(out) == before
    (out / "design_02" / "outline.svg").unlink()
    save_designs(designs, out, overwrite=True)
    assert (out / "design_02" / "notes.txt").read_text() == "mine"


def test_a_foreign_record_gives_no_right_to_a_file(designs, quick, tmp_path):
    (tmp_path / "mine").write_text("mine")
    (tmp_path / "out").mkdir()
    record = {"files": {"../mine": hashlib.sha256(b"mine").hexdigest(), str(tmp_path / "mine"): "0"}}
    for text in ("{}", "[]", "no JSON", json.dumps(record)):
        (tmp_path / "out" / "designs.json").write_text(text)
        with pytest.raises(FileExistsError, match=r"designs\.json is there already"):
            save_designs(designs, tmp_path / "out", overwrite=True)
    assert (tmp_path / "mine").exists()


def test_designs_go_where_a_link_leads_and_into_the_folder_one_stands_in(designs, quick, tmp_path, monkeypatch):
    (tmp_path / "disk").mkdir()
    (tmp_path / "link").symlink_to("disk")
    save_designs(designs, tmp_path / "link")
    assert (tmp_path / "link").is_symlink() and (tmp_path / "disk" / "designs.json").exists()
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    save_designs(designs, ".")
    assert sorted(os.listdir(".")) == ["contact_sheet.png", "design_01", "design_02", "designs.csv", "designs.json"]
    assert sorted(os.listdir(tmp_path)) == ["disk", "here", "link"]


def test_a_folder_is_for_one_run(designs, quick, tmp_path):
    with claimed_folder(tmp_path / "out", 2), pytest.raises(BlockingIOError, match="another run"):
        save_designs(designs, tmp_path / "out", overwrite=True)
    assert os.listdir(tmp_path) == []  # nothing was found, and nothing written


def test_inputs_are_no_outputs(designs, quick, tmp_path):
    save_designs(designs, tmp_path)
    for name in ("design_01/outline.svg", "design_02/outline.svg"):  # the second would be removed
        with (
            pytest.raises(FileExistsError, match=r"input .*outline\.svg"),
            claimed_folder(tmp_path, 1, True, [tmp_path / name]),
        ):
            pass


@pytest.mark.parametrize("after", [0, 3, 17, 40])
def test_a_run_killed_between_two_files_is_mended_by_the_next(designs, quick, tmp_path, monkeypatch, after):
    """A kill at any moment: the moves after it do not happen, nor is anything tidied up."""
    save_designs(designs, tmp_path / "out")
    other = replace(designs, designs=designs.designs[::-1])
    child = os.fork()
    if not child:
        calls, move = count(), os.replace

        def killed(*arguments):
            if next(calls) == after:
                os._exit(9)
            move(*arguments)

        os.replace = killed
        save_designs(other, tmp_path / "out", overwrite=True)
        os._exit(0)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    left = [path.name for path in (tmp_path / "out").iterdir() if path.name.endswith(".partial")]
    assert len(left) == (code == 9) and not any(name.startswith(".") for name in left)
    save_designs(other, tmp_path / "out", overwrite=True)
    record = json.loads((tmp_path / "out" / "designs.json").read_text())
    assert record["files"] == digests(tmp_path / "out")


@pytest.mark.parametrize("sizes", [{"size_mm": 0}, {"depth_mm": float("nan")}, {"size_mm": True}])
def test_sizes_that_are_none_are_refused(designs, tmp_path, sizes):
    with pytest.raises(ValueError, match="positive number of millimetres"):
        save_designs(designs, tmp_path / "out", **sizes)
    with pytest.raises(ValueError, match="no design to write"):
        save_designs(replace(designs, designs=[]), tmp_path / "out")
    assert os.listdir(tmp_path) == []
