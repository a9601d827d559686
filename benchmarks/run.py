"""Everything about the speed of the solver, in a few minutes: prints the tables and writes data/reference/speed_*.

    python benchmarks/run.py

wants the extra `dev` (FElupe, scikit-fem) and a machine that does nothing else. The appendix "What it costs" reads the
tables. How the simulation of the whole data set scales over processes and machines is scale.py's business.
"""

import first_call
import floor
import growth
import inflation
import typer


def main(repeats: int = 3):
    inflation.main(repeats=repeats)
    growth.main(repeats=repeats)
    floor.main(repeats=repeats)
    first_call.main(repeats=repeats)


if __name__ == "__main__":
    typer.run(main)
