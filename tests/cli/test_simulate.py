"""``inflate simulate``: image files in, numbers and files out; a bad image spoils nothing but itself."""

import json
import os
import resource
import signal
import subprocess
import sys

import meshio
import numpy as np
import pytest
from PIL import Image

import inflate_lib
from inflate_lib import describe, inflate, label_image
from inflate_lib.alternatives.patterns import pattern, rubber_picture, stiffness_of
from inflate_lib.cli import _images, app
from inflate_lib.cli._images import Options, simulate_files
from inflate_lib.io.pictures import read_images
from inflate_lib.mechanics.buildable import Flaw
from inflate_lib.structures.labels import _EDGES
from inflate_lib.structures.sources import load_sevens

DIGITS = load_sevens("digits").images


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Image.fromarray(DIGITS[0]).save("seven.png")
    np.save("stack.npy", DIGITS[:2] / 255)
    (tmp_path / "bad.png").write_text("no picture")
    Image.fromarray(255 - np.kron(DIGITS[1], np.ones((4, 4), dtype=np.uint8))).save("drawing.png")
    return tmp_path


@pytest.fixture
def run(monkeypatch, capsys):
    """Run the command; returns exit code, stdout, stderr."""

    def command(*arguments):
        monkeypatch.setattr(sys, "argv", ["inflate", "simulate", *arguments])
        with pytest.raises(SystemExit) as end:
            app.run()
        code = end.value.code
        out, err = capsys.readouterr()
        if isinstance(code, str):  # sys.exit with a message
            return 1, out, err + code
        return code or 0, out, err

    return command


def test_numbers_are_those_of_the_library(folder, run):
    code, out, err = run("seven.png", "stack.npy", "--json", "--steps", "2")
    assert code == 0 and "3 of 3 structures inflated" in err
    said = json.loads(out)
    assert said["parameters"]["lame"] == [16.44, 0.1644] and said["parameters"]["n_steps"] == 2
    first, second, third = said["structures"]
    assert [first["name"], second["name"], third["name"]] == ["seven", "stack_000", "stack_001"]
    for record, image in ((first, DIGITS[0]), (second, DIGITS[0]), (third, DIGITS[1])):
        expected = describe(inflate(label_image(image), n_steps=2))
        assert record["converged"] and not record["reason"]
        assert (record["height"], record["width"], record["hull_area"]) == (
            expected.height, expected.width, expected.hull_area,
        )  # fmt: skip
        assert np.array_equal(record["medial_axis"], expected.medial_axis)


def test_a_bad_image_is_one_line_and_the_others_go_on(folder, run):
    np.save("blank.npy", np.zeros((28, 28)))
    code, out, err = run("bad.png", "missing.png", "drawing.png", "blank.npy", "seven.png", "--steps", "1")
    assert code == 1
    lines = err.strip().splitlines()
    assert len(lines) == 5
    for line, words in zip(lines, ("cannot be read", "does not exist", "112 × 112", "blank", "1 of 5"), strict=True):
        assert words in line
    assert "seven" in out and "0.9" in out and "bad" not in out
    code, out, _ = run("bad.png", "seven.png", "--json", "--steps", "1")
    bad, good = json.loads(out)["structures"]
    assert code == 1 and bad["height"] is None and "bad.png" in bad["reason"] and good["height"] > 0


def test_the_command_has_the_defaults_of_the_library(folder, run):
    parameters = json.loads(run("seven.png", "--json")[1])["parameters"]
    assert Options(**parameters | {"lame": tuple(parameters["lame"])}) == Options()
    result = inflate(label_image(DIGITS[0]))
    assert (tuple(parameters["lame"]), parameters["element"], parameters["pressure"]) == (
        result.lame, result.element, result.pressures[-1],
    )  # fmt: skip
    assert parameters["n_steps"] is None and len(result.load_steps) == 10


