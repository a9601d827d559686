"""Files for MOOSE, read back by others; and a run with a stand-in, because MOOSE itself is not here."""

import re
import sys
import time
from dataclasses import replace
from pathlib import Path

import meshio
import netCDF4
import numpy as np
import pytest

from inflate_lib import build_mesh, describe, inflate, label_image
from inflate_lib.alternatives.reference import quarter_ring
from inflate_lib.cli._images import Options, simulate_files
from inflate_lib.io import _exodus, moose
from inflate_lib.structures.sources import load_sevens

LABEL = label_image(load_sevens("digits").images[0])


def read_hit(text):
    """MOOSE's input syntax (hit) as nested dicts: [name] … [], name = value, value in quotes or one word."""
    root, stack = {}, []
    stack.append(root)
    for number, line in enumerate(text.splitlines(), 1):
        line = re.sub(r"#.*", "", line).strip()
        if not line:
            continue
        if line == "[]":
            assert len(stack) > 1, f"line {number} closes nothing"
            stack.pop()
        elif match := re.fullmatch(r"\[([A-Za-z]\w*)\]", line):
            assert match[1] not in stack[-1], f"line {number}: {match[1]} twice"
            stack.append(stack[-1].setdefault(match[1], {}))
        else:
            match = re.fullmatch(r"(\w+) = (?:'([^']*)'|(\S+))", line)
            assert match and match[1] not in stack[-1], f"line {number}: {line}"
            stack[-1][match[1]] = match[2] if match[2] is not None else match[3]
    assert len(stack) == 1, "a block is not closed"
    return root


def numbers(words):
    return [float(word) for word in words.split()]


def exodus_text(file, name):
    return [row.tobytes().rstrip(b"\0").decode() for row in file[name][:].filled(b"")]


@pytest.fixture(params=[(1, "bottom"), (2, "bottom"), (1, "left")], ids=["coarse", "refined", "left"])
def mesh(request):
    refine, edge = request.param
    return build_mesh(label_image(load_sevens("digits").images[0], clamped=edge), refine, edge)


def test_input_says_what_the_paper_solves(mesh, tmp_path):
    files = moose.write_case(mesh, tmp_path / "new", "seven", n_steps=10)
    assert [path.name for path in files] == ["seven.i", "seven.e"]
    case = read_hit(files[0].read_text())
    assert list(case) == [
        "GlobalParams", "Mesh", "Variables", "Kernels", "Materials", "Functions", "BCs", "Preconditioning",
        "Executioner", "Outputs",
    ]  # fmt: skip
    assert case["GlobalParams"] == {
        "displacements": "disp_x disp_y", "large_kinematics": "true", "stabilize_strain": "true",
    }  # fmt: skip
    (file,) = case["Mesh"].values()
    assert file == {"type": "FileMeshGenerator", "file": "seven.e"} and (tmp_path / "new" / file["file"]).exists()
    kernels = {(k["type"], k["variable"], k["component"]) for k in case["Kernels"].values()}
    assert kernels == {("TotalLagrangianStressDivergence", f"disp_{x}", str(i)) for i, x in enumerate("xy")}
    assert set(case["Variables"]) == {"disp_x", "disp_y"}
    materials = {material.pop("type"): material for material in case["Materials"].values()}
    assert materials == {"ComputeLagrangianStrain": {}, "ComputeNeoHookeanStress": {"lambda": "16.44", "mu": "0.1644"}}
    boundary = case["BCs"]
    (pressure,) = boundary.pop("Pressure").values()
    assert pressure == {"boundary": "cavity", "function": "inflation", "use_displaced_mesh": "true"}
    times = np.arange(1, 11) / 10
    ramp = case["Functions"]["inflation"]
    assert ramp.pop("type") == "PiecewiseLinear" and list(ramp) == ["x", "y"]
    assert np.array_equal(numbers(ramp["x"]), [0, *times]) and np.array_equal(numbers(ramp["y"]), [0, *(0.01 * times)])
    held = {(b["type"], b["variable"], b["boundary"], b["value"]) for b in boundary.values()}
    assert held == {("DirichletBC", "disp_x", "clamped", "0"), ("DirichletBC", "disp_y", "clamped", "0")}
    run = case["Executioner"]
    assert (run["type"], run["start_time"], run["end_time"]) == ("Transient", "0", "1") and "dt" not in run
    stepper = run["TimeStepper"]  # of which MOOSE keeps every time, even where it has to cut a step
    assert stepper["type"] == "TimeSequenceStepper" and np.array_equal(numbers(stepper["time_sequence"]), times)
    assert case["Outputs"]["exodus"] == {"type": "Exodus", "file_base": "seven_out"}


