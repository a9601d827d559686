"""Stresses from first principles, and files that others read back."""

from dataclasses import replace
from itertools import pairwise
from xml.etree import ElementTree

import matplotlib.pyplot as plt
import meshio
import numpy as np
import pytest
from PIL import Image

from inflate_lib import inflate, label_image
from inflate_lib.io import pictures
from inflate_lib.io.vtk import write_vtk
from inflate_lib.mechanics import stress
from inflate_lib.mechanics.inflation import MU
from inflate_lib.plotting.mechanics import animate_inflation
from inflate_lib.plotting.structures import draw_inflated
from inflate_lib.structures.labels import _EDGES
from inflate_lib.structures.sources import load_sevens


@pytest.fixture(scope="module")
def plain():
    return inflate(label_image(load_sevens("digits").images[0]), n_steps=2, element="q1")


@pytest.fixture(scope="module")
def mean():
    return inflate(label_image(load_sevens("digits").images[0]), n_steps=2)


@pytest.fixture
def stuck(mean):
    displacement = mean.displacement.copy()
    displacement[1] = np.nan
    return replace(mean, displacement=displacement, converged=False, reason="no equilibrium was found")


def three_dimensional(F):
    whole = np.zeros((*F.shape[:-2], 3, 3))
    whole[..., :2, :2], whole[..., 2, 2] = F, 1
    return whole


