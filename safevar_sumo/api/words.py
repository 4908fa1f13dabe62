"""The sentences of the answers of `study`."""

from __future__ import annotations

from safevar_sumo.questions.sentence import answer, condition, evidence, note

NOTHING_RETURNED = answer("The search returned no vehicle: {reason}.")
NOTHING_UNSAFE = answer(
    "The search did not find {unsafe.event}: none of the {total:,} different vehicles that the"
    " search returned (its solutions) {unsafe.verbs[0]}."
)
ORIGINAL_UNSAFE = answer(
    "The search found {unsafe.event} of the original vehicle, which {breach}{where}."
)
FEW_CHANGES = answer(
    "The search found {unsafe.event} with only {count}: {changes}. The changed vehicle"
    " {breach}{where}."
)
MANY_CHANGES = answer(
    'The search found {unsafe.event} with only {count}, which the table "fewest" lists'
    " (--details). The changed vehicle {breach}{where}."
)
UNSAFE = evidence(
    "{count} different vehicles that the search returned (its solutions) {collide}."
)
NOT_SIMULATED = condition(
    "The search could not simulate {failed}, and no result has them."
)
NEVER_MOVED = note(
    "Remark: {vehicles} never moved. The search counts the safety degree of such a vehicle like any"
    " other."
)
NO_PROOF = note(
    'The search does not prove that fewer changes are safe. The command "explain {study}" tries'
    " single changes and combinations of changes, each at an end of its domain (its range of"
    " values)."
)
COMMAND = note("This command simulates the vehicle: {command}")
PROGRESS = answer(
    "{finished} of the {runs} of the search are finished. The results are in {directory}."
)
