"""Every notebook runs on its own, on the embedded digits, with parameters of its own; and finds its golden numbers.

The notebooks see a home of their own in a temporary folder, so that neither the book nor the cache is touched.
"""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from inflate_lib import paths
from inflate_lib._progress import Display
from inflate_lib.book._execution import Kernels, execute
from inflate_lib.book.page import recorded
from inflate_lib.book.profiles import check_profile, load_profile
from inflate_lib.book.run import find_notebooks

NAMES = [path.stem for path in find_notebooks()]

#: Results of the notebooks under tests/profiles/test.yml that no machine should change, with a relative tolerance.
GOLDEN = {
    "01_forward_process": {"cosine_first_beta": (4.128422482196914e-05, 1e-12), "cosine_steps_signal": (497, 0)},
    "02_reverse_process": {
        "added_last": (499.5, 1e-6),
        "added_middle": (0.0031174297, 1e-6),
        "last_image_off": (202.9117, 1e-5),
        "guided_once": (0.5, 0.02),
    },
    "03_structures": {"n_images": (179, 0), "n_open": (0, 0), "n_thinned": (1, 0)},
    "04_inflation": {"height": (0.9045748605, 1e-8), "plain_area_percent": (-9.23005117, 1e-6), "n_cells": (180, 0)},
    "05_descriptors": {"height_after": (0.9045748604795254, 1e-8), "hull_area_after": (0.6247203813779405, 1e-8)},
    "06_augmentation": {"n_allowed": (11929, 0), "n_drawn": (11929, 0)},
    "07_dataset": {"n_converged": (40, 0), "mean_height": (0.88629478, 1e-7), "mean_hull_area": (0.57714641, 1e-7)},
    "08_training": {"n_parameters": (51801, 0), "final_simple_loss": (0.88997054, 1e-3)},
    "09_targets": {"mean_deviation_percent": (12.340800216465054, 1e-6)},
    "10_scalar_targets": {"chance_error_height": (7.425955223956328, 1e-6)},
    "11_medial_axes": {"axis_chance_px": (1.0951075609126195, 1e-6)},
    "12_comparison": {"n_numbers": (39, 0), "table1_largest_deviation": (24.710708588565765, 1e-6)},
    "16_verification": {
        "inner_radius": (0.7481541132, 1e-8),
        "tube_error_percent": (0.8167559, 1e-6),
        "arch_pairs": (8, 0),
    },
    "17_tools": {"drawing_height": (1.1598597797, 1e-8), "softer_percent": (3.4038248626, 1e-6)},
    "18_speed": {"factorisations_ten": (149, 0.02), "factorisations_one": (53, 0.04)},
    "13_accuracy": {"n_targets": (4, 0), "yardstick_smallest": (0.08173646, 1e-5)},
    "14_alternatives": {"median_height_retrieval": (0.26193822, 1e-6)},
    "15_design": {"reach_height": (1.0581836645, 1e-8)},
    "19_explorer": {"n_targets": (13, 0)},
    "20_extending": {"n_learned": (20, 0)},
}


@pytest.fixture(scope="module")
def executed(tmp_path_factory):
    """Run all notebooks, two at a time; the folder with the executed ones."""
    home = tmp_path_factory.mktemp("home")
    (home / "data").mkdir()
    for folder in ("data/reference", "inflate_lib"):
        (home / folder).symlink_to(paths.ROOT / folder)
    (home / "notebooks").mkdir()
    (home / "notebooks" / "profiles").symlink_to(Path(__file__).parent / "profiles")
    for source in find_notebooks():
        (home / "notebooks" / source.name).symlink_to(source)
    profile = load_profile("test", Path(__file__).parent / "profiles")
    check_profile(profile, find_notebooks())
    environment = {
        "INFLATE_HOME": str(home),
        "INFLATE_CACHE": str(home / "cache"),
        "INFLATE_MNIST_DIR": str(home / "nowhere"),  # the embedded digits need no MNIST
        "OMP_NUM_THREADS": "1",
    }

    def run(source):
        output = home / "executed" / source.with_suffix(".ipynb").name
        execute(source, output, profile.parameters(source), kernels, Display(), keep)

    def keep(notebook, manifest):
        pass

    with pytest.MonkeyPatch.context() as patch, Kernels(environment) as kernels, ThreadPoolExecutor(2) as pool:
        patch.setattr(paths, "CACHE", home / "cache")
        patch.setattr(paths, "REPORTS", home / "reports")
        list(pool.map(run, find_notebooks()))
    return home


@pytest.mark.parametrize("name", NAMES)
def test_notebook_runs_and_finds_its_golden_numbers(executed, name):
    found = recorded(executed / "executed" / f"{name}.ipynb")
    assert name in GOLDEN, f"no golden number for {name}; it recorded {found}"
    for key, (value, tolerance) in GOLDEN[name].items():
        assert found[key] == pytest.approx(value, rel=tolerance), key


@pytest.mark.parametrize("name", ["01_forward_process", "02_reverse_process"])
def test_derivations_hold_to_rounding(executed, name):
    found = recorded(executed / "executed" / f"{name}.ipynb")
    errors = {key: value for key, value in found.items() if key.endswith("_error")}
    assert len(errors) >= 4 and max(errors.values()) < 1e-8, errors


def test_figures_and_tables_say_where_they_come_from(executed):
    notes = list((executed / "figures" / "test").glob("*.json"))
    pictures = list((executed / "figures" / "test").glob("*.png"))
    assert {note.stem for note in notes} >= {picture.stem for picture in pictures}
    assert len(pictures) >= 12