def test_every_parameter_reaches_the_solver(folder, run):
    options = ["--lame", "3", "0.3", "--pressure", "0.02", "--wall", "3", "--refine", "2", "--element", "q1"]
    code, out, _ = run("seven.png", "--json", "--steps", "3", *options)
    (record,) = json.loads(out)["structures"]
    result = inflate(label_image(DIGITS[0], wall=3), 3, "q1", 2, 0.02, (3, 0.3))
    assert code == 0 and record["height"] == describe(result).height


@pytest.mark.parametrize("edge", _EDGES)
def test_any_edge_is_clamped(folder, run, edge):
    code, out, _ = run("seven.png", "--json", "--steps", "2", "--clamp", edge, "--moose", "cases")
    result = inflate(label_image(DIGITS[0], clamped=edge), 2, clamped=edge)
    assert code == 0 and json.loads(out)["structures"][0]["height"] == describe(result).height
    assert np.array_equal(meshio.read("cases/seven.e").point_sets["clamped"], np.flatnonzero(result.mesh.clamped))


def test_history_is_followed_step_by_step(folder, run):
    (folder / "plain.csv").write_text("0.005\n0.01\n\n0.0\n")
    (folder / "sheet.csv").write_text("\ufeffpressure\r\n5e-3\r\n0.01\r\n0\r\n", encoding="utf-8")
    result = inflate(label_image(DIGITS[0]), pressure=[0.005, 0.01, 0])
    expected = [
        {"time": t, "pressure": p, "height": shape.height, "width": shape.width, "hull_area": shape.hull_area}
        for t, p, shape in zip(
            (1 / 3, 2 / 3, 1), (0.005, 0.01, 0), (describe(result, k) for k in range(3)), strict=True
        )
    ]
    for history in ("0.005,0.01,0", " 0.005, 1e-2, 0.0", "plain.csv", "sheet.csv"):
        code, out, _ = run("seven.png", "--json", "--history", history, "--moose", "cases")
        (record,) = json.loads(out)["structures"]
        assert code == 0 and record["load_steps"] == expected
        assert record["height"] == pytest.approx(describe(result.nodes).height, abs=1e-11)
        assert "y = '0 0.005 0.01 0.0'" in (folder / "cases" / "seven.i").read_text()


def test_files_carry_the_name_of_their_structure(folder, run):
    wanted = ["--vtk", "out/pv.vtu", "--moose", "cases", "--plot", "out/p.png"]
    code, out, _ = run("seven.png", *wanted, "--steps", "2", "--json")
    assert code == 0 and json.loads(out)["structures"][0]["files"] == [
        "cases/seven.i", "cases/seven.e", "out/p.png", "out/pv.pvd", "out/pv.vtu",
    ]  # fmt: skip
    with Image.open("out/p.png") as picture:
        assert min(picture.size) > 200
    for name in ("pv_002.vtu", "pv.vtu"):
        assert np.isfinite(meshio.read(folder / "out" / name).point_data["displacement"]).all()
    (folder / "again").mkdir()
    Image.fromarray(DIGITS[1]).save("again/seven.png")
    code, out, _ = run("seven.png", "again/seven.png", "--moose", "cases", "--vtk", "two.pvd", "--steps", "1", "--json")
    assert code == 0 and [record["files"] for record in json.loads(out)["structures"]] == [
        ["cases/seven.i", "cases/seven.e", "two_seven.pvd"],
        ["cases/seven-2.i", "cases/seven-2.e", "two_seven-2.pvd"],
    ]


