"""Ask models for targets and measure what comes (paper secs. 2.3 and 4)."""

from inflate_lib._lazy import attach

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "run": ["held_out_targets", "judge", "run_experiment"],
        "targets": ["choose_axes", "compare_with_paper", "find_clusters"],
        "calibrate": ["calibrate", "calibrate_all"],
        "metrics": ["bootstrap", "errors", "r_squared"],
        "tables": ["accuracy", "failure_reasons", "scores"],
        "variety": ["diversity", "novelty"],
        "card": ["write_card"],
    },
)
