"""Records that packages pass to each other: observations and commands of an ADS, traces of runs,
and evaluations.
"""

from safevar_sumo.records.driving import (
    ALL_TRUE as ALL_TRUE,
    GRAVITY as GRAVITY,
    KMH_PER_MS as KMH_PER_MS,
    LEAST_COLLISION_SPEED as LEAST_COLLISION_SPEED,
    STANDSTILL as STANDSTILL,
    TIME_DECIMALS as TIME_DECIMALS,
    TIME_ROUNDING as TIME_ROUNDING,
    TOUCH_OVERLAP as TOUCH_OVERLAP,
    ZERO as ZERO,
    BoolArray as BoolArray,
    Command as Command,
    FloatArray as FloatArray,
    FloatOrArray as FloatOrArray,
    IntArray as IntArray,
    JsonObject as JsonObject,
    NamedValues as NamedValues,
    Nominal as Nominal,
    Observation as Observation,
    PedalTables as PedalTables,
    Quantity as Quantity,
    TextArray as TextArray,
    clip_to_share as clip_to_share,
    finite_or_none as finite_or_none,
    nans as nans,
    significant as significant,
)
from safevar_sumo.records.evaluations import (
    RESULT_ROUNDING as RESULT_ROUNDING,
    Evaluations as Evaluations,
    ResultColumns as ResultColumns,
    csv_text as csv_text,
    differences as differences,
)
from safevar_sumo.records.runs import (
    NO_CONTACT as NO_CONTACT,
    QUANTITIES as QUANTITIES,
    Contact as Contact,
    Encounter as Encounter,
    Outcome as Outcome,
    SimulationRuns as SimulationRuns,
    Trace as Trace,
)
