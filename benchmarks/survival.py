"""The table of docs/survival.md: every shipped driving system under the wear of the study `wear`.

Usage: python -m benchmarks.survival [ADS ...]
"""

from __future__ import annotations

import sys
import time

import safevar_sumo as sv

PARAMETERS = {
    "aeb": {"braking_share": 0.75, "response_time": 0.3},
    "acc": {},
    "autoware_aeb": {},
    "fuzzy_safety": {},
    "idm": {},
    "krauss": {},
    "rss": {},
}
"""Driving systems with their defaults, except `aeb` as in `wear`; the others are fitted to a scenario."""
PROMISE = ["treadDepth >= 3", "brakeTorque >= 0.8"]


def row(ads: str) -> list[str]:
    """The cells of a driving system's row."""
    study = sv.load_study("wear", name=f"wear_{ads}", ads={"model": ads, "parameters": PARAMETERS[ads]})
    tolerance = sv.tolerance(study, unsafe="collision")
    alone = [
        f"{scan.characteristic.name} {' to '.join(f'{end:.3g}' for end in scan.safe)}" if scan.safe else "none"
        for scan in tolerance.alone
        if scan.unsafe
    ]
    found = sv.repair(study, promise=PROMISE)
    return [ads, "; ".join(alone) or "all of the domain", f"{100 * tolerance.joint.factor:.0f} %", found.verdict]


def main() -> None:
    """Print the table."""
    begin = time.perf_counter()
    print("| driving system | safe alone | together | repair for " + " and ".join(PROMISE) + " |")
    print("| --- | --- | --- | --- |")
    for ads in sys.argv[1:] or PARAMETERS:
        print(f"| {' | '.join(row(ads))} |", flush=True)
    print(f"\n{time.perf_counter() - begin:.0f} s")


if __name__ == "__main__":
    main()
