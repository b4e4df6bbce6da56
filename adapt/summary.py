"""Mean and spread over seeds of runs of one's own: `python -m adapt.summary runs/fewshot-* --csv results/fewshot.csv`.

Reads the metrics.json of `adapt.fewshot` and `adapt.vision` or the JSON of `adapt.evaluate`, writes one CSV row per
run, and prints the mean and standard deviation over seeds as Markdown.
"""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from adapt import command
from envs.errors import InputError
from policies.files import replacing

# Runs that differ in more than their seed are not averaged.
GROUP = ("system", "set", "target", "method", "solver", "horizon", "trained_in", "samples", "residual", "updates")
STAGES = ("source", "zero_shot", "few_shot", "oracle")


@dataclass(frozen=True)
class Options:
    """Collect the results of several runs into a CSV and a Markdown table with mean and spread over seeds."""

    runs: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Folders of adapt.fewshot or adapt.vision, or JSON files of adapt.evaluate."""
    csv: str | None = None
    """File for one row per run."""
    overwrite: bool = False
    """Replace that file."""


def main(options):
    """Read, write the CSV, print the table."""
    import pandas as pd

    _check(options)
    rows = {run: _rows(Path(run)) for run in options.runs}
    table = pd.DataFrame([row for part in rows.values() for row in part])
    keys = [key for key in GROUP if key in table]
    _refuse_repeated(table[[*keys, "seed"]], [run for run, part in rows.items() for _ in part])
    table = table.sort_values([*keys, "seed"], ignore_index=True)
    if options.csv:
        with replacing(options.csv) as partial:
            table.to_csv(partial, index=False)
    print(summary(table, keys).to_markdown(index=False))


def _check(options):
    if not options.runs:
        raise InputError("no runs: name folders of adapt.fewshot, or JSON files of adapt.evaluate")
    command.output_file("--csv", options.csv, options.overwrite, "runs.csv")


def _refuse_repeated(table, runs):
    """Two runs of one group and seed are one result, or differ in what the table doesn't show: no spread over seeds."""
    seen = {}
    for run, values in zip(runs, table.itertuples(index=False), strict=True):
        same = tuple(map(str, values))  # text, as a missing value doesn't equal itself
        if same in seen:
            raise InputError(f"{seen[same]} and {run}: are of one group and have the same seed; leave one out")
        seen[same] = run


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
    table = pd.DataFrame(lines).astype(object)
    return table.where(table.notna(), "")


def _spread(values, digits=4):
    return f"{values.mean():.{digits}f} ± {values.std(ddof=0):.{digits}f}"


def _rows(run):
    path = run / "metrics.json" if run.is_dir() else run
    try:
        metrics = json.loads(path.read_text())
        if "few_shot" in metrics:
            return [_fewshot_row(path, metrics)]
        return _vision_rows(metrics) if "camera" in metrics else [_evaluation_row(metrics)]
    except OSError as error:
        raise InputError(f"{path}: can't be read ({error.strerror}); name folders of adapt.fewshot") from None
    except (ValueError, KeyError, TypeError):
        raise InputError(f"{path}: holds no results of adapt.fewshot, adapt.vision or adapt.evaluate") from None


def _fewshot_row(path, metrics):
    row = {key: metrics[key] for key in ("system", "target", "samples", "seed", "metric", "unit")}
    row |= {key: metrics[key] for key in ("set", "updates") if key in metrics}  # older files don't have them
    row |= {"method": metrics["method"]} if "method" in metrics else {}
    row |= {"residual": metrics["residual"]["kind"]} if metrics.get("residual") else {}
    for stage in STAGES:
        if stage in metrics:
            row |= _figures(stage, metrics[stage])
    if "oracle" in metrics:
        row["few_shot/oracle"] = row["few_shot_mean"] / row["oracle_mean"]
    own = sum(seconds for name, seconds in metrics["seconds"].items() if name != "oracle")
    config = json.loads((path.parent / "config.json").read_text())
    return row | {"seconds": own, "threads": metrics["threads"], "torch": config["torch"], "commit": config["commit"]}


def _vision_rows(metrics):
    """One row, and one for each other attempt of a planner."""
    same = ("system", "target", "samples", "seed", "metric", "unit", "threads", "torch", "commit")
    spent = {"seconds": metrics["training"].get("seconds"), "updates": metrics["training"].get("update")}
    return [
        {**{key: metrics[key] for key in same}, "method": f"{one['method']} from pictures", **spent}
        | _figures("error", one)
        | {key: one[key] for key in ("steps", "median_ms", "p99_ms")}
        for one in (metrics, *metrics.get("attempts", ()))
    ]


def _figures(name, summary):
    """Columns of one evaluation; null in the file is not a number: none succeeded."""
    values = {key: summary[key] for key in ("mean", "std", "success", "n")}
    return {f"{name}_{key}": math.nan if value is None else value for key, value in values.items()}


def _evaluation_row(metrics):
    options, info = metrics["options"], metrics["policy_info"]
    row = {"system": options["vehicle"] or options["system"], "set": metrics["set"]}
    row |= {"target": " ".join(options["target"]), "method": metrics["method"], "policy": options["policy"] or ""}
    row |= {"solver": info.get("solver", "") + (", compiled" if info.get("compile") else "")}
    row |= {"horizon": metrics["horizon"], "trained_in": info.get("trained_in", info.get("model", ""))}
    # Runs from scratch that differ in their best update only are of one group; budgets in a target tell runs apart.
    row |= {"samples": "" if info.get("finetuned") is False else info.get("samples", "")}
    row |= {"seed": info.get("seed", metrics["seed"])}
    row |= _figures("error", metrics)
    keys = ("calls", "failures", "metric", "unit", "median_ms", "p99_ms", "threads", "torch", "commit")
    return row | {key: metrics.get(key) for key in keys}


if __name__ == "__main__":
    command.run("adapt.summary", Options, main)
