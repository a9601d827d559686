"""What a training run leaves to be looked at: a CSV file, TensorBoard."""

from pathlib import Path

from inflate_lib._files import naming

COLUMNS = ("step", "loss", "simple", "vlb", "seconds")


class Log:
    """``history.csv``, and TensorBoard events where the package tensorboard is installed, in a folder.

    The rows are those of the run's history and the seconds spent until then. What a killed run logged after its last
    checkpoint, which ends at ``step``, is dropped: the run repeats it.
    """

    def __init__(self, folder: Path, step: int):
        folder.mkdir(parents=True, exist_ok=True)
        self.path = folder / "history.csv"
        before = self.path.read_text().splitlines(keepends=True)[1:] if self.path.exists() else []
        whole = (line for line in before if line.endswith("\n") and line.count(",") == len(COLUMNS) - 1)
        kept = [line for line in whole if int(line.split(",")[0]) <= step]
        with naming(self.path):
            self.path.write_text(",".join(COLUMNS) + "\n" + "".join(kept))
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError:
            print("no TensorBoard logs: the package tensorboard is not installed (pip install tensorboard)")
            self.events = None
        else:
            self.events = SummaryWriter(str(folder), purge_step=step + 1)

    def add(self, **row: float) -> None:
        """Append a row, by the names of ``COLUMNS``."""
        with naming(self.path), self.path.open("a") as file:
            file.write(",".join(str(row[name]) for name in COLUMNS) + "\n")
        if self.events is not None:
            for name in COLUMNS[1:]:
                self.events.add_scalar(name, row[name], row["step"])
            self.events.flush()