def test_a_structure_without_equilibrium_is_a_failure_with_a_reason(folder, run):
    code, out, err = run("seven.png", "--pressure", "5", "--json", "--moose", "cases")
    (record,) = json.loads(out)["structures"]
    assert code == 1 and not record["converged"] and "no equilibrium was found" in record["reason"]
    assert record["files"] == ["cases/seven.i", "cases/seven.e"] and "no equilibrium" in err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--colour", "pretty"], "von-mises, stretch"),
        (["--engine", "other"], "built-in, moose"),
        (["--engine", "moose"], "--moose DIR"),
        (["--gif", "a.mp4"], r".gif"),
        (["--vtk", "a.xdmf"], ".pvd or .vtu"),
        (["--lame", "-1", "1"], "lame"),
        (["--element", "q9"], "mean-dilatation"),
        (["--clamp", "ceiling"], "bottom, left, top, right"),
        (["--history", "0.01", "--pressure", "0.01"], "--pressure"),
        (["--element", "cubic"], "inflate: element must be one of"),
        (["--lame", "16", "0"], "inflate: lame must be two positive numbers"),
        (["--element", "stabilised", "--contact"], "inflate: contact: the stabilised element has none"),
        (["--history", "0.01", "--steps", "1"], "--steps"),
        (["--history", "0.01,high"], "'0.01,high' is neither"),
        (["--history", "nothing.csv"], "'nothing.csv' is neither"),
        (["--history", "bad.png"], "bad.png must have one pressure per line"),
        (["--history", "table.csv"], "table.csv must have one pressure per line"),
        (["--history", "empty.csv"], "pressure must be"),
        (["--history", "0.01,nan"], "pressure must be"),
    ],
)
def test_options_that_make_no_sense_are_one_line(folder, run, arguments, message):
    (folder / "table.csv").write_text("0.5,0.005\n1,0.01\n")
    (folder / "empty.csv").write_text("pressure\n")
    code, _, err = run("seven.png", *arguments)
    assert code == 1 and message in err and "Traceback" not in err


def test_without_moose_the_engine_says_so(folder, run, monkeypatch):
    monkeypatch.setenv("PATH", str(folder))
    code, _, err = run("seven.png", "--engine", "moose", "--moose", "cases")
    assert code == 1 and "inflate: MOOSE is not here" in err and not (folder / "cases").exists()


def test_pictures_of_another_size_are_fitted_on_request(folder):
    images, note = read_images("drawing.png", resize=True, invert=True)
    assert note == "resized from 112 × 112" and np.array_equal(images[0], DIGITS[1])
    Image.fromarray(np.full((10, 40), 255, dtype=np.uint8)).save("wide.png")
    (wide,), _ = read_images("wide.png", resize=True)
    assert wide.shape == (28, 28) and wide[11:17].min() == 255 and not wide[:10].any() and not wide[18:].any()
    (record,) = simulate_files(["drawing.png"], Options(resize=True, invert=True, n_steps=1))
    assert record["converged"] and record["note"] == "resized from 112 × 112"


def test_what_cannot_be_built_is_said_with_the_reason(folder, run):
    """It is inflated all the same: two rooms that share a corner, and legs that bulge into one another."""
    rooms, arch = np.zeros((2, 28, 28), np.uint8)
    rooms[6:16, 12:15] = rooms[16:26, 15:18] = 255
    arch[4:24, 6:9] = arch[4:24, 14:17] = arch[4:7, 6:17] = 255
    np.save("three.npy", [DIGITS[0], rooms, arch])
    code, out, err = run("three.npy", "--json")
    assert code == 0 and [one["converged"] for one in json.loads(out)["structures"]] == [True] * 3
    assert [one["flaw"] for one in json.loads(out)["structures"]] == ["", Flaw.POINT_JOINT, Flaw.CROSSING_WALLS]
    assert f"three_001: inflated, but it cannot be built. {Flaw.POINT_JOINT}" in err and "three_000:" not in err


