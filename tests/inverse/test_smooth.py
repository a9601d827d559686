"""Smooth borders: what is cut is closed, thick enough, and inflates as the record says."""

import json

import meshio
import numpy as np
import pytest
import svgpathtools
import trimesh
import xarray as xr
from scipy.spatial import cKDTree

from inflate_lib import describe, inflate, label_image
from inflate_lib.alternatives.reference import tube
from inflate_lib.inverse.constraints import Constraints, mirrored
from inflate_lib.inverse.save import save_designs
from inflate_lib.inverse.search import Design, Designs, Stop, design, with_smooth_borders
from inflate_lib.inverse.smooth import Plan, smooth_cavity, smooth_plan, smoothed
from inflate_lib.inverse.targets import Targets, deviations
from inflate_lib.mechanics import Mesh, find_flaw
from inflate_lib.mechanics.inflation import LAMBDA, MU
from inflate_lib.mechanics.mesh import boundary_loops
from inflate_lib.structures.labels import FRAME, PIXEL, VOID, WALL
from inflate_lib.structures.sources import load_sevens

DIGITS = load_sevens("digits").images


def signed_area(points):
    x, y = points.T
    return np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y) / 2


def plan_of(label, **options):
    columns = np.flatnonzero(label[-1] == WALL)
    return smooth_plan(smooth_cavity(label), (columns[0], columns[-1] + 1), **options)


def borders(plan):
    """The outer border and that of the cavity, (·, 2), which are all that the wall has."""
    loops = [plan.points[loop] for loop in boundary_loops(plan.quads[plan.wall])]
    outer, cavity = sorted(loops, key=signed_area, reverse=True)
    assert signed_area(outer) > 0 > signed_area(cavity)
    return outer, cavity


def between(points):
    """Points on a closed line, close to one another."""
    shares = np.linspace(0, 1, 20, endpoint=False)[:, None, None]
    return ((1 - shares) * points + shares * np.roll(points, -1, axis=0)).reshape(-1, 2)


@pytest.mark.parametrize("thickness", [2.0, 3.0])
@pytest.mark.parametrize("number", [0, 7, 21])
def test_the_wall_is_as_thick_as_asked_everywhere(number, thickness):
    label = label_image(DIGITS[number])
    plan = plan_of(label, thickness=thickness)
    outer, cavity = borders(plan)
    apart, _ = cKDTree(between(cavity)).query(between(outer))
    ground = np.abs(between(outer)[:, 1]) < 1e-9
    assert apart.min() > 0.99 * thickness * PIXEL
    assert np.quantile(apart[~ground], 0.5) < 1.02 * thickness * PIXEL  # and no thicker, but in creases and the foot
    assert -signed_area(cavity) == pytest.approx(PIXEL**2 * (label == VOID).sum(), rel=0.01)
    assert np.all(plan.points[plan.quads[plan.wall]] >= -1e-12) and ground.any()
    mesh = plan.mesh()
    a, b = np.moveaxis(mesh.nodes[mesh.pressure_edges], 1, 0)
    enclosed = np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2  # the edges run all around the cavity
    assert enclosed == pytest.approx(-signed_area(cavity), rel=1e-12)


def test_borders_are_smooth():
    """A border of pixels turns by right angles; these turn by a little at a time, but for the corners on the ground."""
    for line in borders(plan_of(label_image(DIGITS[3]))):
        ahead = np.roll(line, -1, axis=0) - line
        angle = np.arctan2(ahead[:, 1], ahead[:, 0])
        turn = np.abs((np.diff(angle, append=angle[0]) + np.pi) % (2 * np.pi) - np.pi)
        assert np.degrees(np.sort(turn)[:-4]).max() < 40


def test_a_smooth_ring_inflates_as_the_exact_tube():
    """Of both radii; the lattice knows nothing of circles. A mesh of half the size halves the miss at least."""
    angle, misses = np.linspace(0, 2 * np.pi, 400, endpoint=False), []
    circle = 14 + 7.3 * np.column_stack([np.cos(angle), np.sin(angle)])
    radii = np.array([7.3, 9.3]) * PIXEL
    exact = tube(0.01, (LAMBDA, MU), *radii)(radii)
    for per_pixel in (1, 2):
        mesh = smooth_plan(circle, (-2, -1), per_pixel=per_pixel).mesh()  # it stands nowhere
        held = np.abs(mesh.nodes - 0.5) < 1e-9  # on its lines of symmetry
        result = inflate(Mesh(mesh.nodes, mesh.cells, mesh.pressure_edges, held), 1)
        found = np.sort(np.linalg.norm(result.deformed() - 0.5, axis=1))[[0, -1]]
        misses.append(np.abs(found / exact - 1).max())
    assert misses[1] < min(misses[0] / 2, 2e-3)


