"""Ask models for targets and measure what comes (paper secs. 2.3 and 4)."""

from typing import TYPE_CHECKING

from inflate_lib._lazy import attach

if TYPE_CHECKING:
    from inflate_lib.experiments.calibrate import calibrate_all
    from inflate_lib.experiments.card import write_card
    from inflate_lib.experiments.metrics import bootstrap, errors, r_squared
    from inflate_lib.experiments.run import held_out_targets, judge, run_experiment, run_held_out
    from inflate_lib.experiments.tables import accuracy, failure_reasons, flaws, scores
    from inflate_lib.experiments.targets import choose_axes, compare_with_paper, find_clusters
    from inflate_lib.experiments.variety import diversity, novelty

__all__ = [
    "accuracy",
    "bootstrap",
    "calibrate_all",
    "choose_axes",
    "compare_with_paper",
    "diversity",
    "errors",
    "failure_reasons",
    "find_clusters",
    "flaws",
    "held_out_targets",
    "judge",
    "novelty",
    "r_squared",
    "run_experiment",
    "run_held_out",
    "scores",
    "write_card",
]
__getattr__, __dir__ = attach(__name__, __file__)
