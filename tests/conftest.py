"""For all tests: plots need no screen."""

import os

os.environ["MPLBACKEND"] = "Agg"