def test_a_stack_is_a_row_for_each_picture_and_what_is_left_out_is_noted(folder, run):
    drawing = np.zeros((28, 28), np.uint8)
    drawing[5:20, 5:15] = 255
    drawing[9, 9] = 255 - drawing[9, 9]
    drawing[3, 25] = 255
    Image.fromarray(DIGITS[0]).save("pages.tif", save_all=True, append_images=[Image.fromarray(drawing)])
    note = "1 smaller piece of 1 pixel dropped, 1 hole of 1 pixel filled"
    code, out, _ = run("pages.tif", "--json", "--steps", "1")
    first, second = json.loads(out)["structures"]
    assert code == 0 and (first["name"], second["name"]) == ("pages_000", "pages_001")
    assert first["note"] == "" and second["note"] == note
    code, out, _ = run("pages.tif", "--steps", "1")
    assert code == 0 and f"pages_001 ({note})" in " ".join(out.split())


@pytest.mark.parametrize(
    ("name", "write", "message"),
    [
        ("deep.tif", lambda p: Image.fromarray(np.zeros((28, 28), np.float32)).save(p), "range is not known"),
        ("clear.png", lambda p: Image.new("RGBA", (28, 28)).save(p), "transparent"),
        ("cut.png", lambda p: p.write_bytes((p.parent / "seven.png").read_bytes()[:60]), "cannot be read"),
        ("cube.npy", lambda p: np.save(p, np.zeros((2, 3, 4, 5))), "shape"),
        ("none.npy", lambda p: np.save(p, np.zeros((0, 28, 28))), "shape"),
        ("object.npy", lambda p: np.save(p, np.array([None]), allow_pickle=True), "NumPy"),
        ("empty.npy", lambda p: p.write_bytes(b""), "NumPy"),
    ],
)
def test_files_that_are_no_image_are_named(folder, name, write, message):
    write(folder / name)
    with pytest.raises(ValueError, match=f"{name}.*{message}"):
        read_images(folder / name)


def test_colour_and_palette_pictures_are_read_as_grey(folder):
    for mode in ("RGB", "1", "P"):
        Image.fromarray(255 * (DIGITS[0] > 127).astype(np.uint8)).convert(mode).save("other.png")
        assert np.array_equal(read_images("other.png")[0][0] > 127, DIGITS[0] > 127)


KINDS = {"--plot": "out.png", "--gif": "out.gif", "--vtk": "out.vtu", "--moose": "out"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["seven.png", "--plot", "seven.png"], "input seven.png"),
        (["seven.png", "--plot", "./Seven.PNG"], "input seven.png"),
        (["link.png", "--plot", "seven.png"], "input link.png"),
        (["seven.png", "--plot", "link.png"], "input seven.png"),
        (["seven.png", "--plot", "hard.png"], "input seven.png"),
        (["seven.png", "--plot", "history.svg", "--history", "history.svg"], "input history.svg"),
        (["seven.png", "x.png", "x_x.png", "--plot", "x.png"], "input x_x.png"),
        (["x.png", "x_000.png", "--vtk", "out.vtu"], "two files would have the name out_x_000.vtu"),
        (["seven.png", "--vtk", "out.vtu", "--moose", "out.vtu"], "a file and a folder"),
        (["seven.png", "--plot", "mine.png"], "mine.png is there already"),
        (["seven.png", "--gif", "mine.gif"], "mine.gif is there already"),
        (["seven.png", "--vtk", "mine.pvd"], "mine_001.vtu is there already"),
        (["seven.png", "--moose", "mine"], "mine/seven.e is there already"),
        (["seven.png", "--moose", "seven.png"], "seven.png is no folder"),
        (["seven.png", "--plot", "folder.png"], "folder.png is a folder"),
        (["seven.png", "--plot", "fifo.png"], "fifo.png is there already"),
        (["seven.png", "--plot", "/proc/out.png"], "/proc/out.png cannot be written"),
    ],
)
def test_files_in_the_way_are_kept_and_named_before_the_work(folder, run, monkeypatch, arguments, message):
    for name in ("x.png", "x_x.png", "x_000.png"):
        (folder / name).write_bytes((folder / "seven.png").read_bytes())
    (folder / "mine").mkdir()
    for name in ("mine.png", "mine.gif", "mine_001.vtu", "mine/seven.e"):
        (folder / name).write_text("mine")
    (folder / "history.svg").write_text("0.005\n0.01\n")
    (folder / "folder.png").mkdir()
    os.mkfifo(folder / "fifo.png")
    (folder / "link.png").symlink_to(folder / "seven.png")
    (folder / "hard.png").hardlink_to(folder / "seven.png")
    monkeypatch.setattr(_images, "inflate_with", None)  # so that nothing is inflated
    before = state(folder)
    code, _, err = run(*arguments)
    assert code == 1 and message in err and "Traceback" not in err
    assert state(folder) == before


