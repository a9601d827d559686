"""A descriptor of a user's own goes through the whole library by its name; and what cannot be registered is refused."""

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest

from inflate_lib import describe, design, inflate, label_image, load_sevens, paths, simulate_dataset
from inflate_lib.alternatives.surrogate import train_surrogate
from inflate_lib.datasets import simulate
from inflate_lib.datasets.pairs import TrainingSet
from inflate_lib.descriptors import Descriptor, descriptor_matrix, get_descriptor, register, registry
from inflate_lib.descriptors.registry import PARTS, added_version, columns, name_of
from inflate_lib.diffusion import TrainingConfig, train
from inflate_lib.experiments.metrics import errors
from inflate_lib.experiments.run import judge, run_experiment
from inflate_lib.experiments.tables import accuracy, score, scores
from inflate_lib.inverse import candidates
from inflate_lib.inverse.adjoint import sensitivities
from inflate_lib.inverse.constraints import Constraints
from inflate_lib.models.reach import check_reach, load_reach, save_reach
from inflate_lib.models.weights import Model
from inflate_lib.plotting.designs import plot_designs
from inflate_lib.plotting.evaluation import plot_held_out, plot_selection
from inflate_lib.plotting.results import plot_generated

DIGITS = load_sevens("digits").images
TRAINING = {"channels": [4, 8], "embedding": 16, "steps": 2, "batch_size": 8, "learning_rate": 1e-3}
FAST = {"sampler": "ddim", "steps": 2}


def slenderness(shape):
    width, height = np.ptp(shape.nodes, axis=0)
    return height / width


def follow_slenderness(nodes):
    """Its derivative, by the quotient rule."""
    height, width = (get_descriptor(name).gradient(nodes) for name in ("height", "width"))
    h, w = np.ptp(nodes, axis=0)[::-1]
    return height / w - h * width / w**2


def draw_slenderness(ax, target, nodes, **style):
    left, bottom = nodes.min(axis=0)
    ax.plot([left, left], [bottom, bottom + target[0] * np.ptp(nodes[:, 0])], gid="slenderness", **style)


def lean(shape):
    """How far the highest and the rightmost node are right of the middle of the hull's box."""
    middle = (shape.nodes[:, 0].min() + shape.nodes[:, 0].max()) / 2
    return shape.nodes[shape.nodes[:, 1].argmax(), 0] - middle, np.ptp(shape.nodes[:, 0]) / 2


def diagonal(shape):
    return np.hypot(*np.ptp(shape.nodes, axis=0))


def air(shape):
    start, end = np.moveaxis(shape.nodes[shape.result.mesh.pressure_edges], 1, 0)
    return np.sum(start[:, 0] * end[:, 1] - start[:, 1] * end[:, 0]) / 2


@pytest.fixture(autouse=True)
def own(monkeypatch):
    """Three descriptors; the registry, which lives as long as the process, forgets them afterwards."""
    monkeypatch.setattr(registry, "_registry", dict(registry._registry))
    register(Descriptor("slenderness", "r", slenderness, draw=draw_slenderness, gradient=follow_slenderness))
    register(Descriptor("lean", "l", lean, components=("top", "half"), unit="side", flip=lambda rows: rows * [-1, 1]))
    register(Descriptor("air", "V", air, unit="side²", of_nodes=False))


@pytest.fixture
def data(own):
    return simulate_dataset(DIGITS[:40], n_jobs=1, n_steps=2, progress_text=False)


def test_it_is_simulated_and_stored_like_the_others(data, monkeypatch):
    np.testing.assert_allclose(data["slenderness"], data["height"] / data["width"], rtol=1e-14)
    assert data["lean"].dims == ("structure", "lean_component")
    one = describe(inflate(label_image(DIGITS[3]), n_steps=2))
    for name in ("slenderness", "lean", "air"):
        np.testing.assert_allclose(one.vector(name), descriptor_matrix(data, name)[3], rtol=1e-9)
    assert one.vector("air") > 0 and np.isnan(describe([[0, 0], [1, 0], [0, 1]]).vector("air"))
    monkeypatch.setattr(simulate, "ALONE", 0)  # other processes, which know of no descriptor of ours
    elsewhere = simulate_dataset(DIGITS[:4], n_jobs=2, n_steps=2, progress_text=False)
    np.testing.assert_allclose(elsewhere["air"], data["air"][:4], rtol=1e-9)


