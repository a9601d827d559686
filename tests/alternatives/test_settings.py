"""Other settings of the simulation: they are simulated as they say, and the stored study of them is whole."""

import numpy as np
import pandas as pd

from inflate_lib import describe, inflate, label_image, paths
from inflate_lib.alternatives.settings import SETTINGS, _Setting, simulate_setting
from inflate_lib.structures.sources import load_sevens

DIGITS = load_sevens("digits").images


def test_calibration_study_tells_locking_from_the_rest_and_no_more():
    """The plain element is far off; MOOSE's and mean dilatation cannot be told apart; a finer mesh widens."""
    table = pd.read_csv(paths.REFERENCE / "calibration.csv")
    table = table.set_index(["element", "refine", "threshold", "pad"]).sort_index()
    default, moose, plain, fine = (
        table.loc[(element, refine, 0.5, True)]
        for element, refine in (("mean-dilatation", 1), ("stabilised", 1), ("q1", 1), ("mean-dilatation", 2))
    )
    excluded = [("q1", 2, 0.5, True), ("mean-dilatation", 2, 0.5, True), ("stabilised", 2, 0.5, True)]
    excluded += [("mean-dilatation", 1, *other) for other in ((0.5, False), (0.4, True), (0.6, True))]
    assert (table.loc[excluded].change_low > 0).all()
    assert plain.change_low > 3 and -0.1 < moose.change_low < moose.change_high < 0.1
    assert default.height_percent < 0 < default.width_percent < fine.width_low


def test_settings_are_simulated():
    images = DIGITS[:3]
    shapes = [describe(inflate(label_image(image, threshold=0.4), element="q1")) for image in images]
    expected = [[shape.height, shape.width, shape.hull_area] for shape in shapes]
    assert np.allclose(simulate_setting(images, _Setting(threshold=0.4, element="q1")), expected, rtol=1e-9)
    assert SETTINGS[0] == _Setting() and len(set(SETTINGS)) == len(SETTINGS)
    blank = simulate_setting(np.zeros((2, 28, 28)), _Setting())
    assert blank.shape == (2, 3) and np.isnan(blank).all()
