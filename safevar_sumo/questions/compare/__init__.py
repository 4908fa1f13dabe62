"""The question `compare`: what changes from a version A of a study to a version B? The versions
differ in the driving system, the vehicle or the weather, for example.

The same settings are simulated in both versions. They are the solutions of both sides' results, if
they lie in both domains, and sampled settings. Sampled settings lie on lines from the original
vehicle into the common domain, near the place where the vehicles begin to fail.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import compress
from typing import NamedTuple

import numpy as np
import pandas as pd

from safevar_sumo.errors import about
from safevar_sumo.metrics import Unsafe
from safevar_sumo.questions.answer import Answer, Column, contents, tabulate
from safevar_sumo.questions.ask import Criterion, question
from safevar_sumo.questions.bench import LIMITS_STAGE
from safevar_sumo.questions.case import Subject
from safevar_sumo.questions.compare import words
from safevar_sumo.questions.compare.coverage import missing_in_words
from safevar_sumo.questions.compare.differences import (
    BOTH,
    COLLISION,
    COMFORT,
    GROWN,
    LIMIT_COLUMNS,
    SHRUNK,
    SUMMARY_COLUMNS,
    Difference,
    compare_counts,
    compare_limits,
    compare_originals,
    compare_values,
    limits_of_both,
    summary_of,
)
from safevar_sumo.questions.compare.settings import (
    BOTH_STAGE,
    LINE,
    SAMPLE,
    CommonDomain,
    Evaluators,
    Pairs,
    in_order_of,
    pairs_of,
)
from safevar_sumo.questions.evaluator import Evaluator
from safevar_sumo.questions.models import keeping_distance
from safevar_sumo.questions.options import Count, LimitTexts, Margin
from safevar_sumo.questions.pairs import (
    ENDS,
    SETTING_COLUMNS,
    SIDES,
    UNSAFE_IN,
    Criteria,
    Runs,
    Titles,
    counts_of,
    draw_pairs,
    table_of_pairs,
)
from safevar_sumo.questions.research_questions.statistics import (
    compare_samples,
    fewest_runs,
    signed_rank_test,
)
from safevar_sumo.questions.sentence import Sentence, Sentences, Verdict, answer, note
from safevar_sumo.questions.subject import study_in
from safevar_sumo.questions.tables import AnswerTable, shipped_columns
from safevar_sumo.questions.tolerance.asked import usual_alone
from safevar_sumo.questions.words import (
    UNSAFE_MEANS,
    counted_in_words,
    join_few,
    join_phrases,
)
from safevar_sumo.records import JsonObject, differences as differing_rows
from safevar_sumo.study import limits_of

RELEASE = "RELEASE"
DO_NOT_RELEASE = "DO NOT RELEASE"
DECIDE = "DECIDE"
MAX_REASONS = 3
"""Largest number of differences that the verdict names."""
PAIR_COLUMNS = shipped_columns("compare")["pairs"]


@question
@contents(
    "decision",
    "unsafe",
    "margin",
    "settings",
    *UNSAFE_IN.values(),
    "p",
    "a12",
    "better_in",
    "worse_in",
    "limits_grown",
    "limits_shrunk",
    "outside",
    "not_simulated",
    *ENDS,
    "metres_earlier",
    "metres_later",
    *(f"{side}_{name}" for side in SIDES for name in ("gap", "needless_braking")),
    "benign_scenes",
    lead="summary",
    summary=SUMMARY_COLUMNS,
    limits=LIMIT_COLUMNS,
    pairs=PAIR_COLUMNS,
    settings=["source", *SETTING_COLUMNS, ...],
)
def compare(
    subject: Subject,
    evaluator: Evaluator,
    other: Subject,
    *,
    samples: Count = 2000,
    limits: LimitTexts = (),
    margin: Margin = None,
    unsafe: Criterion = None,
    at_tests: bool = False,
) -> Answer:
    """Compare two versions A and B of a study, or of results, and decide whether B may be released.
    You get RELEASE, DO NOT RELEASE (exit code 3) or DECIDE (exit code 4), with what is better
    and what is worse in B. Version A and version B are judged by one criterion.

    Example: python -m safevar_sumo compare autoware_july autoware_december

    Parameters
    ----------
    samples
        Number of sampled vehicles that are simulated in both versions. The sampled vehicles lie
        near the boundary between safe and unsafe.
    limits
        Compare only vehicles within this limit, such as "treadDepth >= 3"; may be repeated.
        State the value in the unit of the study.
    margin
        Clearance that every vehicle must keep, in metres. Default: the larger value of the two
        studies.
    unsafe
        What counts as unsafe: a collision, less than X m of clearance, or a metric beyond a limit.
        Default: the criterion of the study, else a collision (if nothing collides: half of the
        original vehicle's safety degree).
    at_tests
        Compare limits only at the listed test cases. Default: also at speeds and places between the
        listed values.
    """
    study = evaluator.study
    evaluator.begin({BOTH_STAGE: 2 * samples, LIMITS_STAGE: 2 * usual_alone(evaluator)})
    second = evaluator.for_study(in_order_of(study, study_in(other)))
    evaluators = (evaluator, second)
    with about("limits"):
        restriction = limits_of(limits, study.domains)
    common = CommonDomain.of(evaluators, restriction)
    originals = [evaluator.evaluate_original(), second.evaluate_original()]
    criteria = _criteria((subject, other), evaluators, originals, unsafe, margin)
    criterion = criteria[0]

    # With few simulations, a third of them drives the pairs: a sixth in each version. The other two
    # thirds are for the limits.
    pairs, outside = pairs_of(
        (subject, other), common, criteria, evaluator.of_stage(samples, 6)
    )
    valid = pairs.take(pairs.are_valid)
    settings = _settings_frame(common, valid, criteria)
    tested = _test(settings)
    counts = counts_of(settings.drop_duplicates(list(evaluator.characteristics.names)))
    titles = {"a": study.name, "b": second.study.name}
    if titles["a"] == titles["b"]:
        titles = {"a": "A", "b": "B"}

    alone = limits_of_both(evaluators, criteria, restriction, at_tests=at_tests)
    changes = alone.frame["change"]
    of_originals, of_new_cars = compare_originals(evaluators, originals, criteria)
    differences = [
        *of_new_cars,
        *compare_counts(counts),
        *compare_limits(alone.frame, evaluator.characteristics),
        *compare_values(tested.p, tested.a12),
    ]
    lacks = list(missing_in_words(*evaluators, titles))
    number_of_better = sum(difference.is_better for difference in differences)
    decision, why = _decide(differences, titles, of_originals, lacks)
    if decision == RELEASE:
        evaluator.tally.refuse_standing()
    numbers = {
        **({"driven": False} if second.no_verdict else {}),
        "decision": decision.lower(),
        "better_in": number_of_better,
        "worse_in": len(differences) - number_of_better,
        "unsafe": str(criterion),
        "margin": criterion.keep,
        "settings": sum(counts.values()),
        **counts,
        "p": tested.p,
        "a12": tested.a12,
        "limits_grown": int(changes.isin([GROWN, BOTH]).sum()),
        "limits_shrunk": int(changes.isin([SHRUNK, BOTH]).sum()),
        "outside": outside,
        "not_simulated": int((~pairs.are_valid).sum()) - pairs.number_infeasible,
        **of_originals,
    }
    summary = summary_of(numbers, tested.pairs.frame, titles)
    table = _table(common, settings)
    remarks = []
    if not differences:
        remarks = list(_remarks_on_code(evaluators, [originals, pairs.runs], titles))
    reason = second.no_verdict if second.no_verdict != evaluator.no_verdict else ""
    notes = [criterion.remark, *counted_in_words(study, pairs.number_infeasible)]
    verdict = Verdict(
        [
            answer(reason),
            *why,
            *_basis(criterion, common, limits, titles),
            *remarks,
            *map(note, notes),
        ]
    )
    return Answer(
        question="compare",
        study=study,
        verdict=verdict,
        tested=_test_in_words(tested, titles),
        numbers=numbers,
        tables={
            "summary": summary,
            "limits": alone,
            "pairs": tested.pairs,
            "settings": table,
        },
        folded=("settings",),
        failures=(Verdict(why),) if decision == DO_NOT_RELEASE else (),
        draw=partial(draw_pairs, titles=list(titles.values())),
    )


def _criteria(
    subjects: Sequence[Subject],
    evaluators: Evaluators,
    originals: Runs,
    unsafe: Unsafe | None,
    margin: float | None,
) -> list[Unsafe]:
    """The criterion of both versions, as `tolerance` would choose it. Both versions get the larger
    of their clearances to keep. Each version has the safety degree at which its bodies touch.
    """
    stated = Unsafe() if unsafe is None and margin is not None else unsafe
    criterion = stated or _default_criterion(subjects, evaluators, originals)
    is_stated = unsafe is not None
    of_sides = [
        keeping_distance(side, side.checked(criterion), margin, is_stated=is_stated)
        for side in evaluators
    ]
    keep = max(criterion.keep for criterion in of_sides)
    return [replace(criterion, keep=keep) for criterion in of_sides]


def _default_criterion(
    subjects: Sequence[Subject],
    evaluators: Evaluators,
    originals: Runs,
) -> Unsafe:
    """The criterion if the user states nothing: a collision if that is the default criterion of
    either version, else the default criterion of A.
    """
    defaults = []
    for subject, evaluator, original in zip(
        subjects, evaluators, originals, strict=True
    ):
        default = evaluator.choose_criterion(None, subject, original)
        if default == Unsafe():
            return default
        defaults.append(default)
    return defaults[0]


def _settings_frame(
    common: CommonDomain, pairs: Pairs, criteria: Criteria
) -> pd.DataFrame:
    """The frame of the settings, with a row for each pair of vehicles. It has `SETTING_COLUMNS`,
    the values in A, and the values in B of all characteristics whose original values differ.
    """
    names = common.evaluators[0].characteristics.names
    frame, settings, runs = pairs
    of_pairs = table_of_pairs(frame["solution"], runs, criteria)
    a, b = (pd.DataFrame(of_side, columns=names) for of_side in settings)
    differing = b[list(compress(names, common.shift))].add_prefix("b_")
    return pd.concat([frame.drop(columns="solution"), of_pairs, a, differing], axis=1)


def _table(common: CommonDomain, settings: pd.DataFrame) -> AnswerTable:
    """The table of the settings. The order of `UNSAFE_IN` is the order of its rows: first the
    settings that are unsafe in only one version.
    """
    members = common.evaluators[0].characteristics.members
    columns = {
        "source": Column(
            "", "where the vehicle comes from: a solution of a or of b, or the sample"
        ),
        **SETTING_COLUMNS,
    }
    columns |= {
        item.name: Column(item.unit, item.words, is_shown=False) for item in members
    }
    for column in np.flatnonzero(common.shift).tolist():
        item = members[column]
        meaning = f"{item.name} in B, the same change of another original"
        columns[f"b_{item.name}"] = Column(item.unit, meaning, is_shown=False)
    rows = settings.sort_values(
        "unsafe_in", kind="stable", key=lambda names: names.map(list(UNSAFE_IN).index)
    )
    return tabulate("The same changed vehicles in both versions", columns, rows)


class _PairedTest(NamedTuple):
    """A paired test of the safety degree: the p-value, A12 (above 0.5 A is safer), the table of the
    pairs, and `groups`, the words that say which settings a pair is the mean of.
    """

    p: float
    a12: float
    pairs: AnswerTable
    groups: str


def _test(settings: pd.DataFrame) -> _PairedTest:
    """Test the difference of the safety degree between A and B in pairs.

    A pair has the mean safety degrees in A and in B over the same settings. These are the solutions
    of a run or, if there are fewer runs than the test needs, the sampled settings on a line.
    """
    degrees = {"a": settings["a_degree"], "b": settings["b_degree"]}
    frame = settings.assign(**degrees).dropna(subset=SIDES)
    pairs = frame[frame["source"] == SAMPLE].groupby(LINE)[SIDES].mean()
    names = [f"line {int(line)}" for line in pairs.index]
    groups = "sampled on one line through the domain"
    if "run" in frame:
        # Sampled settings belong to no run: pandas leaves them out.
        means = frame.groupby(["source", "algorithm", "run"])[SIDES].mean()
        if len(means) >= fewest_runs("RQ1"):
            pairs = means
            names = [
                f"{name}-{int(run):02d} of {side.upper()}"
                for side, name, run in pairs.index
            ]
            groups = "the solutions of one run"
    # A12 is the probability that A's safety degree is greater: above 0.5 A is safer.
    sides = pairs.to_numpy(dtype=float).T
    p = signed_rank_test(*sides).p_value
    a12 = compare_samples(*sides).effect_size
    rows = pairs.reset_index(drop=True).assign(pair=names)
    table = tabulate(
        "Pairs of the statistical test: mean safety degree", PAIR_COLUMNS, rows
    )
    return _PairedTest(p, a12, table, groups)


def _decide(
    differences: Sequence[Difference],
    titles: Titles,
    of_originals: JsonObject,
    lacks: Sequence[Sentence],
) -> tuple[str, list[Sentence]]:
    """Decide whether to release B, and say why.

    - B is not released with a new collision, or if it is less safe, and better in needless braking
      at most.
    - A person decides if B is better in some things and worse in others, or if B is only worse in
      needless braking. A person also decides if needless braking was not measured, although B is
      better or brakes elsewhere.
    - A person also decides if the study of one version asks less than that of the other (`lacks`),
      unless there is a new collision.
    - Otherwise B is released.
    """
    in_order = sorted(differences, key=lambda difference: -difference.weight)
    worse = [difference for difference in in_order if not difference.is_better]
    better = [difference for difference in in_order if difference.is_better]
    worst = worse[0].weight if worse else COMFORT
    best = better[0].weight if better else COMFORT
    brakes_elsewhere = of_originals["metres_earlier"] or of_originals["metres_later"]
    is_unknown = not of_originals["benign_scenes"] and (better or brakes_elsewhere)
    decision = DECIDE
    if lacks and worst < COLLISION:
        template = words.LACKING
    elif worst == COLLISION or worst > best:
        decision = DO_NOT_RELEASE
        is_smoother = better and best == COMFORT
        template = words.LESS_SAFE_BUT_SMOOTHER if is_smoother else words.LESS_SAFE
    elif worse:
        template = words.MIXED if better else words.LESS_SMOOTH
    elif is_unknown:
        template = words.BRAKING_UNKNOWN
    else:
        decision = RELEASE
        template = words.BETTER if better else words.ALIKE
    safe = "safer than" if better else "as safe as"
    leading = [*worse[: MAX_REASONS - bool(better)], *better][:MAX_REASONS]
    reasons = [reason.template(**reason.values, **titles) for reason in leading]
    sentences = [template(safe=safe, **titles), *lacks]
    return decision, [*sentences, *dict.fromkeys(reasons)]


def _test_in_words(tested: _PairedTest, titles: Titles) -> str:
    """The result of the paired test in a sentence."""
    if np.isnan(tested.p):
        return words.NO_TEST.text
    return words.TEST(
        number=len(tested.pairs.frame),
        groups=tested.groups,
        p=tested.p,
        a12=tested.a12,
        **titles,
    ).text


def _remarks_on_code(
    evaluators: Evaluators, runs_of_both: Sequence[Runs], titles: Titles
) -> Sentences:
    """Yield a remark if the user code of the versions differs, although all runs are equal."""
    for a, b in runs_of_both:
        if a.metrics.keys() != b.metrics.keys() or [
            *differing_rows(a.results, b.results)
        ]:
            return
    code_of_a, code_of_b = (side.code for side in evaluators)
    files = sorted(
        name
        for name in code_of_a.keys() | code_of_b.keys()
        if code_of_a.get(name) != code_of_b.get(name)
    )
    if files:
        named = join_few(files, MAX_REASONS, "more files")
        yield words.EQUAL_RESULTS(files=named, **titles)


def _basis(
    unsafe: Unsafe,
    common: CommonDomain,
    limits: Sequence[str],
    titles: Titles,
) -> Sentences:
    """Yield the sentences on the basis of the comparison: what counts as unsafe, the user's limits,
    and original values that differ.
    """
    if not unsafe.is_collision or unsafe.keep:
        yield UNSAFE_MEANS(description=unsafe.description)
    if limits:
        yield words.WITHIN(limits=join_phrases(limits))

    a, b = (side.characteristics.members for side in common.evaluators)
    values = [
        f"{a[column].short_name} {a[column].original:g} and"
        f" {b[column].original:g}{a[column].suffix}"
        for column in np.flatnonzero(common.shift)
    ]
    if values:
        yield words.ORIGINALS_DIFFER(
            values=join_phrases(values),
            **titles,
        )
