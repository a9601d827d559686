"""The book's style is complete: no setting of a user's has a part in a figure, and none is changed for good."""

import io

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np

from inflate_lib import inflate, label_image
from inflate_lib.io.pictures import write_animation, write_picture
from inflate_lib.plotting import figure, in_style, use_style
from inflate_lib.structures.sources import load_sevens

HOSTILE = {
    "axes.grid": True,
    "axes.facecolor": "yellow",
    "axes.spines.left": False,
    "axes.xmargin": 0.3,
    "figure.autolayout": True,
    "figure.facecolor": "black",
    "font.family": ["monospace"],
    "font.weight": "bold",
    "hatch.color": "red",
    "image.aspect": "auto",
    "image.origin": "lower",
    "legend.fancybox": False,
    "legend.loc": "lower left",
    "lines.marker": "o",
    "lines.dash_capstyle": "round",
    "mathtext.fontset": "cm",
    "path.sketch": (3, 20, 5),
    "patch.linewidth": 4.0,
    "savefig.transparent": True,
    "savefig.pad_inches": 1.0,
    "savefig.format": "pdf",
    "svg.image_inline": False,
    "text.color": "pink",
    "text.usetex": True,
    "xtick.direction": "in",
    "ytick.labelsize": 20,
}


def draw():
    fig, axes = figure(1, 2)
    axes[0].plot([0, 1], [2, 3], label="a line")
    axes[0].bar([0, 1], [2, 3], hatch="/", label="bars")
    axes[0].set(xlabel="height $h$", title="A title")
    axes[0].legend()
    axes[1].imshow(np.arange(12).reshape(3, 4))
    files = {kind: io.BytesIO() for kind in ("png", "svg")}
    for kind, file in files.items():
        fig.savefig(file, format=kind, metadata={"Date": None} if kind == "svg" else {})
    plt.close(fig)
    return {kind: file.getvalue() for kind, file in files.items()}


def test_no_setting_of_a_user_has_a_part_in_a_figure():
    with mpl.rc_context(mpl.rcParamsDefault), in_style():
        expected = draw()
    with mpl.rc_context(HOSTILE):
        use_style()
        assert draw() == expected


def test_pictures_that_are_written_have_the_style_and_leave_the_session_its_own(tmp_path):
    result = inflate(label_image(load_sevens("digits").images[0]), n_steps=2)
    write_picture(result, tmp_path / "plain.png")
    write_animation(result, tmp_path / "plain.gif")
    with mpl.rc_context(HOSTILE):
        write_picture(result, tmp_path / "hostile.png")
        write_animation(result, tmp_path / "hostile.gif")
        assert mpl.rcParams["text.usetex"] and mpl.rcParams["axes.grid"]
    for kind in ("png", "gif"):
        assert (tmp_path / f"plain.{kind}").read_bytes() == (tmp_path / f"hostile.{kind}").read_bytes()