def test_a_flip_does_to_it_what_it_says(data):
    images, lean_of = TrainingSet(data, "lean", 150).pairs
    again = simulate_dataset(images[-30:], n_jobs=1, n_steps=2, progress_text=False)
    assert (lean_of[-30:, 0] < 0).any() and (lean_of[-30:, 0] > 0).any()
    np.testing.assert_allclose(descriptor_matrix(again, "lean"), lean_of[-30:], atol=1e-6)


def test_it_goes_from_training_to_a_drawing(data, monkeypatch):
    pairs = TrainingSet(data, "slenderness", 100).pairs
    trained = train(*pairs, TrainingConfig.from_dict(TRAINING), progress=False)
    model = Model("slenderness", trained, FAST, reach=data)
    assert pairs[1].shape[1:] == (1,) and trained.condition_max[0] == pytest.approx(pairs[1].max())
    targets = np.quantile(pairs[1], [0.2, 0.5])[:, None]
    drawn = run_experiment(model, targets, 2, n_jobs=1)
    assert drawn.sizes["structure"] == 4 and "slenderness" in drawn
    with pytest.raises(ValueError, match=r"target 0 asks for r = 9"):
        run_experiment(model, [[9.0]], 2)

    known = judge(DIGITS[:8], "slenderness", targets, np.repeat([0, 1], 4), n_jobs=1)
    valid, reached = known["valid"].values, known["slenderness"].values
    relative = np.abs(reached / np.repeat(targets, 4) - 1)
    np.testing.assert_allclose(errors(known, "slenderness"), relative)
    measured = scores(known, "slenderness", data, n_resamples=20)
    assert score(measured, "median error / target") == pytest.approx(100 * np.median(relative[valid]))
    assert accuracy(known, "slenderness")["mean r"][0] == pytest.approx(reached[:4][valid[:4]].mean())
    fig = plot_generated(known, "slenderness", 2)
    assert len(fig.findobj(lambda artist: artist.get_gid() == "slenderness")) == 4
    assert any("$r$" in text.get_text() for text in fig.findobj(plt.Text))

    assert model.draw({"slenderness": targets[0, 0]}, 2).shape == (2, 28, 28)
    monkeypatch.setattr(candidates, "generate", lambda *_, **__: DIGITS[:40].astype(np.float32) / 255)
    found = design(
        {"slenderness": reached[2], "width": float(known["width"][2])}, 2, model=model, data=known,
        start_from="model", max_candidates=40, refine=2, n_jobs=1, say=None,
    )  # fmt: skip
    assert found.table()["slenderness"][0] == pytest.approx(reached[2])
    assert found.designs[0].error < 1e-9 and set(found.designs[0].deviations) == {"slenderness", "width"}
    assert found.targets.as_dict()["slenderness"] == pytest.approx(reached[2])
    fig = plot_designs(found)
    lines = fig.findobj(lambda artist: artist.get_gid() == "slenderness")
    assert len(lines) == len(found.designs)
    assert np.ptp(lines[0].get_ydata()) == pytest.approx(reached[2] * np.ptp(found.designs[0].result.deformed()[:, 0]))
    plt.close("all")
    with pytest.raises(ValueError, match=r"slenderness 9 is out of reach"):
        design({"slenderness": 9}, model=model, data=data)
    for wrong in ("tall", np.nan, [1.0, 2.0], None):
        with pytest.raises(ValueError, match=r"slenderness must be 1 finite number|nothing is asked for"):
            design({"slenderness": wrong}, model=model, data=data)


def test_a_design_follows_its_gradient():
    """Only the ratio of pressure and stiffness matters: dr/ds for all elements together is −p dr/dp."""
    label, h = label_image(DIGITS[5]), 1e-4
    plus, minus = (describe(inflate(label, pressure=0.01 * (1 + e))).vector("slenderness")[0] for e in (h, -h))
    derivatives = sensitivities(inflate(label), get_descriptor("slenderness").gradient)
    assert derivatives.sum() == pytest.approx(-(plus - minus) / (2 * h), rel=1e-4)