def test_input_takes_every_parameter():
    case = read_hit(moose._input_text("a", n_steps=4, element="q1", pressure=2e-5, lame=(3, 0.5)))
    assert case["GlobalParams"]["stabilize_strain"] == "false"
    for stabilised in ("stabilised", "mean-dilatation"):
        assert read_hit(moose._input_text("a", element=stabilised))["GlobalParams"]["stabilize_strain"] == "true"
    assert {case["Materials"]["stress"][name] for name in ("lambda", "mu")} == {"3.0", "0.5"}
    assert numbers(case["Functions"]["inflation"]["y"]) == pytest.approx([0, 5e-6, 1e-5, 1.5e-5, 2e-5], rel=1e-15)
    assert numbers(case["Executioner"]["TimeStepper"]["time_sequence"]) == [0.25, 0.5, 0.75, 1]
    assert float(case["Executioner"]["dtmin"]) == 0.25 / 64


def test_input_takes_the_history_that_we_take():
    pressures = [0.01, -0.002, 1 / 3, 0]
    case = read_hit(moose._input_text("a", pressure=pressures))
    assert numbers(case["Functions"]["inflation"]["y"]) == [0, *pressures]
    result = inflate(LABEL, pressure=np.array([0.01, 0.002, 0.005, 0]))
    assert numbers(case["Functions"]["inflation"]["x"]) == [0, *result.load_steps]
    for name, wrong in (("pressure", []), ("n_steps", 0), ("element", "q2")):
        with pytest.raises(ValueError, match=name):
            moose._input_text("a", **{name: wrong})


@pytest.mark.parametrize("name", ["", "two words", "a/b", "it's"])
def test_names_that_break_the_syntax_are_refused(name, tmp_path):
    with pytest.raises(ValueError, match="letters"):
        moose.write_case(build_mesh(LABEL), tmp_path, name)


def test_mesh_is_read_back_by_others(mesh, tmp_path):
    _exodus.write_mesh(mesh, tmp_path / "wall.e")
    grid = meshio.read(tmp_path / "wall.e")
    assert np.array_equal(grid.points[:, :2], mesh.nodes) and not grid.points[:, 2].any()
    assert np.array_equal(grid.cells_dict["quad"], mesh.cells)
    assert np.array_equal(np.sort(grid.point_sets["clamped"]), np.flatnonzero(mesh.clamped))
    with netCDF4.Dataset(tmp_path / "wall.e") as file:
        assert file.data_model == "NETCDF3_64BIT_OFFSET" and file.floating_point_word_size == 8
        assert exodus_text(file, "ss_names") == ["cavity"] and exodus_text(file, "ns_names") == ["clamped"]
        assert exodus_text(file, "coor_names") == ["x", "y"] and file["connect1"].elem_type == "QUAD4"
        assert file["ss_prop1"][:].tolist() != file["ns_prop1"][:].tolist()
        # side s of a QUAD4 runs from its corner s to the next one (Exodus II manual, table of side node ordering)
        element, side = file["elem_ss1"][:] - 1, file["side_ss1"][:] - 1
        corners = file["connect1"][:].filled() - 1
    edges = np.column_stack([corners[element, side], corners[element, (side + 1) % 4]])
    assert {frozenset(edge) for edge in edges.tolist()} == {frozenset(edge) for edge in mesh.pressure_edges.tolist()}
    assert len(edges) == len(mesh.pressure_edges)
    # outward of the element is into the cavity: the edge midpoint moved that way leaves the element
    along = mesh.nodes[edges[:, 1]] - mesh.nodes[edges[:, 0]]
    outward = np.column_stack([along[:, 1], -along[:, 0]])
    to_edge = mesh.nodes[edges].mean(1) - mesh.nodes[mesh.cells[element]].mean(1)
    assert np.all((outward * to_edge).sum(1) > 0)


