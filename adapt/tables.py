"""Tables of several runs: `python -m adapt.tables runs/fewshot-* --csv results/fewshot.csv`.

Reads the metrics.json of `adapt.fewshot` or the JSON of `adapt.evaluate`, writes one CSV row per run, and prints the
mean and standard deviation over seeds as Markdown.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from adapt import command
from envs.errors import InputError
from policies.files import whole

STAGES = ("source", "zero_shot", "few_shot", "oracle")


@dataclass(frozen=True)
class Options:
    """Collect the results of several runs into a CSV and a Markdown table with mean and spread over seeds."""

    runs: Annotated[tuple[str, ...], tyro.conf.Positional]
    """Folders of adapt.fewshot, or JSON files of adapt.evaluate."""
    csv: str | None = None
    """File for one row per run."""


def main(options):
    """Read, write the CSV, print the table."""
    import pandas as pd

    table = pd.DataFrame([_row(Path(run)) for run in options.runs])
    keys = [key for key in ("system", "set", "target", "samples") if key in table]
    table = table.sort_values([*keys, "seed"], ignore_index=True)
    if options.csv:
        with whole(options.csv) as partial:
            table.to_csv(partial, index=False)
    print(summary(table, keys).to_markdown(index=False))


def summary(table, keys):
    """One line per group of runs that differ in their seed: mean ± standard deviation of the runs' means."""
    import pandas as pd

    lines = []
    for group, runs in table.groupby(keys, dropna=False, sort=False):
        line = dict(zip(keys, group, strict=True)) | {"seeds": len(runs), "unit": runs.unit.iloc[0]}
        for name in (*STAGES, "error"):
            if f"{name}_mean" in runs:
                line[name] = _spread(runs[f"{name}_mean"])
                line[f"{name} success"] = f"{runs[f'{name}_success'].mean():.3f}"
        for name in ("few_shot/oracle", "seconds"):
            if name in runs and runs[name].notna().all():
                line[name] = _spread(runs[name], 3 if "/" in name else 1)
        lines.append(line)
    return pd.DataFrame(lines).fillna("")


def _spread(values, digits=4):
    return f"{values.mean():.{digits}f} ± {values.std(ddof=0):.{digits}f}"


def _row(run):
    path = run / "metrics.json" if run.is_dir() else run
    try:
        metrics = json.loads(path.read_text())
        return _fewshot_row(path, metrics) if "few_shot" in metrics else _evaluation_row(metrics)
    except OSError as error:
        raise InputError(f"{path}: can't be read ({error.strerror}); name folders of adapt.fewshot") from None
    except (ValueError, KeyError, TypeError):
        raise InputError(f"{path}: holds no results of adapt.fewshot or adapt.evaluate") from None


def _fewshot_row(path, metrics):
    row = {key: metrics[key] for key in ("system", "target", "samples", "seed", "metric", "unit")}
    for stage in STAGES:
        if stage in metrics:
            row |= {f"{stage}_{key}": metrics[stage][key] for key in ("mean", "std", "success", "n")}
    if "oracle" in metrics:
        row["few_shot/oracle"] = metrics["few_shot"]["mean"] / metrics["oracle"]["mean"]
    own = sum(seconds for name, seconds in metrics["seconds"].items() if name != "oracle")
    config = json.loads((path.parent / "config.json").read_text())
    return row | {"seconds": own, "threads": metrics["threads"], "torch": config["torch"], "commit": config["commit"]}


def _evaluation_row(metrics):
    options = metrics["options"]
    row = {"system": options["vehicle"] or options["system"], "set": metrics["set"]}
    row |= {
        "target": " ".join(options["target"]),
        "policy": options["policy"] or "",
        "seed": metrics["policy_info"]["seed"],
    }
    row |= {f"error_{key}": metrics[key] for key in ("mean", "std", "success", "n")}
    keys = ("metric", "unit", "median_ms", "p99_ms", "threads", "torch", "commit")
    return row | {key: metrics[key] for key in keys}


if __name__ == "__main__":
    command.run("adapt.tables", Options, main)
