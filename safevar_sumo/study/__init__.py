"""A study consists of data only, which are read strictly from a TOML file."""

from safevar_sumo.study.characteristics import (
    CharacteristicTable as CharacteristicTable,
    Constraint as Constraint,
    Domain as Domain,
    Interval as Interval,
    PositiveProportion as PositiveProportion,
    Precision as Precision,
    Proportion as Proportion,
    unit_text as unit_text,
)
from safevar_sumo.study.encounters import (
    RANGES as RANGES,
    TESTS as TESTS,
    AxisTable as AxisTable,
    MatrixTable as MatrixTable,
    MatrixTest as MatrixTest,
    ModelTable as ModelTable,
    ScenarioTable as ScenarioTable,
    Weather as Weather,
    axis_of as axis_of,
)
from safevar_sumo.study.extending import StudyTables as StudyTables
from safevar_sumo.study.file import (
    checked_study as checked_study,
    plain_values as plain_values,
    read_tables as read_tables,
    study_names as study_names,
    write_study as write_study,
    write_tables as write_tables,
)
from safevar_sumo.study.limits import Limit as Limit, limits_of as limits_of
from safevar_sumo.study.marks import (
    WHOLE as WHOLE,
    WITHOUT_EFFECT as WITHOUT_EFFECT,
    Table as Table,
    keys_with as keys_with,
    with_effect as with_effect,
)
from safevar_sumo.study.parameters import (
    PHASE as PHASE,
    PHASE_DECIMALS as PHASE_DECIMALS,
    FreeParameter as FreeParameter,
    free_parameters as free_parameters,
    searched as searched,
)
from safevar_sumo.study.schema import (
    ORIGINAL_DEGREE as ORIGINAL_DEGREE,
    PYMOO as PYMOO,
    SAFETY_DEGREE as SAFETY_DEGREE,
    MetricsTable as MetricsTable,
    Origin as Origin,
    SearchTable as SearchTable,
    Study as Study,
    StudyLike as StudyLike,
    VehicleTable as VehicleTable,
    label_of as label_of,
    locate_parameter as locate_parameter,
    tables_of as tables_of,
)
from safevar_sumo.study.user_files import (
    data_files as data_files,
    fmus_of as fmus_of,
    user_code as user_code,
    user_code_names as user_code_names,
    user_modules as user_modules,
    without_skipping as without_skipping,
)
from safevar_sumo.study.validation import convert_table as convert_table