def test_plain_stress_is_the_law_in_three_dimensions(plain):
    """σ = (μ (B − I) + λ ln J I) / J with all of F, out of the plane too."""
    lam, mu = plain.lame
    F = three_dimensional(plain.deformation_gradient)
    J = np.linalg.det(F)[..., None, None]
    expected = (mu * (F @ np.swapaxes(F, -1, -2) - np.eye(3)) + lam * np.log(J) * np.eye(3)) / J
    assert np.allclose(stress.cauchy_stress(plain), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("element", ["plain", "mean"])
def test_von_mises_is_of_the_deviator(element, request):
    """√(3/2 s:s) with s the deviator of μ B / J: the isotropic part, which holds all of λ, drops out."""
    result = request.getfixturevalue(element)
    F = three_dimensional(result.deformation_gradient)
    s = result.lame[1] * F @ np.swapaxes(F, -1, -2) / np.linalg.det(F)[..., None, None]
    s = s - np.trace(s, axis1=-2, axis2=-1)[..., None, None] / 3 * np.eye(3)
    assert np.allclose(stress.von_mises(result), np.sqrt(1.5 * (s**2).sum((-1, -2))).mean(-1), rtol=0, atol=1e-12)


def test_largest_stretch_is_the_largest_singular_value(mean):
    expected = np.linalg.svd(mean.deformation_gradient, compute_uv=False)[..., 0].mean(-1)
    assert np.allclose(stress.largest_stretch(mean), expected, rtol=0, atol=1e-10)


def test_a_rigid_rotation_has_no_stress(mean):
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    moved = np.stack([mean.nodes @ turn.T - mean.nodes] * 2)
    turned = replace(mean, displacement=moved)
    assert np.abs(stress.cauchy_stress(turned)).max() < 1e-12
    assert np.abs(stress.von_mises(turned)).max() < 1e-12
    assert np.abs(stress.largest_stretch(turned) - 1).max() < 1e-7  # a double root


def test_paraview_series_comes_back(mean, tmp_path):
    *written, asked = write_vtk(mean, tmp_path / "new" / "seven.vtu")
    assert [path.name for path in written] == ["seven.pvd", "seven_000.vtu", "seven_001.vtu", "seven_002.vtu"]
    assert asked.name == "seven.vtu" and asked.read_bytes() == written[-1].read_bytes()
    listed = ElementTree.parse(written[0]).getroot().findall("Collection/DataSet")
    assert [float(entry.get("timestep")) for entry in listed] == [0, 0.5, 1]
    assert [entry.get("file") for entry in listed] == [path.name for path in written[1:]]
    F = three_dimensional(mean.deformation_gradient)
    first_piola = np.linalg.det(F)[..., None, None] * stress.cauchy_stress(mean) @ np.linalg.inv(np.swapaxes(F, -1, -2))
    for step, path in enumerate(written[1:]):
        grid = meshio.read(path)
        assert np.array_equal(grid.cells_dict["quad"], mean.cells)
        assert np.array_equal(grid.points[:, :2], mean.nodes)
        fields = {name: values[0] for name, values in grid.cell_data.items()}
        assert set(fields) == {"F", "P", "cauchy_stress", "von_mises", "largest_stretch", "shear_modulus"}
        assert np.all(fields["shear_modulus"] == MU)
        if step == 0:
            assert not grid.point_data["displacement"].any() and not fields["P"].any()
            assert np.array_equal(fields["F"], np.tile(np.eye(3).ravel(), (len(mean.cells), 1)))
            continue
        assert np.array_equal(grid.point_data["displacement"][:, :2], mean.displacement[step - 1])
        assert np.allclose(fields["F"], F[step - 1].mean(1).reshape(-1, 9), rtol=0, atol=1e-13)
        assert np.allclose(fields["P"], first_piola[step - 1].mean(1).reshape(-1, 9), rtol=0, atol=1e-10)
        assert np.array_equal(fields["von_mises"], stress.von_mises(mean)[step - 1])


def test_paraview_is_told_the_modulus_of_each_rubber(tmp_path):
    label = label_image(load_sevens("digits").images[0])
    result = inflate(label, n_steps=1, stiffness=np.where(np.arange(28) < 14, 1.0, 4.0)[None].repeat(28, axis=0))
    for path in write_vtk(result, tmp_path / "two.pvd")[1:]:
        right = result.nodes[result.cells].mean(axis=1)[:, 0] > 0.5
        (modulus,) = meshio.read(path).cell_data["shear_modulus"]
        assert np.array_equal(modulus, np.where(right, 4 * MU, MU))


def test_picture_and_animation(mean, tmp_path):
    picture = Image.open(pictures.write_picture(mean, tmp_path / "seven.png", "stretch"))
    assert len(np.unique(np.asarray(picture.convert("RGB")).reshape(-1, 3), axis=0)) > 50
    with Image.open(pictures.write_animation(mean, tmp_path / "seven.gif")) as animation:
        frames = []
        for number in range(animation.n_frames):
            animation.seek(number)
            frames.append(np.asarray(animation.convert("L"), dtype=int))
    assert len(frames) >= 3  # at rest and two load steps; equal frames at the end may be stored as one
    assert all(np.abs(a - b).max() > 100 for a, b in pairwise(frames[:3]))


def test_history_that_ends_at_rest_is_drawn(tmp_path):
    result = inflate(label_image(load_sevens("digits").images[0]), pressure=[0.01, 0])
    pictures.write_picture(result, tmp_path / "rest.png")
    values = np.concatenate([np.zeros((1, len(result.cells))), stress.von_mises(result)])
    fig, animation = animate_inflation(result, values, "von Mises stress", 2)
    animation.save(tmp_path / "rest.gif", writer="pillow")
    low, high = fig.axes[0].collections[-1].get_clim()
    assert high - low > 0.1 * values[1].max() > 0  # the colours are those of the fullest state
    plt.close(fig)


@pytest.mark.parametrize("edge", _EDGES)
def test_the_ground_is_drawn_behind_the_clamped_edge(edge):
    image = load_sevens("digits").images[0]
    result = inflate(label_image(image, clamped=edge), n_steps=1, clamped=edge)
    fig, ax = plt.subplots()
    draw_inflated(ax, result)
    (ground,) = ax.patches
    box = ground.get_bbox()
    held = result.nodes[result.mesh.clamped]
    across, along = (1, 0) if edge in ("bottom", "top") else (0, 1)
    assert box.min[along] == held[:, along].min() and box.max[along] == held[:, along].max()
    inner, outer = (box.max, box.min) if edge in ("bottom", "left") else (box.min, box.max)
    assert inner[across] == held[0, across] and abs(outer[across] - 0.5) > 0.5
    plt.close(fig)


def test_only_what_has_an_equilibrium_is_shown(stuck, tmp_path):
    assert [path.name for path in write_vtk(stuck, tmp_path / "s.pvd")] == ["s.pvd", "s_000.vtu", "s_001.vtu"]
    pictures.write_picture(stuck, tmp_path / "s.png")
    nothing = replace(stuck, displacement=np.full_like(stuck.displacement, np.nan))
    writers = {"s.pvd": write_vtk, "s.png": pictures.write_picture, "s.gif": pictures.write_animation}
    for name, write in writers.items():
        with pytest.raises(ValueError, match="nothing to export: no equilibrium"):
            write(nothing, tmp_path / name)


def test_what_cannot_be_written_is_said(mean, tmp_path):
    with pytest.raises(ValueError, match=r"must end with \.pvd or \.vtu"):
        write_vtk(mean, tmp_path / "a.xdmf")
    with pytest.raises(ValueError, match=r"must end with \.gif"):
        pictures.write_animation(mean, tmp_path / "a.mp4")
    with pytest.raises(ValueError, match="von-mises, stretch"):
        pictures.write_picture(mean, tmp_path / "a.png", "pretty")
