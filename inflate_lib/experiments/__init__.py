"""Ask models for targets and measure what comes (paper secs. 2.3 and 4)."""

from typing import TYPE_CHECKING

from inflate_lib._lazy import attach

if TYPE_CHECKING:
    from inflate_lib.experiments.run import held_out_targets, run_experiment, run_held_out
    from inflate_lib.experiments.tables import accuracy, scores
    from inflate_lib.experiments.targets import choose_axes, find_clusters
    from inflate_lib.experiments.variety import diversity, novelty

__all__ = [
    "accuracy",
    "choose_axes",
    "diversity",
    "find_clusters",
    "held_out_targets",
    "novelty",
    "run_experiment",
    "run_held_out",
    "scores",
]
__getattr__, __dir__ = attach(__name__, __file__)