def test_each_rubber_is_a_block_with_a_material_of_its_own(tmp_path):
    stiffness = np.where(np.indices(LABEL.shape).sum(axis=0) % 5 < 2, 4.0, 1.0)
    mesh = build_mesh(LABEL, stiffness=stiffness)
    text, file = moose.write_case(mesh, tmp_path, "two", lame=(16.0, 0.25))
    materials = {one["block"]: one for one in read_hit(text.read_text())["Materials"].values() if "block" in one}
    assert {block: (one["lambda"], one["mu"]) for block, one in materials.items()} == {
        "rubber_1": ("16.0", "0.25"), "rubber_2": ("64.0", "1.0"),
    }  # fmt: skip
    parts = [cells.data for cells in meshio.read(file).cells]
    for cells, value in zip(parts, (1.0, 4.0), strict=True):
        assert np.array_equal(cells, mesh.cells[mesh.stiffness == value])
    with netCDF4.Dataset(file) as opened:
        assert exodus_text(opened, "eb_names") == ["rubber_1", "rubber_2"]
        element, side = opened["elem_ss1"][:] - 1, opened["side_ss1"][:] - 1
    corners = np.concatenate(parts)
    edges = np.column_stack([corners[element, side], corners[element, (side + 1) % 4]])
    assert np.array_equal(edges[:, ::-1], mesh.pressure_edges)


def test_a_mesh_that_slides_is_no_case(tmp_path):
    with pytest.raises(ValueError, match="one direction only"):
        _exodus.write_mesh(quarter_ring(2), tmp_path / "ring.e")


def write_results(path, nodes, times, displacement, kind, fields=("disp_x", "disp_y")):
    """What MOOSE writes, as netCDF-3 or netCDF-4."""
    with netCDF4.Dataset(path, "w", format=kind) as file:
        file.createDimension("time_step", None)
        for name, size in {"num_nodes": len(nodes), "len_name": 33, "num_nod_var": len(fields)}.items():
            file.createDimension(name, size)
        for i, axis in enumerate("xy"):
            file.createVariable(f"coord{axis}", "f8", ("num_nodes",))[:] = nodes[:, i]
        names = np.array([list(name.ljust(33, "\0")) for name in fields], dtype="S1")
        file.createVariable("name_nod_var", "S1", ("num_nod_var", "len_name"))[:] = names
        file.createVariable("time_whole", "f8", ("time_step",))[:] = times
        for i in range(len(fields)):
            file.createVariable(f"vals_nod_var{i + 1}", "f8", ("time_step", "num_nodes"))[:] = displacement[..., i]


@pytest.mark.parametrize("kind", ["NETCDF3_64BIT_OFFSET", "NETCDF4"])
def test_results_come_back_in_our_order(kind, tmp_path):
    result = inflate(LABEL, n_steps=2)
    shuffled = np.random.default_rng(0).permutation(len(result.nodes))
    write_results(tmp_path / "out.e", result.nodes[shuffled], [0.5, 1], result.displacement[:, shuffled], kind)
    times, displacement = _exodus.read_displacement(tmp_path / "out.e", result.nodes)
    assert times.tolist() == [0.5, 1] and np.array_equal(displacement, result.displacement)


def test_other_results_are_refused(tmp_path):
    result = inflate(LABEL, n_steps=1)
    (tmp_path / "text.e").write_text("no netCDF")
    write_results(tmp_path / "moved.e", result.nodes + 0.01, [1], result.displacement, "NETCDF4")
    write_results(tmp_path / "other.e", result.nodes, [1], result.displacement, "NETCDF4", ("disp_x", "temp"))
    for name in ("text.e", "missing.e", "moved.e", "other.e"):
        with pytest.raises(ValueError, match=name):
            _exodus.read_displacement(tmp_path / name, result.nodes)