def state(folder):
    return {str(path): path.read_bytes() if path.is_file() else b"" for path in folder.rglob("*")}


def test_the_same_command_again_replaces_what_it_wrote(folder, run):
    wanted = ["--plot", "out.png", "--vtk", "out.vtu", "--moose", "out", "--steps", "2"]
    for image in ("seven.png", "stack.npy", "seven.png"):
        assert run(image, *wanted)[0] == 0
    (folder / "out.vtu").write_text("mine now")
    code, _, err = run("seven.png", *wanted)
    assert code == 1 and "out.vtu is there already" in err and (folder / "out.vtu").read_text() == "mine now"


@pytest.mark.parametrize(
    ("option", "name"), [*KINDS.items(), *(("--plot", f"out.{ending}") for ending in ("pdf", "svg", "jpg", "tif"))]
)
def test_a_full_disk_leaves_nothing_and_names_the_file(folder, run, option, name):
    """The limit on the size of a file stands in for the disk."""
    inflate(label_image(DIGITS[0]), n_steps=1)  # compiled code is kept in files as well
    before, there = resource.getrlimit(resource.RLIMIT_FSIZE), state(folder)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (3_000, before[1]))
        code, _, err = run("seven.png", "--steps", "3", option, f"new/{name}")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, ignored)
    assert code == 1 and "File too large: 'new/out" in err and state(folder) == there


@pytest.mark.parametrize(("option", "name"), [*((option, "SIGINT") for option in KINDS), ("--vtk", "SIGTERM")])
def test_an_interruption_leaves_nothing(folder, run, monkeypatch, option, name):
    """The signal arrives when the first file has been written, but not all of it has been handed out."""

    def interrupt(_, target, *__):
        signal.raise_signal(getattr(signal, name))

    signal.signal(signal.SIGINT, signal.default_int_handler)  # which a shell's background job does without
    there = state(folder)
    monkeypatch.setattr("os.replace", interrupt)
    assert run("seven.png", "--steps", "2", option, f"new/{KINDS[option]}")[0] != 0
    assert state(folder) == there


def test_meshes_are_not_results_of_other_cases(folder, run):
    (folder / "seven_out.png").write_bytes((folder / "seven.png").read_bytes())
    for order in (["seven.png", "seven_out.png"], ["seven_out.png", "seven.png"]):
        code, out, _ = run(*order, "--moose", "cases", "--steps", "1", "--json")
        meshes = [record["files"][1] for record in json.loads(out)["structures"]]
        assert code == 0 and not {mesh.replace(".e", "_out.e") for mesh in meshes} & set(meshes)


@pytest.mark.parametrize("ending", [".png", ".PNG", ".jpg", ".jpeg", ".JPEG", ".tif", ".TIFF", ".svg", ".SVG", ".pdf"])
def test_endings_are_taken_for_what_they_are(folder, run, ending):
    code, out, err = run("seven.png", "--steps", "1", "--plot", f"Out{ending}", "--json")
    assert code == 0 and json.loads(out)["structures"][0]["files"] == [f"Out{ending}"], err
    if ending.lower() not in (".svg", ".pdf"):
        with Image.open(f"Out{ending}") as picture:
            assert picture.format == {".jpg": "JPEG", ".jpeg": "JPEG", ".png": "PNG"}.get(ending.lower(), "TIFF")
        Image.fromarray(DIGITS[0]).save(f"in{ending}", quality=100)
        assert run(f"in{ending}", "--steps", "1")[0] == 0


