"""Every shipped driving system under the same wear: how far each part may wear, alone and together,
and the repair.

`python docs/scripts/systems.py` prints the two tables of the page on repair, in Markdown. A system
has the parameters of a shipped study that it drives in, or else its defaults; its repair has to
survive `PROMISE`.
"""

from __future__ import annotations

import time

import safevar_sumo as sv
from safevar_sumo.ads import ADS
from safevar_sumo.ads.varied import CHANGEABLE

STUDIES = {
    "aeb": "wear",
    "apollo": "lgsvl",
    "autoware_aeb": "autoware_july",
    "world_on_rails": "sun",
}
"""Studies with the parameters of driving systems."""
PROMISE = "treadDepth >= 2", "brakeTorque >= 0.8"


def limits_of(study: sv.Study) -> dict[str, str]:
    """The limit of each part alone and of all together, and the safety degree of the new car."""
    new = sv.simulate(study)
    degree = new.metrics["safety_degree"]
    if degree < 0:
        return {"new": f"collides at {-degree:.1f} m/s"}
    row = {"new": f"keeps {degree:.2f} m"}
    answer = sv.tolerance(study, unsafe="collision", fits=0)
    for one in answer.table("limits").itertuples():
        domain = study.vehicle.characteristics[str(one.characteristic)]
        ends = [
            (one.alone_low, domain.lower, one.together_low),
            (one.alone_high, domain.upper, one.together_high),
        ]
        limits = [
            f"{alone:.4g} (together {together:.4g})"
            for alone, last, together in ends
            if alone != last
        ]
        row[f"{one.characteristic} [{one.unit}]"] = " to ".join(limits) or "any"
    return row


def repair_of(study: sv.Study) -> tuple[str, str, str]:
    """The smallest repair, how much earlier it brakes on a new car, and needless braking before and
    after.
    """
    answer = sv.repair(study, promise=PROMISE)
    if not answer.numbers["repairs"]:
        return ("none is needed" if answer.numbers["kept_today"] else "none"), "-", "-"
    first = answer.table("repairs").iloc[0]
    scenes = f"{first.needless_braking_today} -> {first.needless_braking} of {first.benign_scenes}"
    return first.change, f"{first.metres_earlier:.2f} m", scenes


def main() -> None:
    """Print both tables, row by row."""
    begin, studies = time.perf_counter(), dict[str, sv.Study]()
    for name in ADS:
        parameters = (
            sv.load_study(STUDIES[name]).ads.parameters if name in STUDIES else {}
        )
        studies[name] = sv.load_study(
            "wear", ads={"model": name, "parameters": parameters}
        )
    limits = {name: limits_of(study) for name, study in studies.items()}
    heads = max((list(row) for row in limits.values()), key=len)
    print_row("driving system", *heads)
    print_row(*["---"] * (1 + len(heads)))
    for name, row in limits.items():
        print_row(f"`{name}`", *(row.get(head, "-") for head in heads))
    print()
    print_row(
        "driving system",
        "smallest repair",
        "brakes earlier, at most",
        "brakes needlessly",
    )
    print_row(*["---"] * 4)
    for name, study in studies.items():
        if name in CHANGEABLE:
            print_row(f"`{name}`", *repair_of(study))
    print(f"\n{(time.perf_counter() - begin) / 60:.0f} minutes")


def print_row(*cells: str) -> None:
    print("|", " | ".join(cells), "|", flush=True)


if __name__ == "__main__":
    main()
