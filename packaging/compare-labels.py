"""Accuracy in percent of crowd-kit's methods and of `ecod-lab eval-labels` on the same label sets, as a table in Markdown.

A tie of the majority counts as the chance of drawing the right label. The row of means is over all sets, the last rows count the
sets on which a method is at most half a point below the best of the table, and more than half a point below the majority.
"""

import pathlib
import re
import subprocess
import sys

import pandas
from crowdkit.aggregation import GLAD, MACE, DawidSkene, OneCoinDawidSkene, Wawa

METHODS = {
    "Wawa": lambda: Wawa(),
    "Dawid-Skene": lambda: DawidSkene(n_iter=50),
    "OneCoin": lambda: OneCoinDawidSkene(n_iter=50),
    "MACE": lambda: MACE(n_restarts=3, n_iter=30, random_state=1),
    "GLAD": lambda: GLAD(n_iter=30),
}
OURS = ["majority", "VOTE, one pass", "VOTE, with passes"]


def ours(lab, folder):
    """Accuracies by the rows that `eval-labels` prints."""
    command = [lab, "eval-labels", folder / "label.csv", "--truth", folder / "truth.csv"]
    text = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return {name: float(re.search(rf"^{name} +([0-9.]+)", text, re.M).group(1)) for name in OURS}


def crowdkit(folder):
    votes = pandas.read_csv(folder / "label.csv", dtype=str)
    votes = votes.rename(columns={"item": "task"}).drop_duplicates(["task", "worker"], keep="last").reset_index(drop=True)
    truth = pandas.read_csv(folder / "truth.csv", dtype=str).set_index("item")["truth"]
    truth = truth[truth.index.isin(votes["task"])]
    scores = {}
    for name, method in METHODS.items():
        labels = method().fit_predict(votes[["task", "worker", "label"]])
        scores[name] = 100 * (labels.reindex(truth.index) == truth).mean()
    return scores


def main():
    lab, root = sys.argv[1], pathlib.Path(sys.argv[2])
    folders = sorted(path.parent for path in root.glob("*/label.csv"))
    rows = {}
    for folder in folders:
        rows[folder.name] = ours(lab, folder) | crowdkit(folder)
        print(folder.name, "done", file=sys.stderr)
    columns = ["majority", *METHODS, "VOTE, one pass", "VOTE, with passes"]
    print("| set | " + " | ".join(columns) + " |\n|" + "---|" * (len(columns) + 1))
    for name, scores in rows.items():
        print(f"| {name} | " + " | ".join(f"{scores[column]:.2f}" for column in columns) + " |")
    mean = [sum(scores[column] for scores in rows.values()) / len(rows) for column in columns]
    print("| mean | " + " | ".join(f"{value:.2f}" for value in mean) + " |")
    near = [sum(scores[column] >= max(scores.values()) - 0.5 for scores in rows.values()) for column in columns]
    print("| near the best | " + " | ".join(f"{count} of {len(rows)}" for count in near) + " |")
    below = [sum(scores[column] < scores["majority"] - 0.5 for scores in rows.values()) for column in columns]
    print("| below the majority | " + " | ".join(map(str, below)) + " |")


main()