def test_capital_endings_of_series_and_animations(folder, run):
    for name, files in (("Out.PVD", ["Out.PVD"]), ("Two.VTU", ["Two.pvd", "Two.VTU"]), ("Out.GIF", ["Out.GIF"])):
        option = "--gif" if name.endswith("GIF") else "--vtk"
        code, out, _ = run("seven.png", "--steps", "1", option, name, "--json")
        assert code == 0 and json.loads(out)["structures"][0]["files"] == files
        assert set(files) <= set(os.listdir(folder))


def test_version(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["inflate", "--version"])
    with pytest.raises(SystemExit) as end:
        app.run()
    assert not end.value.code and capsys.readouterr().out == f"inflate {inflate_lib.__version__}\n"


def test_contact_is_that_of_the_library(folder, run):
    code, out, _ = run("seven.png", "--contact", "--json", "--steps", "2")
    said = json.loads(out)
    expected = describe(inflate(label_image(DIGITS[0]), n_steps=2, contact=True))
    assert code == 0 and said["parameters"]["contact"] is True
    assert said["structures"][0]["width"] == expected.width
    code, _, err = run("seven.png", "--contact", "--moose", "cases")
    assert code == 1 and "contact: the cases for MOOSE have none" in err and not (folder / "cases").exists()


@pytest.fixture
def two_rubbers(folder):
    """A picture of two rubbers, and the pair that it is made from."""
    stiff = pattern(DIGITS[0], "side", np.random.default_rng(1))
    Image.fromarray(rubber_picture(DIGITS[0], stiff)).save("two.png")
    return DIGITS[0], stiff


def test_a_picture_of_two_rubbers_is_inflated_as_such(two_rubbers, run):
    image, stiff = two_rubbers
    for options, how in (((), {}), (("--clamp", "left"), {"clamped": "left"})):
        code, out, _ = run("two.png", "--rubbers", "4", "--json", "--steps", "2", *options)
        (record,) = json.loads(out)["structures"]
        stiffness = stiffness_of(image, stiff, 4.0, **how)
        expected = describe(inflate(label_image(image, **how), n_steps=2, stiffness=stiffness, **how))
        assert code == 0 and record["note"] == "" and record["height"] == expected.height
    code, out, _ = run("two.png", "--json", "--steps", "2")
    (record,) = json.loads(out)["structures"]
    assert record["height"] == describe(inflate(label_image(image), n_steps=2)).height
    assert "--rubbers" in record["note"]


def test_files_tell_the_rubbers_apart(two_rubbers, run):
    code, _, _ = run("two.png", "--rubbers", "4", "--steps", "1", "--vtk", "o.pvd", "--moose", "m", "--plot", "o.png")
    assert code == 0
    assert {round(float(mu), 4) for mu in meshio.read("o_001.vtu").cell_data["shear_modulus"][0]} == {0.1644, 0.6576}
    assert len(meshio.read("m/two.e").cells) == 2


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["two.png", "--rubbers", "0"], "rubbers must be a positive number"),
        (["two.png", "--rubbers", "4", "--invert"], "leave these out"),
        (["drawing.png", "--rubbers", "4", "--resize"], "leave these out"),
        (["seven.png", "--rubbers", "4"], "its grey levels must be 0 (outside), 64 (stiff wall)"),
    ],
)
def test_what_is_no_picture_of_two_rubbers_is_refused(two_rubbers, run, arguments, words):
    code, _, err = run(*arguments)
    assert code == 1 and words in err and "Traceback" not in err


def test_it_starts_without_what_it_does_not_need():
    """Together they would take longer to import than a structure takes to inflate, many times."""
    heavy = "torch", "xarray", "pandas", "seaborn", "sklearn"
    code = f"import sys, inflate_lib.cli._images; print(sys.modules.keys() & {set(heavy)})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