def test_a_symmetric_structure_stays_symmetric():
    image = mirrored(DIGITS[5] / 255)[-1]
    label = label_image(image)
    reached = describe(inflate(label))
    targets = Targets(height=0.98 * reached.height)
    plan, result = smoothed(label, targets, Constraints(symmetric=True), 0.01)
    for line in borders(plan):
        middle = (line[:, 0].min() + line[:, 0].max()) / 2
        apart, _ = cKDTree(between(line)).query([2 * middle, 0] + [-1, 1] * line)
        assert apart.max() < 0.05 * PIXEL
    assert describe(result).medial_axis[:, 0] == pytest.approx(0, abs=2e-3)


@pytest.fixture(scope="module")
def found():
    """A search that found two structures of pixels, with smooth borders."""
    first = next(image for image in DIGITS if find_flaw(inflate(label_image(image))) is None)
    labels = [label_image(first), label_image(DIGITS[9])]
    reached = describe(inflate(labels[0]))
    targets, pool = Targets(height=reached.height), []
    for number, label in enumerate(labels):
        result = inflate(label)
        miss = deviations(targets, describe(result))
        pool.append(Design(label, result, describe(result), miss, number == 0, number, {"row": number}))
    found = Designs(pool, pool[:1], targets, Constraints(), 0.01, 2, None, 7, stopped=Stop.CANDIDATES)
    found.designs = with_smooth_borders(found, n_jobs=1)
    return found


def test_they_inflate_to_the_targets_again(found):
    one = found.designs[0]
    assert one.within and isinstance(one.plan, Plan) and find_flaw(one.result) is None
    plain = describe(inflate(plan_of(one.label).mesh(), 1))
    before = max(deviations(found.targets, plain).values())
    assert one.error < 0.01 < before  # smoothing alone had moved it
    assert one.deviations == deviations(found.targets, describe(one.result))
    assert "have smooth borders" in found.summary()


def test_what_is_written_is_what_was_inflated(found, tmp_path):
    _, _, folder, *_ = save_designs(found, tmp_path / "out", size_mm=56, depth_mm=10)
    one, record = found.designs[0], json.loads((folder / "design.json").read_text())
    assert record["borders"] == "smooth" and record["millimetres"]["least wall"] == 4
    outer, cavity = (abs(signed_area(line)) for line in borders(one.plan))

    (path,), _ = svgpathtools.svg2paths(str(folder / "outline.svg"))
    lines = path.continuous_subpaths()
    assert len(lines) == 2 and all(line.isclosed() for line in lines)
    assert sorted(abs(line.area()) for line in lines) == pytest.approx([56**2 * cavity, 56**2 * outer], rel=1e-3)
    for name, volume in (("part", 560 * 56 * (outer - cavity)), ("mould", 60**2 * 13 - 560 * 56 * (outer - cavity))):
        solid = trimesh.load_mesh(folder / f"{name}.stl")
        assert solid.is_watertight and solid.is_winding_consistent and solid.body_count == 1
        assert solid.volume == pytest.approx(volume, rel=1e-4)
    assert len(meshio.read(folder / "inflated_010.vtu").cells[0].data) == len(one.result.cells)

    file = xr.load_dataset(folder / "moose" / f"{folder.name}.e", engine="scipy")  # inflated anew, from the file alone
    nodes = np.column_stack([file["coordx"], file["coordy"]])
    cells, held = file["connect1"].values - 1, np.zeros(len(nodes), bool)
    held[file["node_ns1"].values - 1] = True
    element, side = file["elem_ss1"].values - 1, file["side_ss1"].values - 1
    edges = np.column_stack([cells[element, (side + 1) % 4], cells[element, side]])
    again = deviations(found.targets, describe(inflate(Mesh(nodes, cells, edges, held))))
    assert again == pytest.approx(record["errors"], abs=1e-7)


def test_a_demand_is_one_of_the_smooth_shape(found):
    """Where smoothing alone is near enough, so that the shape is known before."""
    label = found.designs[0].label
    plan = plan_of(label)
    area = sum(signed_area(quad) for quad in plan.points[plan.quads[plan.wall]])
    for demand, fits in (
        ({"max_material": 1.01 * area}, True), ({"max_material": 0.99 * area}, False), ({"min_void": PIXEL}, True),
        ({"min_void": 0.9}, False), ({"keep_out": (0, 0, 1, 1)}, False),
    ):  # fmt: skip
        made = smoothed(label, found.targets, Constraints(**demand), goal=1.0)
        assert (made is not None) == fits, demand


def test_what_cannot_be_smooth_is_refused():
    line = smooth_cavity(label_image(DIGITS[0]))
    with pytest.raises(ValueError, match="does not fit into the frame"):
        smooth_plan(1.4 * (line - line.mean(axis=0)) + FRAME / 2, (10, 14))
    with pytest.raises(ValueError, match="thickness must be a positive number"):
        smooth_plan(line, (10, 14), thickness=0)
    with pytest.raises(ValueError, match=r"stress cannot be asked of smooth borders.*--no-smooth"):
        design({"height": 1.0, "stress": 0.2}, smooth=True)
    with pytest.raises(ValueError, match="smooth must be"):
        design({"height": 1.0}, smooth="yes")
