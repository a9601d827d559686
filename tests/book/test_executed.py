"""What a run of all notebooks left, under the profile ci or the edition's: `pytest -m book`."""

import json

import pytest

from inflate_lib import paths
from inflate_lib.book.build import _warnings_in, check_book
from inflate_lib.book.page import recorded
from inflate_lib.book.run import executed_under, find_notebooks

pytestmark = pytest.mark.book
NAMES = [path.stem for path in find_notebooks()]
PROFILE = (executed_under(paths.EXECUTED / f"{NAMES[0]}.ipynb") or {}).get("profile")

#: What no machine should change, with a relative tolerance; whatever the sevens are.
GOLDEN = {
    "01_forward_process": {"cosine_first_beta": (4.128422482196914e-05, 1e-12), "cosine_steps_signal": (497, 0)},
    "02_reverse_process": {
        "added_last": (499.5, 1e-6),
        "added_middle": (0.0031174297, 1e-6),
        "ancestral_mean": (0.2, 0.02),
    },
    "03_samplers": {
        "last_image_off": (202.9117, 1e-5),
        "guided_once": (0.5, 0.02),
        "calibrated_scatter": (0.0902, 0.05),
    },
    "13_comparison": {"n_numbers": (39, 0)},
    "16_best_of_many": {"best_targets": (40, 0)},
    "17_control": {"controls_goal": (0.1, 1e-12)},
    "19_verification": {
        "inner_radius": (0.7481541132, 1e-8),
        "tube_error_percent": (0.8167559, 1e-6),
        "arch_pairs": (8, 0),
    },
    "20_tools": {"drawing_height": (1.1598597797, 1e-8), "softer_percent": (3.4038248626, 1e-6)},
}

#: The same, under the profile ci.
OF_CI = {
    "09_training": {"n_parameters": (369721, 0)},
    "22_explorer": {"n_targets": (37, 0)},
    "23_extending": {"n_learned": (300, 0)},
    "24_all_digits": {"n_lost": (11, 0), "n_through": (5, 0)},
}

#: The same, where the sevens are MNIST's.
OF_MNIST = {
    "04_structures": {"n_images": (6265, 0), "n_open": (0, 0), "n_thinned": (3942, 0)},
    "05_inflation": {"height": (0.9848232265, 1e-8), "n_cells": (212, 0)},
    "06_descriptors": {"height_after": (0.9848232265, 1e-8), "hull_area_after": (0.7369481474653206, 1e-8)},
    "07_augmentation": {"n_allowed": (279914, 0), "n_drawn": (71616, 0)},
    "08_dataset": {"n_converged": (6265, 0), "mean_height": (1.03461646, 1e-7), "mean_hull_area": (0.76989201, 1e-7)},
    "10_targets": {
        "mean_deviation_percent": (0.9688360362687741, 1e-6),
        "largest_deviation_percent": (2.416231514188971, 1e-6),
        "height_least_percent": (-0.7387846, 1e-6),
        "height_most_percent": (-0.1857879, 1e-6),
        "width_least_percent": (1.3130133, 1e-6),
        "width_most_percent": (2.4162315, 1e-6),
    },
    "11_scalar_targets": {"chance_error_height": (11.558098879649448, 1e-6)},
    "12_medial_axes": {"axis_chance_px": (3.2710542921283, 1e-6)},
    "13_comparison": {"table1_largest_deviation": (2.416231514188971, 1e-6)},
    "14_accuracy": {"n_yardstick": (200, 0), "yardstick_smallest": (0.0649023, 1e-5)},
    "15_baselines": {"here_retrieval": (0.0021771069, 1e-6)},
    "18_design": {"reach_height": (1.4867695172, 1e-8)},
    "21_speed": {"factorisations_ten": (184, 0.02), "factorisations_one": (104, 0.04)},
    "24_all_digits": {"slimmest": (1.6043243, 1e-6)},
    "25_two_rubbers": {"moved_one": (-0.07554042879, 1e-6), "moved_left": (-0.28056093747, 1e-3)},
}


def executed(name):
    return json.loads((paths.EXECUTED / f"{name}.ipynb").read_text(encoding="utf-8"))


def test_every_page_is_fresh():
    check_book(PROFILE)


@pytest.mark.parametrize("name", NAMES)
def test_notebook_ran_to_its_end_without_errors_or_warnings(name):
    cells = [cell for cell in executed(name)["cells"] if cell["cell_type"] == "code"]
    assert all(cell["execution_count"] for cell in cells if "".join(cell["source"]).strip())
    outputs = [output for cell in cells for output in cell["outputs"]]
    assert not [output for output in outputs if output["output_type"] == "error"]
    ours = [
        text for text in _warnings_in(paths.EXECUTED / f"{name}.ipynb") if "inflate_lib" in text or "ipykernel" in text
    ]
    assert not ours  # what another package says of this machine is listed by `inflate book`, and is no fault


@pytest.mark.parametrize("name", NAMES)
def test_what_a_notebook_published_has_its_provenance(name):
    published = executed(name)["metadata"]["inflate"]["published"]
    notes = [paths.FIGURES / file for file in published if file.endswith(".json")]
    for note in map(json.loads, (path.read_text(encoding="utf-8") for path in notes)):
        assert note["notebook"] == name
        assert note["profile"] == PROFILE
        assert note["data_source"] in {"mnist", "digits"}
        assert all((paths.FIGURES / PROFILE / file).stat().st_size for file in note["files"])


def test_no_two_notebooks_publish_under_one_name():
    owner = {}
    for name in NAMES:
        for file in executed(name)["metadata"]["inflate"]["published"]:
            assert owner.setdefault(file, name) == name, f"{file} comes from {owner[file]} and {name}"


@pytest.mark.parametrize("name", NAMES)
def test_notebook_finds_its_golden_numbers(name):
    """Among them what the paper prints: 6265 structures, 71,616 pairs, and Table 1 within its rounding."""
    found = recorded(paths.EXECUTED / f"{name}.ipynb")
    assert name in GOLDEN | OF_CI | OF_MNIST, f"no golden number for {name}; it recorded {found}"
    golden = GOLDEN.get(name, {}) | (OF_CI.get(name, {}) if PROFILE == "ci" else {})
    if executed_under(paths.EXECUTED / "08_dataset.ipynb")["source"] == "mnist":
        golden = golden | OF_MNIST.get(name, {})
    if not golden:
        pytest.skip("its golden numbers are those of MNIST, or of the profile ci")
    for key, (value, tolerance) in golden.items():
        assert found[key] == pytest.approx(value, rel=tolerance), key


@pytest.mark.parametrize("name", ["01_forward_process", "02_reverse_process", "03_samplers"])
def test_derivations_hold_to_rounding(name):
    found = recorded(paths.EXECUTED / f"{name}.ipynb")
    errors = {key: value for key, value in found.items() if key.endswith("_error")}
    assert len(errors) >= 4 and max(errors.values()) < 1e-8, errors


def test_the_models_listen_to_their_descriptors():
    numbers = recorded(paths.EXECUTED / "11_scalar_targets.ipynb")
    for name in ("height", "width", "box", "area"):
        assert numbers[f"mean_error_{name}"] < numbers[f"chance_error_{name}"], name
    axes = recorded(paths.EXECUTED / "12_medial_axes.ipynb")
    assert axes["axis_error_px"] < axes["axis_chance_px"]
