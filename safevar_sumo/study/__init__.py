"""A study: data only, read strictly from a TOML file."""

from safevar_sumo.errors import refuse_other_than_file
from safevar_sumo.study.characteristics import CharacteristicTable, unit_text
from safevar_sumo.study.constraints import Constraint
from safevar_sumo.study.file import load_study, write_study
from safevar_sumo.study.fitted import FITTED_TABLES, locate_parameter, missing_parameter
from safevar_sumo.study.schema import (
    DESCRIPTION_KEYS,
    OBJECTIVES,
    SAFETY_DEGREE,
    FitTable,
    FreeParameter,
    MatrixTable,
    MatrixTest,
    MetricsTable,
    ModelTable,
    Origin,
    RatingTable,
    SearchTable,
    Study,
    StudyLike,
    VehicleTable,
    Weather,
    fmus_of,
    label_of,
    study_names,
    study_path,
    tables_of,
    user_code_names,
    user_code_packages,
)
from safevar_sumo.study.validation import convert_table, error_with_key

__all__ = [
    "DESCRIPTION_KEYS", "FITTED_TABLES", "OBJECTIVES", "SAFETY_DEGREE", "CharacteristicTable", "Constraint",
    "FitTable", "FreeParameter", "MatrixTable", "MatrixTest", "MetricsTable", "ModelTable", "Origin", "RatingTable", "SearchTable",
    "Study", "StudyLike", "VehicleTable", "Weather", "convert_table", "error_with_key", "fmus_of", "label_of", "load_study",
    "locate_parameter", "missing_parameter", "refuse_other_than_file", "study_names", "study_path", "tables_of", "unit_text",
    "user_code_names", "user_code_packages", "write_study"]