def test_what_it_says_about_others_is_held_against_them(data, tmp_path):
    register(Descriptor("diagonal", "d", diagonal, unit="side", bounds={"height": lambda vector: (0, vector[0])}))
    again = data.assign(diagonal=np.hypot(data["height"], data["width"]))
    save_reach(again, tmp_path)
    for known in (again, load_reach(tmp_path)):
        with pytest.raises(ValueError, match=r"height 1.2 contradicts diagonal 1, with which it is at most 1\."):
            check_reach({"diagonal": np.array([1.0]), "height": np.array([1.2])}, known)
        with pytest.raises(
            ValueError, match=r"lean half 9 is out of reach.* reach lean top .* lean half 0\.\d+ to 0\.\d+"
        ):
            check_reach({"lean": np.array([0.0, 9.0])}, known)
    model = Model("lean", None, reach=data)
    with pytest.raises(ValueError, match=r"a symmetric structure has the lean of its mirror image.* is 0.500 away"):
        design({"lean": [0.1, 0.4]}, model=model, constraints=Constraints(symmetric=True))


def test_a_surrogate_answers_with_it_and_figures_tell_it_apart(data, tmp_path, monkeypatch):
    monkeypatch.setattr(paths, "CACHE", tmp_path)
    trained = train_surrogate(data, steps=2)
    assert trained.answers == "height+width+area+axis+outline+slenderness+lean"
    assert trained.predict(DIGITS[:3], "lean").shape == (3, 2)
    with pytest.raises(ValueError, match=r"answers with height, .* not air"):
        trained.predict(DIGITS[:3], "air")
    known = judge(DIGITS[:4], "air", np.array([[0.3]]), np.zeros(4, dtype=int), n_jobs=1)
    assert plot_held_out({"air": known}).axes[0].get_title() == "air $V$"
    rows = pd.DataFrame({"by": "simulation", "n": [1, 4], "median": [2.0, 1.0], "seconds": [1.0, 4.0]})
    assert [ax.get_title() for ax in plot_selection({"slenderness": rows, "air": rows}).axes] == ["slenderness", "air"]
    plt.close("all")


def test_results_that_are_kept_know_which_descriptors_they_hold(monkeypatch):
    with_three = added_version()
    register(Descriptor("air", "V", slenderness))
    other = added_version()
    monkeypatch.setattr(registry, "_registry", {name: get_descriptor(name) for name in registry.OWN})
    assert added_version() == "" and len({with_three, other, ""}) == 3
    register(Descriptor("air", "V", eval("lambda shape: 1.0")))
    with pytest.raises(ValueError, match="air: the source of its function cannot be found"):
        added_version()


def test_data_from_before_lack_it(data):
    with pytest.raises(ValueError, match="no variable air: register air before"):
        descriptor_matrix(data.drop_vars("air"), "air")


@pytest.mark.parametrize(
    ("descriptor", "message"),
    [
        ({"name": "height", "symbol": "H", "measure": air}, "height is a descriptor of the library's own"),
        ({"name": "label", "symbol": "L", "measure": air}, "a variable label already"),
        ({"name": "mine", "symbol": "m"}, "either a function measures it, or it has parts"),
        ({"name": "mine", "symbol": "m", "parts": ("hight",)}, "unknown descriptor 'hight'; choose one of height"),
        ({"name": "mine", "symbol": "m", "measure": air, "sizes": {"k": 3}}, "1 components do not fill the sizes"),
    ],
)
def test_what_cannot_be_registered_is_refused(descriptor, message):
    with pytest.raises(ValueError, match=message):
        register(Descriptor(**descriptor))


def test_descriptors_together_have_a_name_and_their_columns():
    assert name_of(["width", "height"]) == "box" and name_of(["area"]) == "area"
    assert name_of(["area", "height"]) == "height+area"
    assert get_descriptor("height+area").components == ("h", "A")
    assert columns("box", ("width", "area", "height")).tolist() == [0, 2]
    assert get_descriptor("joint").length == sum(get_descriptor(name).length for name in PARTS)
    with pytest.raises(ValueError, match=r"the joint model takes height, width, .*, not air"):
        get_descriptor("joint").conditions("air", [[0.3]])
