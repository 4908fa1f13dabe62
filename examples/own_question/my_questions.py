import numpy as np

import safevar_sumo as sv
from safevar_sumo.questions.answer import Answer, Column, contents, tabulate
from safevar_sumo.questions.ask import Criterion

COLUMNS = {
    "characteristic": Column("", "what is at an end of its domain, all others as in the original"),
    "value": Column("", "its value, in its unit"),
    "outcome": Column("", "how the simulation ends"),
    "safety_degree": Column("m", "safety degree", ".2f"),
}


@sv.question
@contents("unsafe_ends", lead="ends", next="explain", ends=COLUMNS)
def ends(subject, evaluator, *, unsafe: Criterion = None) -> Answer:
    """Say which characteristics are unsafe at the ends of their domains, each alone.

    Parameters
    ----------
    unsafe
        What is unsafe: a collision, a clearance below X [m], or a metric beyond a limit.
    """
    characteristics = evaluator.characteristics
    settings = np.repeat(characteristics.original[np.newaxis], 2 * len(characteristics), axis=0)
    for i, item in enumerate(characteristics):
        settings[2 * i : 2 * i + 2, i] = item.lower, item.upper
    evaluations = evaluator.evaluate(settings, "ends of the domains")
    is_unsafe = evaluator.choose_criterion(unsafe, subject).of(evaluations)
    names = [item.name for item in characteristics for _ in range(2)]
    values = [value for item in characteristics for value in (item.lower, item.upper)]
    rows = zip(names, values, evaluations.outcome, evaluations.f_safe, strict=True)
    broken = sorted({name for name, fails in zip(names, is_unsafe, strict=True) if fails})
    return Answer(
        question="my_questions:ends",
        study=evaluator.study,
        verdict=f"Unsafe at an end of the domain: {', '.join(broken) or 'no characteristic'}.",
        numbers={"unsafe_ends": int(is_unsafe.sum())},
        tables={"ends": tabulate("Ends of the domains", COLUMNS, rows)},
    )
