"""Makes the answer of `repair` from the repairs that were found: numbers, table and verdict."""

from __future__ import annotations

from safevar_sumo.questions.answer import Answer, tabulate
from safevar_sumo.questions.repair.found import Found, Repair
from safevar_sumo.questions.repair.verdict import (
    change_in_words,
    tested_sentences,
    verdict_sentences,
)
from safevar_sumo.questions.sentence import Verdict
from safevar_sumo.questions.tables import shipped_columns
from safevar_sumo.records import JsonObject

NUMBERS = (
    "unsafe",
    "margin",
    "promise",
    "worst_today",
    "kept_today",
    "repairs",
    "not_repairable",
    "simulations",
    "rough",
    "fits",
    "fits_tried",
)
(REPAIRS,) = shipped_columns("repair").values()


def tell(found: Found) -> Answer:
    """The answer of `repair`."""
    rows = [_row_of(found, repair) for repair in found.repairs]
    return Answer(
        question="repair",
        study=found.study,
        verdict=Verdict(verdict_sentences(found)),
        numbers=_numbers(found),
        tables={"repairs": tabulate("Repairs", REPAIRS, rows)},
        tested=Verdict(tested_sentences(found)),
    )


def _numbers(found: Found) -> JsonObject:
    """The numbers of the answer, by the names in `NUMBERS`."""
    unsafe = found.unsafe
    return {
        "unsafe": str(unsafe),
        "margin": unsafe.keep if unsafe.is_collision else None,
        "promise": found.promise.to_dict(),
        "worst_today": found.worst_today,
        "kept_today": found.proof_today is not None,
        "repairs": len(found.repairs),
        "not_repairable": found.not_repairable,
        "simulations": found.simulations,
        "fits": found.sets_holding,
        "fits_tried": found.sets,
    }


def _row_of(found: Found, repair: Repair) -> JsonObject:
    """The row of the table `REPAIRS` for a repair."""
    return {
        "parameters": repair.values,
        "change": change_in_words(found, repair),
        "changed": len(repair.values),
        "fits": found.sets_holding,
        "largest_change": repair.size,
        "proof_samples": repair.proof.samples,
        "proof_failures": repair.proof.failures,
        "at_most": repair.proof.at_most,
        **repair.price._asdict(),
    }