STAND_IN = """#!{python}
import pathlib, shutil, sys
assert sys.argv[1] == "-i" and pathlib.Path(sys.argv[2]).read_text().startswith("#")
{body}
"""


@pytest.fixture
def stand_in(tmp_path, monkeypatch):
    """Put a program named as MOOSE's on the PATH, which does what it is told."""

    def install(body, name="solid_mechanics-opt"):
        program = tmp_path / "bin" / name
        program.parent.mkdir(exist_ok=True)
        program.write_text(STAND_IN.format(python=sys.executable, body=body))
        program.chmod(0o755)
        monkeypatch.setenv("PATH", str(program.parent))

    return install


@pytest.fixture(scope="module")
def result():
    return inflate(LABEL, n_steps=4)


def test_run_gives_the_same_kind_of_result(result, stand_in, tmp_path):
    """A recorded result: sub-steps that we did not ask for, nodes in another order, the start included."""
    case = moose.write_case(result.mesh, tmp_path / "case", "seven", n_steps=4)
    times = [0, 0.25, 0.375, 0.5, 0.75, 1]
    moved = 1.01 * np.concatenate([np.zeros_like(result.displacement[:1]), result.displacement])[[0, 1, 1, 2, 3, 4]]
    write_results(tmp_path / "recorded.e", result.nodes[::-1], times, moved[:, ::-1], "NETCDF4")
    stand_in(f"shutil.copy({str(tmp_path / 'recorded.e')!r}, 'seven_out.e')", "combined-opt")
    found = moose.run_case(result, case[0])
    assert found.converged and not found.reason
    assert np.array_equal(found.displacement, 1.01 * result.displacement)
    assert describe(found).height != describe(result).height


def test_the_command_takes_the_engine(result, stand_in, tmp_path):
    np.save(tmp_path / "seven.npy", load_sevens("digits").images[0])
    write_results(tmp_path / "recorded.e", result.nodes, result.load_steps, 1.01 * result.displacement, "NETCDF4")
    stand_in(f"shutil.copy({str(tmp_path / 'recorded.e')!r}, 'seven_out.e')")
    options = Options(n_steps=4, engine="moose", moose=tmp_path / "cases")
    (record,) = simulate_files([tmp_path / "seven.npy"], options)
    expected = describe(result.nodes + 1.01 * result.displacement[-1])
    assert record["converged"] and record["height"] == pytest.approx(expected.height, abs=1e-14)
    (ours,) = simulate_files([tmp_path / "seven.npy"], Options(n_steps=4))
    assert ours["height"] == describe(result).height != record["height"]


def test_a_run_that_stops_early_says_so(result, stand_in, tmp_path):
    case = moose.write_case(result.mesh, tmp_path, "seven", n_steps=4)
    write_results(tmp_path / "recorded.e", result.nodes, [0.25, 0.5], result.displacement[:2], "NETCDF3_64BIT_OFFSET")
    stand_in(f"shutil.copy({str(tmp_path / 'recorded.e')!r}, 'seven_out.e'); sys.exit('Solve failed')")
    found = moose.run_case(result, case[0])
    assert not found.converged and found.reason == "MOOSE reached load step 2 of 4: Solve failed"
    assert np.array_equal(found.displacement[:2], result.displacement[:2]) and np.isnan(found.displacement[2:]).all()


