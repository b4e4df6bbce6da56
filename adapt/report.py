"""What `adapt.fewshot` prints: its metrics as tables, and what a user should not overlook in them."""

NAMES = {
    "source": "source",
    "zero_shot": "zero-shot",
    "few_shot": "few-shot",
    "refused": "few-shot, refused",
    "oracle": "oracle",
}
UNITS = {
    "position": "position [m]",
    "velocity": "velocity [m/s]",
    "attitude": "attitude [-]",
    "rates": "body rates [rad/s]",
    "acceleration": "acceleration [m/s^2]",
    "angular_acceleration": "angular acceleration [rad/s^2]",
    "position_1s": "position after 1 s [m]",
    "velocity_1s": "velocity after 1 s [m/s]",
}


def table(metrics):
    """The tables of a run of `adapt.fewshot` as text: flights, predictions, seconds, notes."""
    from tabulate import tabulate

    rows = [
        (text, f"{m['mean']:.4f} ± {m['std']:.4f}" if m["success"] else "none succeeded", f"{m['success']:.2f}", m["n"])
        for name, text in NAMES.items()
        if (m := metrics.get(name))
    ]
    flown_in = f", flown in {metrics['evaluated_in']}" if "evaluated_in" in metrics else ""
    header = (metrics["target"] + flown_in, f"{metrics['metric']} [{metrics['unit']}]", "success", "N")
    parts = [tabulate(rows, header, "simple")]
    # Recorded transitions that were held out have also decided what the residual may keep.
    one_step = "transitions held out of the fit" if "evaluated_in" in metrics else "unseen transitions"
    for title, key in ((f"{one_step}, one step", "prediction"), ("validation flights", "validation")):
        if key in metrics:
            errors = {name: table for name, table in metrics[key].items() if name != "n"}
            rows = [(UNITS.get(row, row), *(table[row] for table in errors.values())) for row in errors["model"]]
            parts.append(tabulate(rows, (title, *errors), "simple", floatfmt=".3g"))
    parts.append(residual_line(metrics["residual"]))
    parts.extend(parameter_table(metrics["residual"]))
    if "gate" in metrics:
        parts.append(gate_line(metrics["gate"]))
    spent = ", ".join(f"{name} {seconds:.1f}" for name, seconds in metrics["seconds"].items())
    parts.append(f"seconds ({metrics['threads']} thread{'s' * (metrics['threads'] > 1)}): {spent}")
    parts.extend(f"note: {note}" for note in (*notes(metrics), *metrics["residual"]["warnings"]))
    return "\n\n" + "\n\n".join(parts) + "\n"


def gate_line(verdict):
    """What the gate decided, and why."""
    way = "" if verdict["share"] == 1 else f" {verdict['share']:.0%} of the way to"
    done = f"gate: took{way} the new policy" if verdict["accepted"] else "gate: kept the old policy"
    return f"{done}; {verdict['reason']}"


def residual_line(residual):
    """Which kind was taken, and how those that were tried predict flight that was held out."""
    tried = residual.get("tried", {})
    if not tried:
        return f"residual: {residual['kind']}"
    if list(tried) == [residual["kind"]]:
        return f"residual: {residual['kind']}, which leaves next to nothing"
    scores = {kind: f"{score:.2f}" if isinstance(score, float) else "can't be fitted" for kind, score in tried.items()}
    told = ", ".join(f"{kind} {score}" for kind, score in scores.items())
    return f"residual: {residual['kind']}; error of held-out flight, relative: {told}"


def parameter_table(residual):
    """The parameters that were refitted, as a list of one table, or of nothing where there are none.

    Beside each stands what the data can't tell it from, and how much of that undoes one unit more of it: the direction
    in parameter space that the data don't determine.
    """
    from tabulate import tabulate

    found = residual.get("parameters") or {}
    rows = [
        (
            *(name, f"{one['model']:.4g}", f"{one['value']:.4g} ± {one['standard_error']:.1g}"),
            ", ".join(
                other if amount is None else f"{other} {amount:+.3g}"
                for other, amount in residual["alike"].get(name, {}).items()
            ),
        )
        for name, one in found.items()
    ]
    header = ("refitted", "in the model", "value", "these data can't tell it from (so much undoes +1 of it)")
    return [tabulate(rows, header, "simple")] if rows else []


def notes(metrics):
    """What a user should not overlook in the numbers."""
    return [*broken_flights(metrics.get("plant")), *_worth(metrics)]


def broken_flights(plant):
    """What to say of flights that broke off, from `adapt.plants.Flights.report`; nothing where none did."""
    if not plant or not plant["broken"]:
        return []
    lost = f"; then it was given up ({plant['faults'][-1]})" if plant["given up"] else ""
    return [f"{plant['broken']} of {plant['flights']} flights of the plant broke off ({plant['faults'][0]}){lost}"]


def _worth(metrics):
    source, before, after = (metrics[name] for name in ("source", "zero_shot", "few_shot"))
    if not source["success"]:
        return ["no flight succeeded even in the model; can this reference be flown by this robot?"]
    if (after["success"], -after["mean"]) < (before["success"], -before["mean"]):
        return [
            "the adapted policy is worse than the old one here; keep the old one, or try more --updates or --samples"
        ]
    return []
