"""What a training run leaves to be looked at: a CSV file, TensorBoard."""

from pathlib import Path

from inflate_lib._files import draft, naming

COLUMNS = ("step", "loss", "simple", "vlb", "seconds")


class Log:
    """``history.csv``, and TensorBoard events where the package tensorboard is installed, in a folder.

    The rows are those of the run's history and the seconds spent until then. What a killed run logged after its last
    checkpoint, which ends at ``step``, is dropped: the run repeats it.
    """

    def __init__(self, folder: Path, step: int):
        self.path, heading = folder / "history.csv", ",".join(COLUMNS) + "\n"
        before = self.path.read_text(errors="replace").splitlines(keepends=True) if self.path.exists() else []
        if before and before[0] != heading:
            raise FileExistsError(f"{self.path} is there already, and no log of a training: give another folder for it")
        whole = (line for line in before[1:] if line.endswith("\n") and line.count(",") == len(COLUMNS) - 1)
        kept = [line for line in whole if int(line.split(",")[0]) <= step]
        with draft(self.path) as place:
            place.write_text(heading + "".join(kept))
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