@pytest.mark.parametrize("kind", ["NETCDF3_64BIT_OFFSET", "NETCDF4"])
def test_garbage_and_half_written_results_are_named(result, stand_in, tmp_path, kind):
    case = moose.write_case(result.mesh, tmp_path, "seven", n_steps=4)
    write_results(tmp_path / "recorded.e", result.nodes, result.load_steps, result.displacement, kind)
    whole = (tmp_path / "recorded.e").read_bytes()
    garbage = np.random.default_rng(0).bytes(5000)
    halves = [whole[: len(whole) * k // 8] for k in range(1, 8)] + [whole[:-8]]
    for content in (b"", b"garbage", garbage, whole[:4] + garbage, *halves):
        (tmp_path / "recorded.e").write_bytes(content)
        stand_in(f"shutil.copy({str(tmp_path / 'recorded.e')!r}, 'seven_out.e')")
        with pytest.raises(ValueError, match=r"seven_out\.e holds no displacements"):
            moose.run_case(result, case[0])


def test_results_that_are_no_numbers_do_not_count(result, stand_in, tmp_path):
    case = moose.write_case(result.mesh, tmp_path, "seven", n_steps=4)
    broken = result.displacement.copy()
    broken[1, 3] = np.nan
    write_results(tmp_path / "recorded.e", result.nodes, result.load_steps, broken, "NETCDF4")
    stand_in(f"shutil.copy({str(tmp_path / 'recorded.e')!r}, 'seven_out.e')")
    found = moose.run_case(result, case[0])
    assert not found.converged and "load step 1 of 4" in found.reason and np.isnan(found.displacement[1:]).all()


def test_a_script_that_hangs_takes_nothing_with_it(result, stand_in, tmp_path):
    """What a wrapper script started ends with it, though it still holds the pipe."""
    case = moose.write_case(result.mesh, tmp_path, "seven")
    stand_in(
        "import subprocess, time\n"
        "child = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(60)'])\n"
        f"pathlib.Path({str(tmp_path / 'child')!r}).write_text(str(child.pid)); time.sleep(60)"
    )
    with pytest.raises(RuntimeError, match=r"within 2 s"):
        moose.run_case(result, case[0], time_limit=2)
    child = int((tmp_path / "child").read_text())
    for _ in range(100):
        state = Path(f"/proc/{child}/stat")
        if not state.exists() or state.read_text().rsplit(")", 1)[1].split()[0] == "Z":
            break
        time.sleep(0.05)
    else:
        raise AssertionError("the child is still alive")


def test_a_program_that_cannot_run_is_said(result, stand_in, tmp_path):
    moose.write_case(result.mesh, tmp_path, "seven")
    stand_in("")
    (tmp_path / "bin" / "solid_mechanics-opt").write_bytes(b"\0no program")
    np.save(tmp_path / "seven.npy", load_sevens("digits").images[0])
    options = Options(n_steps=1, engine="moose", moose=tmp_path / "cases")
    (record,) = simulate_files([tmp_path / "seven.npy"], options)
    assert not record["converged"] and "solid_mechanics-opt" in record["reason"]


def test_results_replace_those_of_an_earlier_run_and_no_others(result, stand_in, tmp_path):
    case, out = moose.write_case(result.mesh, tmp_path, "seven")[0], tmp_path / "seven_out.e"
    write_results(tmp_path / "recorded.e", result.nodes, result.load_steps, result.displacement, "NETCDF4")
    stand_in(f"shutil.copy({str(tmp_path / 'recorded.e')!r}, 'seven_out.e')")
    for _ in range(2):
        moose.run_case(result, case)
        assert out.read_bytes() == (tmp_path / "recorded.e").read_bytes()
    stand_in("pathlib.Path('seven_out.e').write_text('half'); sys.exit('killed')")
    out.write_text("from a run of one's own")
    with pytest.raises(FileExistsError, match=r"seven_out\.e is there already"):
        moose.run_case(result, case)
    assert out.read_text() == "from a run of one's own"
    out.unlink()
    stand_in("pathlib.Path('seven_out.e').write_text('half'); import time; time.sleep(30)")
    with pytest.raises(RuntimeError, match="within 1 s"):
        moose.run_case(result, case, time_limit=1)
    assert not out.exists()


def test_a_run_without_results_says_why(result, stand_in, tmp_path, monkeypatch):
    case = moose.write_case(result.mesh, tmp_path, "seven")
    stand_in("sys.exit('*** ERROR *** unused parameter')")
    with pytest.raises(RuntimeError, match=r"exit code 1.*unused parameter"):
        moose.run_case(result, case[0])
    stand_in("import time; time.sleep(30)")
    with pytest.raises(RuntimeError, match=r"within 0\.5 s"):
        moose.run_case(replace(result), case[0], time_limit=0.5)
    monkeypatch.setenv("PATH", str(tmp_path / "nothing"))
    with pytest.raises(RuntimeError, match="solid_mechanics-opt nor combined-opt"):
        moose.find_program()
