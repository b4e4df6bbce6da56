"""The log of a training run: one row for each validation, on disk and in TensorBoard."""

import csv

from policies.files import whole


def score_of(row):
    """(minus success, error) of a row: the smaller, the better. Without any success there is no error."""
    error = float(row["error"])
    return -float(row["success"]), error if error == error else float("inf")


class Log:
    """log.csv, and TensorBoard where it is installed."""

    def __init__(self, folder, until):
        path = folder / "log.csv"
        rows = list(csv.DictReader(path.read_text().splitlines())) if path.is_file() else []
        self.rows = [row for row in rows if int(row["update"]) <= until]  # the rest will be done again
        self.path, self.board = path, _tensorboard(folder)

    def write(self, row):
        """Add a row; the file on disk is always whole."""
        self.rows.append(row)
        with whole(self.path) as partial, partial.open("w", newline="") as file:
            writer = csv.DictWriter(file, row.keys())
            writer.writeheader()
            writer.writerows(self.rows)
        for key in row:
            if self.board:
                self.board.add_scalar(key, row[key], row["update"])

    def best(self):
        """Best (minus success, error) so far."""
        return min((score_of(row) for row in self.rows), default=(1.0, float("inf")))

    def seconds(self):
        """Time spent before this run was resumed."""
        return float(self.rows[-1]["seconds"]) if self.rows else 0.0

    def close(self):
        """Flush TensorBoard."""
        if self.board:
            self.board.close()


def _tensorboard(folder):
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        return None
    return SummaryWriter(str(folder / "tensorboard"))
